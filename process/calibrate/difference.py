"""How two calibrations differ: parameters in sigmas of both, and how far the stripe's points move.

Sigmas are those of the difference of two independent estimates, sqrt(s1^2 + s2^2); estimates that share
their images are closer than that says. The joint distance of a part is the Mahalanobis distance under
the sum of both covariances, given as the sigma of a single normal number that is as unlikely.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import (
    Calibration,
    Intrinsics,
    Joint,
    LaserPlane,
    Matrix,
    Part,
    TurntableAxis,
)
from ...schemas.errors import CalibrationError
from ..camera import project, undistort_points
from ..triangulate import intersect, range_of, turntable_from_camera

Floats = npt.NDArray[np.float64]

#: Ranges at which shifts are told unless others are asked for.
RANGES_MM = (500.0, 1000.0, 3000.0, 5000.0, 7000.0)

_NAMES = {
    Intrinsics: ("fx_px", "fy_px", "cx_px", "cy_px", "skew", "k1", "k2", "p1", "p2", "k3"),
    LaserPlane: ("nx", "ny", "nz", "distance_mm"),
    TurntableAxis: (
        *("point_x_mm", "point_y_mm", "point_z_mm"),
        *("direction_x", "direction_y", "direction_z"),
    ),
}
_ALONG = 720
_STRIPE = 61


@dataclass(frozen=True)
class ParameterDifference:
    """One parameter: ``difference`` = second - first; None where a part or a covariance is missing."""

    part: str
    parameter: str
    first: float | None
    second: float | None
    difference: float | None
    sigma: float | None
    sigmas: float | None


@dataclass(frozen=True)
class PartDifference:
    """A whole part: ``same`` says that its content id is equal; ``sigmas`` as the module says."""

    part: str
    same: bool
    sigmas: float | None


@dataclass(frozen=True)
class Shift:
    """Where the points of the stripe at one range go from the first calibration to the second.

    Same pixels, angle 0. ``rms_mm`` and ``max_mm`` are lengths in scene space over the stripe,
    ``range_mm`` the mean change of range, ``x_mm y_mm z_mm`` the mean shift. ``points`` is 0, and all
    of them None, where the first calibration's stripe is not in the image at that range.
    """

    laser: int
    at_mm: float
    points: int
    rms_mm: float | None = None
    max_mm: float | None = None
    range_mm: float | None = None
    x_mm: float | None = None
    y_mm: float | None = None
    z_mm: float | None = None


def parameters_of(part: Part) -> Floats:
    """The parameters of a part as a vector, in the order of its covariance."""
    if isinstance(part, Intrinsics):
        c = part
        return np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.skew, *c.distortion])
    if isinstance(part, LaserPlane):
        return np.array([*part.normal, part.distance_mm])
    assert isinstance(part, TurntableAxis)
    return np.array([*part.point_mm, *part.direction])


def _covariance(part: Part) -> Floats | None:
    matrix: Matrix | None = getattr(part, "covariance", None)
    return None if matrix is None else np.array(matrix, np.float64)


def parameter_differences(first: Calibration, second: Calibration) -> list[ParameterDifference]:
    """Every parameter of every part of either calibration, in the order of the parts."""
    out = []
    a, b = first.parts(), second.parts()
    for role in [*a, *(r for r in b if r not in a)]:
        pair = (a.get(role), b.get(role))
        some = next(p for p in pair if p is not None)
        if isinstance(some, Joint):
            continue
        values, sigma = _pair(pair)
        for i, name in enumerate(_NAMES[type(some)]):
            one, two = (None if v is None else float(v[i]) for v in values)
            gap = None if one is None or two is None else two - one
            s = None if sigma is None else float(sigma[i])
            told = None if gap is None or not s else gap / s
            out.append(ParameterDifference(role, name, one, two, gap, s, told))
    return out


def _pair(pair: tuple[Part | None, Part | None]) -> tuple[list[Floats | None], Floats | None]:
    """Both vectors, and the sigmas of their difference where both covariances are known."""
    values = [None if p is None else parameters_of(p) for p in pair]
    # (n, h) and (-n, -h) are the same plane.
    flipped = (
        isinstance(pair[1], LaserPlane)
        and values[0] is not None
        and values[1] is not None
        and float(values[0][:3] @ values[1][:3]) < 0
    )
    if flipped:
        assert values[1] is not None
        values[1] = -values[1]
    covariances = [None if p is None else _covariance(p) for p in pair]
    if covariances[0] is None or covariances[1] is None:
        return values, None
    return values, np.sqrt(np.diag(covariances[0]) + np.diag(covariances[1]))


def part_differences(first: Calibration, second: Calibration) -> list[PartDifference]:
    """Every part of either calibration: whether it is the same, and how unlikely the difference is."""
    a, b = first.parts(), second.parts()
    out = []
    for role in [*a, *(r for r in b if r not in a)]:
        one, two = a.get(role), b.get(role)
        if one is None or two is None:
            out.append(PartDifference(role, same=False, sigmas=None))
            continue
        same = one.part_id() == two.part_id()
        out.append(PartDifference(role, same=same, sigmas=_joint_sigmas(one, two)))
    return out


def _joint_sigmas(one: Part, two: Part) -> float | None:
    from scipy.special import gammaincc

    ca, cb = _covariance(one), _covariance(two)
    if ca is None or cb is None or isinstance(one, Joint):
        return None
    values, sigma = _pair((one, two))
    assert values[0] is not None
    assert values[1] is not None
    assert sigma is not None
    free = sigma > 0
    gap = (values[1] - values[0])[free]
    if not free.any():
        return None
    # In units of the single sigmas, so that one threshold tells what is not determined at all: the
    # length of a unit vector, or the place of the axis' origin along the axis.
    correlation = (ca + cb)[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    weights, axes = np.linalg.eigh(correlation)
    known = weights > 1e-9 * weights.max()
    along = axes.T @ (gap / sigma[free])
    chi2 = float(np.sum(along[known] ** 2 / weights[known]))
    return _as_sigma(float(gammaincc(known.sum() / 2.0, chi2 / 2.0)), chi2)


def _as_sigma(probability: float, chi2: float) -> float:
    """The |z| of a normal number that is exceeded with ``probability`` (two-sided)."""
    from scipy.special import ndtri

    if probability <= 1e-300:
        return math.sqrt(chi2)
    return float(-ndtri(probability / 2.0))


def shifts(
    first: Calibration, second: Calibration, ranges_mm: tuple[float, ...] = RANGES_MM
) -> list[Shift]:
    """Shifts of the stripe's points for every laser that both calibrations know.

    In turntable space; in camera space where one of them has no axis (:func:`in_camera_space`).

    Raises
    ------
    CalibrationError
        A calibration lacks its camera, they are for frames of different size, or they have no
        laser in common.
    """
    camera, other = first.intrinsics_or_fail(), second.intrinsics_or_fail()
    if (camera.width_px, camera.height_px) != (other.width_px, other.height_px):
        raise CalibrationError(
            f"one calibration is for frames of {camera.width_px} x {camera.height_px}, the other for "
            f"{other.width_px} x {other.height_px}",
            hint="compare calibrations of the same camera at the same resolution",
        )
    lasers = sorted({p.laser for p in first.lasers} & {p.laser for p in second.lasers})
    if not lasers:
        raise CalibrationError(
            "the calibrations have no laser in common, so no points can be compared",
            hint="turnscan calibration show ID shows what a calibration holds",
        )
    camera_space = in_camera_space(first, second)
    before, after = (_points_at(c, camera_space=camera_space) for c in (first, second))
    out = []
    for laser in lasers:
        for at in ranges_mm:
            u, v = stripe_pixels(first, laser, at)
            out.append(_shift(laser, at, before(u, v, laser), after(u, v, laser)))
    return out


def in_camera_space(first: Calibration, second: Calibration) -> bool:
    """Whether points can be compared in camera space only, as one of the two has no axis."""
    return first.turntable is None or second.turntable is None


def _points_at(
    calibration: Calibration, *, camera_space: bool
) -> Callable[[Floats, Floats, int], tuple[Floats, Floats]]:
    """Function of pixels and laser: points in turntable (or camera) space, and their ranges."""
    camera = calibration.intrinsics_or_fail()
    place = None if camera_space else turntable_from_camera(calibration.axis_or_fail())

    def points(u: Floats, v: Floats, laser: int) -> tuple[Floats, Floats]:
        p = intersect(*undistort_points(u, v, camera), calibration.plane_or_fail(laser))
        return p if place is None else place(p), range_of(p)

    return points


def stripe_pixels(calibration: Calibration, laser: int, range_mm: float) -> tuple[Floats, Floats]:
    """Pixels (u, v), spread over the image, that show points of the laser plane at ``range_mm``.

    Such points lie on a circle about the foot of the camera's perpendicular on the plane.
    """
    camera, plane = calibration.intrinsics_or_fail(), calibration.plane_or_fail(laser)
    normal = np.array(plane.normal)
    inside = range_mm**2 - plane.distance_mm**2
    if inside <= 0:
        return np.zeros(0), np.zeros(0)
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    around = _spread(np.cross(normal, across), across, normal * plane.distance_mm, inside, camera)
    u, v = project(around, camera)
    seen = _in_image(u, v, camera)
    # The lens model may fold back far outside the image: what comes back elsewhere is not seen.
    xn, yn = undistort_points(u[seen], v[seen], camera)
    p = around[seen]
    true = np.hypot(xn - p[:, 0] / p[:, 2], yn - p[:, 1] / p[:, 2]) < 1e-9
    return u[seen][true], v[seen][true]


def _spread(e1: Floats, e2: Floats, foot: Floats, inside: float, camera: Intrinsics) -> Floats:
    """Points on the circle, evenly over the part of it that is in the image."""

    def circle(angle: Floats) -> Floats:
        ring = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
        return foot + math.sqrt(inside) * ring

    angle = np.linspace(0.0, math.tau, _ALONG, endpoint=False)
    at = angle
    for _ in range(2):
        seen = np.flatnonzero(_in_image(*project(circle(at), camera), camera))
        if not len(seen):
            return circle(at[:0])
        # The circle may be cut at angle 0: turn it so that the largest gap is outside.
        gaps = np.diff(np.append(at[seen], at[seen[0]] + math.tau))
        start = seen[(int(np.argmax(gaps)) + 1) % len(seen)]
        span = float(np.sum(gaps) - gaps.max())
        step = float(at[1] - at[0])
        at = at[start] + np.linspace(-step, span + step, _ALONG)
    seen = np.flatnonzero(_in_image(*project(circle(at), camera), camera))
    picked = (
        at[seen[np.linspace(0, len(seen) - 1, _STRIPE).round().astype(int)]] if len(seen) else at[:0]
    )
    return circle(picked)


def _in_image(u: Floats, v: Floats, camera: Intrinsics) -> npt.NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return (u >= 0) & (v >= 0) & (u <= camera.width_px - 1) & (v <= camera.height_px - 1)


def _shift(
    laser: int, at_mm: float, before: tuple[Floats, Floats], after: tuple[Floats, Floats]
) -> Shift:
    moved = after[0] - before[0]
    good = np.isfinite(moved).all(axis=1)
    count = int(good.sum())
    if not count:
        return Shift(laser, at_mm, 0)
    lengths = np.linalg.norm(moved[good], axis=1)
    mean = moved[good].mean(axis=0)
    facts: dict[str, Any] = {
        "rms_mm": float(np.sqrt(np.mean(lengths**2))),
        "max_mm": float(lengths.max()),
        "range_mm": float(np.mean((after[1] - before[1])[good])),
        **{f"{n}_mm": float(m) for n, m in zip("xyz", mean, strict=True)},
    }
    return Shift(laser, at_mm, count, **facts)
