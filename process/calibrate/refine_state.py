"""The unknowns of the joint adjustment: where each stands, and how a step moves the state.

Rotations move by exp(w) from the left, unit vectors along two tangents, all else by addition. Every
step is counted from a base state; the derivatives of the state by the step hold at the step itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from .pose import skew_of
from .projection import rotation_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class State:
    """All that is estimated, in camera space.

    ``camera`` (10,); ``normals`` (K, 3) and ``distances_mm`` (K,) of the lasers' planes; the axis;
    ``board_turns`` (V, 3, 3) and ``board_shifts_mm`` (V, 3), ``camera_from_board``; the same of the
    bodies (M) on the table at phi = 0; ``phi_rad`` (F,) of the frames, with ``scale`` and
    ``offset_rad`` of the nominal angles and the bodies' ``size``; ``wall_normals`` (W, 3) and
    ``wall_distances_mm`` (W,) at each wall's first stripe; ``centres_mm`` (S, 3) and ``diameters_mm``
    (S,) of the spheres;
    ``bends_mm`` (Q, 2) how far the surface under each stripe is off its board's plane, in the middle of
    the stripe and, with opposite signs, at its ends.
    """

    camera: Floats
    normals: Floats
    distances_mm: Floats
    point_mm: Floats
    direction: Floats
    board_turns: Floats
    board_shifts_mm: Floats
    body_turns: Floats
    body_shifts_mm: Floats
    phi_rad: Floats
    scale: float
    offset_rad: float
    size: float
    wall_normals: Floats
    wall_distances_mm: Floats
    centres_mm: Floats
    diameters_mm: Floats
    bends_mm: Floats

    def intrinsics(self, width_px: int, height_px: int) -> Intrinsics:
        """The camera as a part of a calibration, without covariance."""
        fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = (float(v) for v in self.camera)
        return Intrinsics(
            width_px=width_px,
            height_px=height_px,
            fx_px=fx,
            fy_px=fy,
            cx_px=cx,
            cy_px=cy,
            skew=skew,
            distortion=(k1, k2, p1, p2, k3),
        )


@dataclass(frozen=True)
class Layout:
    """Where the unknowns stand in the vector x: first those of the calibration, then all others.

    ``free`` (10, m) maps the camera's m unknowns to its ten numbers; ``planes``, ``axis`` (length 4,
    empty when the axis is not estimated), ``boards``, ``bodies``, ``phi`` (one a frame but the first;
    empty for exact angles), ``angles`` (scale, offset; likewise), ``size``, ``walls`` (3 each),
    ``spheres`` (4 each) and ``bends`` (2 each) are first index and count of blocks.
    """

    free: Floats
    planes: range
    axis: range
    boards: range
    bodies: range
    phi: range
    angles: range
    size: range
    walls: range
    spheres: range
    bends: range

    @property
    def calibration(self) -> int:
        """How many unknowns belong to the calibration; they come first."""
        return self.boards.start

    @property
    def width(self) -> int:
        """How many unknowns there are."""
        return self.bends.stop

    @classmethod
    def of(
        cls,
        free: Floats,
        planes: int,
        boards: int,
        bodies: int,
        frames: int,
        walls: int,
        spheres: int,
        stripes: int,
        *,
        exact_angles: bool,
        sized: bool,
    ) -> Layout:
        """Blocks one after the other for these numbers of things; no bodies: no axis."""
        at = free.shape[1]
        blocks = []
        phi = 0 if exact_angles or not bodies else frames - 1
        for count in (
            3 * planes,
            4 if bodies else 0,
            6 * boards,
            6 * bodies,
            phi,
            2 if phi else 0,
            1 if sized and bodies else 0,
            3 * walls,
            4 * spheres,
            2 * stripes,
        ):
            blocks.append(range(at, at + count))
            at += count
        return cls(free, *blocks)


@dataclass(frozen=True)
class Chart:
    """A state with the derivatives of its curved parts by the step from the base.

    ``by_*``: turns (., 3, 3) map a step of the rotation vector to a rotation from the left at the
    state; directions (., 3, 2) map a step along the tangents to the change of the unit vector.
    """

    state: State
    by_normals: Floats
    by_direction: Floats
    by_point: Floats
    by_board_turns: Floats
    by_body_turns: Floats
    by_wall_normals: Floats


def moved(base: State, layout: Layout, x: Floats) -> Chart:
    """The state a step ``x`` away from ``base``."""
    lay = layout
    planes = x[lay.planes.start : lay.planes.stop].reshape(-1, 3)
    normals, by_normals = _bent(base.normals, planes[:, :2])
    walls = x[lay.walls.start : lay.walls.stop].reshape(-1, 3)
    wall_normals, by_wall_normals = _bent(base.wall_normals, walls[:, :2])
    boards = x[lay.boards.start : lay.boards.stop].reshape(-1, 6)
    bodies = x[lay.bodies.start : lay.bodies.stop].reshape(-1, 6)
    spheres = x[lay.spheres.start : lay.spheres.stop].reshape(-1, 4)
    state = replace(
        base,
        camera=base.camera + lay.free @ x[: lay.free.shape[1]],
        normals=normals,
        distances_mm=base.distances_mm + planes[:, 2],
        board_turns=rotation_of(boards[:, :3]) @ base.board_turns,
        board_shifts_mm=base.board_shifts_mm + boards[:, 3:],
        body_turns=rotation_of(bodies[:, :3]) @ base.body_turns,
        body_shifts_mm=base.body_shifts_mm + bodies[:, 3:],
        wall_normals=wall_normals,
        wall_distances_mm=base.wall_distances_mm + walls[:, 2],
        centres_mm=base.centres_mm + spheres[:, :3],
        diameters_mm=base.diameters_mm + spheres[:, 3],
        bends_mm=base.bends_mm + x[lay.bends.start : lay.bends.stop].reshape(-1, 2),
    )
    across = tangents_of(base.direction[None])[0]
    by_direction = np.zeros((3, 2))
    if lay.axis:
        step = x[lay.axis.start : lay.axis.stop]
        direction, bent = _bent(base.direction[None], step[None, 2:])
        by_direction = bent[0]
        state = replace(state, point_mm=base.point_mm + across @ step[:2], direction=direction[0])
    if lay.phi:
        phi = base.phi_rad.copy()
        phi[1:] += x[lay.phi.start : lay.phi.stop]
        scale, offset = x[lay.angles.start : lay.angles.stop]
        state = replace(
            state, phi_rad=phi, scale=base.scale + scale, offset_rad=base.offset_rad + offset
        )
    if lay.size:
        state = replace(state, size=base.size + float(x[lay.size.start]))
    return Chart(
        state=state,
        by_normals=by_normals,
        by_direction=by_direction,
        by_point=across,
        by_board_turns=_turn_slopes(boards[:, :3]),
        by_body_turns=_turn_slopes(bodies[:, :3]),
        by_wall_normals=by_wall_normals,
    )


def tangents_of(directions: Floats) -> Floats:
    """(N, 3, 2): two unit vectors across each unit vector (N, 3), the same for the same vector."""
    # Across the coordinate axis that the vector is least along; no jumps within one adjustment.
    least = np.eye(3)[np.abs(directions).argmin(axis=1)]
    first = np.cross(directions, least)
    first = first / np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(directions, first)], axis=2)


def _bent(base: Floats, step: Floats) -> tuple[Floats, Floats]:
    """Unit vectors (N, 3) moved by ``step`` (N, 2) along their tangents, and the slopes (N, 3, 2)."""
    basis = tangents_of(base)
    long = base + np.einsum("nij,nj->ni", basis, step)
    length = np.linalg.norm(long, axis=1)[:, None]
    unit = long / length
    slopes = (basis - unit[:, :, None] * np.einsum("ni,nij->nj", unit, basis)[:, None, :]) / length[
        :, :, None
    ]
    return unit, slopes


def _turn_slopes(vectors: Floats) -> Floats:
    """Left Jacobians (N, 3, 3): exp(w + dw) = exp(J dw) exp(w) to first order."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    cross = skew_of(vectors)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross), np.float64)
