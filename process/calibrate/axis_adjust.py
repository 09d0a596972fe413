"""Joint adjustment of a turning: axis, every angle, and where each rigid body stands, from its pixels.

A body's point p seen in frame k is ``X = a + R(d, phi_k) (R_m p + t_m - a)`` in camera space: the
body's pose when phi is 0, turned about the axis (point a, direction d). Levenberg-Marquardt on the
reprojection with analytic slopes; corners are weighted down as they stand out (Cauchy's weights).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from .pose import project_with_slopes, rotation_of, skew_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Sightings:
    """All seen points, one a row: frame and body they belong to, place on the body, pixel."""

    frame: Ints
    body: Ints
    points_mm: Floats
    seen_px: Floats

    def select(self, keep: npt.NDArray[np.bool_]) -> Sightings:
        """The points where ``keep`` is True."""
        return Sightings(self.frame[keep], self.body[keep], self.points_mm[keep], self.seen_px[keep])


@dataclass(frozen=True)
class Turning:
    """The state: axis, poses of the bodies at phi = 0 (M, 3, 3) and (M, 3), phi of the frames (K,)."""

    point_mm: Floats
    direction: Floats
    rotations: Floats
    translations_mm: Floats
    phi_rad: Floats

    def place(self, s: Sightings) -> tuple[Floats, Floats, Floats]:
        """Of every sighting: the point in camera space, its arm from the axis, and its body arm."""
        arm_of_body = np.einsum("nij,nj->ni", self.rotations[s.body], s.points_mm)
        arm = arm_of_body + self.translations_mm[s.body] - self.point_mm
        return self.point_mm + self._turn(arm, s.frame), arm, arm_of_body

    def _turn(self, v: Floats, frame: Ints) -> Floats:
        """Rodrigues' formula, a turn for every row."""
        cos, sin = np.cos(self.phi_rad[frame])[:, None], np.sin(self.phi_rad[frame])[:, None]
        d = self.direction
        return v * cos + np.cross(d, v) * sin + np.outer(v @ d, d) * (1.0 - cos)

    def turns(self, frame: Ints) -> Floats:
        """Rotation matrices (N, 3, 3) of the frames."""
        each = np.array([rotation_of(self.direction * p) for p in self.phi_rad])
        return each[frame]


@dataclass(frozen=True)
class Prior:
    """What is known of the angles: ``phi = scale nominal + offset`` to ``sd_rad`` each; 0: exactly."""

    nominal_rad: Floats
    sd_rad: float

    @property
    def exact(self) -> bool:
        """Whether the nominal angles are taken as they are."""
        return self.sd_rad == 0.0


@dataclass(frozen=True)
class Adjusted:
    """The result: the state, its normal matrix for weights as used, and what is left of each sighting.

    Parameters are ordered: point (2, along ``across``), direction (2, the same way), bodies (6 each),
    phi of the frames but the first, and, when angles are free, their scale and offset.
    """

    turning: Turning
    across: Floats
    normal_matrix: Floats
    jacobian: Floats
    residual_px: Floats
    weight: Floats
    sigma_px: float
    scale: float
    offset_rad: float


def adjust(
    start: Turning,
    sightings: Sightings,
    camera: Intrinsics,
    prior: Prior | None,
    *,
    steps: int = 60,
    robust: bool = True,
) -> Adjusted:
    """Least squares from ``start``; ``prior`` None leaves the angles entirely free."""
    state, scale, offset = start, 1.0, 0.0
    if prior is not None and prior.exact:
        state = replace(state, phi_rad=prior.nominal_rad - prior.nominal_rad[0])
    damping, sigma = 1e-3, 0.0
    weight = np.ones(len(sightings.frame))
    residual = _residual(state, sightings, camera)
    sigma = _spread(residual)
    for step_number in range(steps):
        if robust and step_number >= 2:
            sigma = _spread(residual)
            weight = 1.0 / (1.0 + (residual**2).sum(axis=1) / (3.0 * sigma) ** 2)
        jacobian, across = _slopes(state, sightings, camera, prior)
        w = np.repeat(weight, 2)
        normal = jacobian.T @ (w[:, None] * jacobian)
        pull = jacobian.T @ (w * residual.ravel())
        free = prior is not None and not prior.exact
        if free:
            assert prior is not None
            rows, rest = _prior_rows(state, prior, scale, offset, jacobian.shape[1])
            share = (max(sigma, 1e-3) / prior.sd_rad) ** 2
            normal, pull = normal + share * rows.T @ rows, pull + share * rows.T @ rest
        try:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), pull)
        except np.linalg.LinAlgError:
            damping *= 10.0
            continue
        trial = moved_by(state, np.asarray(step, np.float64), across, prior)
        new = _residual(trial, sightings, camera)
        before = _cost(residual, weight, state, prior, scale, offset, sigma)
        moved_scale, moved_offset = (scale + step[-2], offset + step[-1]) if free else (scale, offset)
        after = _cost(new, weight, trial, prior, moved_scale, moved_offset, sigma)
        if not np.isfinite(after) or after > before * (1 + 1e-12):
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        done = step_number > 6 and before - after < 1e-11 * before and damping < 1e-6
        state, residual, scale, offset = trial, new, moved_scale, moved_offset
        damping = max(damping * 0.1, 1e-12)
        if done:
            break
    jacobian, across = _slopes(state, sightings, camera, prior)
    w = np.repeat(weight, 2)
    freedom = max(1.0, 2.0 * float(weight.sum()) - jacobian.shape[1])
    sigma = float(np.sqrt(max((w * residual.ravel() ** 2).sum() / freedom, 1e-16)))
    normal = jacobian.T @ (w[:, None] * jacobian)
    if prior is not None and not prior.exact:
        rows, _ = _prior_rows(state, prior, scale, offset, jacobian.shape[1])
        normal = normal + (sigma / prior.sd_rad) ** 2 * rows.T @ rows
    return Adjusted(state, across, normal, jacobian, residual, weight, sigma, scale, offset)


def _residual(state: Turning, s: Sightings, camera: Intrinsics) -> Floats:
    placed, _, _ = state.place(s)
    seen, _ = project_with_slopes(placed, camera)
    return s.seen_px - seen


def _spread(residual: Floats) -> float:
    """Standard deviation of one coordinate, robust."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-9)


def _cost(
    residual: Floats,
    weight: Floats,
    state: Turning,
    prior: Prior | None,
    scale: float,
    offset: float,
    sigma: float,
) -> float:
    cost = float((weight * (residual**2).sum(axis=1)).sum())
    if prior is not None and not prior.exact:
        rest = state.phi_rad - scale * prior.nominal_rad - offset
        cost += (max(sigma, 1e-3) / prior.sd_rad) ** 2 * float(rest @ rest)
    return cost


def _prior_rows(
    state: Turning, prior: Prior, scale: float, offset: float, width: int
) -> tuple[Floats, Floats]:
    """Rows (K, P) and rests (K,) of ``phi - scale nominal - offset = 0``."""
    count = len(state.phi_rad)
    rows = np.zeros((count, width))
    first = width - 2 - (count - 1)
    rows[np.arange(1, count), first + np.arange(count - 1)] = 1.0
    rows[:, -2], rows[:, -1] = -prior.nominal_rad, -1.0
    return rows, -(state.phi_rad - scale * prior.nominal_rad - offset)


def _slopes(
    state: Turning, s: Sightings, camera: Intrinsics, prior: Prior | None
) -> tuple[Floats, Floats]:
    """Derivatives (2 N, P) of the pixels by all parameters, and the two directions across the axis."""
    across = np.linalg.svd(state.direction[None])[2][1:].T
    placed, arm, arm_of_body = state.place(s)
    _, by_point = project_with_slopes(placed, camera)
    turn = state.turns(s.frame)
    turned = placed - state.point_mm
    count, bodies, frames = len(s.frame), len(state.rotations), len(state.phi_rad)
    exact = prior is not None and prior.exact
    angles = 0 if exact else frames - 1
    width = 4 + 6 * bodies + angles + (2 if prior is not None and not exact else 0)
    out = np.zeros((count, 2, width))
    out[:, :, 0:2] = by_point @ ((np.eye(3) - turn) @ across)
    spin = skew_of(state.direction) @ across
    out[:, :, 2:4] = by_point @ ((turn @ skew_of(arm) - skew_of(turned)) @ spin)
    by_turned = by_point @ turn
    each = np.concatenate([-by_turned @ skew_of(arm_of_body), by_turned], axis=2)
    rows = np.arange(count)
    for k in range(6):
        out[rows, :, 4 + 6 * s.body + k] = each[:, :, k]
    if angles:
        by_phi = np.einsum("nij,nj->ni", by_point, np.cross(state.direction, turned))
        later = s.frame > 0
        out[rows[later], :, 4 + 6 * bodies + s.frame[later] - 1] = by_phi[later]
    return out.reshape(2 * count, width), across


def moved_by(state: Turning, step: Floats, across: Floats, prior: Prior | None) -> Turning:
    """The state after a step of the parameters, in the order of :class:`Adjusted`."""
    direction = state.direction + across @ step[2:4]
    bodies = len(state.rotations)
    change = step[4 : 4 + 6 * bodies].reshape(bodies, 6)
    rotations = np.array([rotation_of(c[:3]) @ r for c, r in zip(change, state.rotations, strict=True)])
    phi = state.phi_rad
    if prior is None or not prior.exact:
        phi = phi.copy()
        phi[1:] += step[4 + 6 * bodies : 4 + 6 * bodies + len(phi) - 1]
    return Turning(
        point_mm=state.point_mm + across @ step[0:2],
        direction=direction / np.linalg.norm(direction),
        rotations=rotations,
        translations_mm=state.translations_mm + change[:, 3:],
        phi_rad=phi,
    )
