"""What single views say of a laser's plane, and the plane that satisfies all of them best.

Every stripe is a straight line on its board's plane, so a view says two things: how far the line is off
the laser's plane in the middle, and how much it is turned out of it. Both are a mean over
hundreds of stripe points, but they share one board pose; so the fit works on these two numbers a view,
with a covariance that carries the pose (from the corners) and the stripe (from its sigma and its
scatter). More stripe points of one view do not make its pose better, and do not count as if they did.
What the views scatter beyond that (boards are not flat, lens models not perfect) are variances of their
own, the same for each view, one for each of the two numbers; by the rule of Paule and Mandel (J. Res.
NBS 87, 1982) they are such that the squared residuals sum to their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ..camera import distortion_jacobian
from .intrinsics_slopes import pixel_slopes, ray_slopes
from .plane_consensus import Choice, on_board
from .pose import slopes_by_pose

Floats = npt.NDArray[np.float64]

#: Median of chi-square with one degree of freedom.
_CHI2_MEDIAN = 0.455
#: Numbers of the plane that the middles, and that the ends of the lines, mostly go into.
_TAKEN = (2, 1)
_STEPS = 6


@dataclass(frozen=True)
class Said:
    """What one view says of a plane.

    ``value`` (2,): how far its line is off in the middle, and how much farther at its ends, mm; their
    ``covariance`` (2, 2); how they follow the plane, ``slopes`` (2, 3: tangents, distance), and the
    pose, ``by_pose`` (2, 6). ``reduce`` (2, N) makes the value from the residuals of the single points.
    """

    value: Floats
    covariance: Floats
    slopes: Floats
    by_pose: Floats
    residual_mm: Floats
    reduce: Floats


def corner_sigma_px(chosen: Sequence[Choice]) -> float:
    """Standard deviation of one corner coordinate, from all views; a blurred few do not set it."""
    each = [c.view.pose.sum_of_squares_px2 / c.view.pose.degrees_of_freedom for c in chosen]
    return float(np.sqrt(max(np.median(each) * 1.03, 1e-12)))


def said_by(
    choice: Choice,
    normal: Floats,
    distance: float,
    basis: Floats,
    corner_sigma: float,
    camera: Intrinsics,
) -> Said:
    """What a view says of the plane, to first order; ``basis`` (3, 2): the normal's tangents."""
    line, pose = choice.line, choice.view.pose
    points = on_board(line, pose)
    good = np.asarray(np.isfinite(points).all(axis=1), np.bool_)
    line, points = line.select(good), points[good]
    rays = points / points[:, 2:3]
    middle = points.mean(axis=0)
    along = (points - middle) @ np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = along / max(float(np.abs(along).max()), 1e-9)
    residual = points @ normal - distance
    # d residual / d pixel: the ray moves, the point slides on the board.
    facing = rays @ pose.normal
    gradient = points[:, 2:3] * (normal - np.outer((rays @ normal) / facing, np.ones(3)) * pose.normal)
    xx, xy, yy = distortion_jacobian(rays[:, 0], rays[:, 1], camera)
    det = xx * yy - xy * xy
    by_xd = (yy * gradient[:, 0] - xy * gradient[:, 1]) / det
    by_yd = (xx * gradient[:, 1] - xy * gradient[:, 0]) / det
    slope = (by_yd - camera.skew * by_xd) / camera.fy_px if line.along_v else by_xd / camera.fx_px
    noise = np.maximum(np.abs(slope) * line.sigma_px, 1e-9)
    design = np.stack([np.ones_like(along), along], axis=1) / noise[:, None]
    inner = np.linalg.inv(design.T @ design)
    reduce = inner @ design.T / noise
    value = reduce @ residual
    # Speckle and paper make the centres wander together over many rows: the scatter and its memory,
    # not the sigma of single rows, say how well their mean is known. But a few rows that scatter
    # little are no better than stated: what they have in common does not show in their scatter.
    rest = (residual - value[0] - value[1] * along) / noise
    variance = float(rest @ rest) / max(1, len(rest) - 2)
    covariance = inner * max(variance, 1.0) * _memory(rest)
    # d residual / d pose: n.r / m.r scales every motion of the board's plane.
    gain = ((rays @ normal) / facing)[:, None]
    by_pose = np.concatenate(
        [gain * np.cross(pose.normal, pose.translation_mm - points), gain * pose.normal], axis=1
    )
    sigma = max(corner_sigma, np.sqrt(pose.sum_of_squares_px2 / pose.degrees_of_freedom))
    arm = reduce @ by_pose
    covariance = covariance + arm @ pose.covariance(sigma) @ arm.T
    slopes = np.concatenate([points @ basis, -np.ones((len(points), 1))], axis=1)
    return Said(value, covariance, reduce @ slopes, arm, residual, reduce)


def _memory(rest: Floats) -> float:
    """1 + 2 sum of autocorrelations while they are positive: how many rows say the same thing."""
    centred = rest - rest.mean()
    power = float(centred @ centred)
    if power <= 0 or len(rest) < 8:
        return 1.0
    total = 1.0
    for lag in range(1, len(rest) // 4):
        r = float(centred[:-lag] @ centred[lag:]) / power
        if r < 2.0 / np.sqrt(len(rest)):
            break
        total += 2.0 * r
    return total


def tangents(normal: Floats) -> Floats:
    """(3, 2): two unit vectors across ``normal``."""
    return np.linalg.svd(normal[None])[2][1:].T


def solve(
    chosen: Sequence[Choice], normal: Floats, distance: float, extra_mm: Floats, camera: Intrinsics
) -> tuple[Floats, float, list[Said], Floats, Floats]:
    """Generalised least squares, repeated as the weights follow the plane (total least squares)."""
    sigma = corner_sigma_px(chosen)
    more = np.diag(extra_mm**2)
    for _ in range(_STEPS):
        basis = tangents(normal)
        said = [said_by(c, normal, distance, basis, sigma, camera) for c in chosen]
        weights = [np.linalg.inv(s.covariance + more) for s in said]
        information = sum(
            (s.slopes.T @ w @ s.slopes for s, w in zip(said, weights, strict=True)), np.zeros((3, 3))
        )
        pull = sum((s.slopes.T @ w @ s.value for s, w in zip(said, weights, strict=True)), np.zeros(3))
        step = -np.linalg.solve(information, pull)
        normal = normal + basis @ step[:2]
        length = float(np.linalg.norm(normal))
        normal, distance = normal / length, (distance + float(step[2])) / length
        if np.abs(step[:2]).max() < 1e-9 and abs(step[2]) < 1e-6:
            break
    basis = tangents(normal)
    said = [said_by(c, normal, distance, basis, sigma, camera) for c in chosen]
    return normal, distance, said, information, basis


def squares(said: Sequence[Said], extra_mm: Floats) -> Floats:
    """Squared residual of every view in units of its own covariance: chi-square of two."""
    more = np.diag(extra_mm**2)
    return np.array([s.value @ np.linalg.solve(s.covariance + more, s.value) for s in said])


def unexplained_mm(said: Sequence[Said], *, robust: bool) -> Floats:
    """Standard deviations (middle, ends), mm, that make the squares sum (or their median) right."""
    out = np.zeros(2)
    for k, taken in enumerate(_TAKEN):
        square = np.array([s.value[k] ** 2 for s in said])
        known = np.array([s.covariance[k, k] for s in said])

        def surplus(
            extra: float, square: Floats = square, known: Floats = known, taken: int = taken
        ) -> float:
            ratio = square / (known + extra**2)
            if robust:
                return float(np.median(ratio)) - _CHI2_MEDIAN * (1.0 - taken / len(ratio))
            return float(ratio.sum()) - max(1, len(ratio) - taken)

        low, high = 0.0, 1e-3
        if surplus(0.0) <= 0:
            continue
        while surplus(high) > 0 and high < 1e6:
            low, high = high, 4.0 * high
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if surplus(middle) > 0 else (low, middle)
        out[k] = high
    # A board that is bent by so much in the middle is not straighter towards its ends.
    out[1] = max(out[1], out[0])
    return out


def follow_intrinsics(
    chosen: Sequence[Choice],
    said: Sequence[Said],
    extra_mm: Floats,
    information: Floats,
    normal: Floats,
    camera: Intrinsics,
) -> Floats:
    """How the plane (two tangents and the distance) follows the ten intrinsics: (3, 10).

    A changed camera changes every pose and every ray; what the views then say goes through the same
    linear estimate.
    """
    pull = np.zeros((3, 10))
    for c, s in zip(chosen, said, strict=True):
        pose, line = c.view.pose, c.line
        placed = pose.to_camera(c.view.board_mm)
        by_pose = slopes_by_pose(pose, c.view.board_mm, camera)
        seen = pixel_slopes(placed, camera).reshape(-1, 10)
        pose_moves = -np.linalg.solve(pose.normal_matrix, by_pose.T @ seen)
        points = on_board(line, pose)
        good = np.isfinite(points).all(axis=1)
        rays = points[good] / points[good, 2:3]
        facing = rays @ pose.normal
        gradient = points[good, 2:3] * (normal - ((rays @ normal) / facing)[:, None] * pose.normal)
        turns = ray_slopes(line.u_px[good], line.v_px[good], camera)
        by_rays = np.einsum("ni,nik->nk", gradient[:, :2], turns)
        weight = np.linalg.inv(s.covariance + np.diag(extra_mm**2))
        pull += s.slopes.T @ weight @ (s.reduce @ by_rays + s.by_pose @ pose_moves)
    return np.asarray(-np.linalg.solve(information, pull), np.float64)
