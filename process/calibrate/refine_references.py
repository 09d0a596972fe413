"""References of the joint adjustment: flat walls at known distance, spheres, lengths.

They are seen by stripes at any angle of the table or head: what stands still seems to turn about the
axis, so each also speaks about it. Stated values are numbers with an sd, and never taken for
outliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from .pose import rotation_of, skew_of
from .refine_blocks import Block, Sigmas, axis_columns, block_columns, camera_columns
from .refine_data import Data, Lit
from .refine_state import Chart, Layout, State
from .refine_stripes import (
    FARTHEST_PX,
    NEWTON,
    Crossing,
    crossing_of,
    on_surface,
    placed_at,
    plane_slopes,
    shifted,
    through_camera,
)

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def turns_of(lit: Lit, direction: Floats) -> Floats:
    """Rotations (N, 3, 3) about the axis by each point's phi."""
    angles, back = np.unique(lit.phi_rad, return_inverse=True)
    return np.array([rotation_of(direction * a) for a in angles])[back]


def wall_residuals(
    data: Data, layout: Layout, chart: Chart, camera: Intrinsics, sigmas: Sigmas
) -> list[Block]:
    """Stripes on walls, and the walls' distances."""
    lit, s = data.wall_points, chart.state
    m, d = s.wall_normals[lit.on], s.wall_distances_mm[lit.on]
    turn = turns_of(lit, s.direction)
    # m.X0 = d at the first angle; X = a + T (X0 - a) at this one.
    facing = np.einsum("nij,nj->ni", turn, m)
    offset = d - m @ s.point_mm + facing @ s.point_mm
    lit, gone = placed_at(lit, s, facing, offset, camera)
    c = crossing_of(lit, s, camera)
    value, by_centre, by_camera, by_normal, by_distance, by_m = on_surface(
        lit, c, facing, offset, camera
    )
    along = np.einsum("ni,ni->n", c.normals, c.rays)[:, None]
    by_facing = by_m - along * s.point_mm
    by_first = np.einsum("ni,nij->nj", by_facing, turn) + along * s.point_mm
    parts = [
        by_camera @ layout.free,
        plane_slopes(lit, chart, by_normal, by_distance),
        np.einsum("ni,nij->nj", by_first, chart.by_wall_normals[lit.on]),
        -along,
    ]
    columns = [
        camera_columns(layout, len(value)),
        block_columns(layout.planes.start, 3, lit.laser),
        block_columns(layout.walls.start, 3, lit.on),
    ]
    if layout.axis:
        spin = skew_of(s.direction) @ chart.by_direction
        by_spin = (turn @ skew_of(m) - skew_of(facing)) @ spin
        parts += [
            -along * ((facing - m) @ chart.by_point),
            np.einsum("ni,nij->nj", by_facing, by_spin),
        ]
        columns.append(axis_columns(layout, len(value)))
    sigma = sigmas.wall * np.sqrt(sigmas.wall_memory) * lit.sigma_px
    weight = 1.0 / (sigma * by_centre)
    cluster = len(data.board_names) + lit.on
    known = data.walls
    count = len(known.names)
    where = np.concatenate(columns, axis=1)
    return [
        Block(
            "wall stripes",
            weight * value - gone / sigma,
            where,
            weight[:, None] * np.hstack(parts),
            cluster,
        ),
        Block(
            "walls",
            (s.wall_distances_mm - known.value_mm) / known.sd_mm,
            layout.walls.start + 3 * np.arange(count)[:, None] + 2,
            1.0 / known.sd_mm[:, None],
            len(data.board_names) + np.arange(count),
            exact=True,
        ),
    ]


@dataclass(frozen=True)
class Placed:
    """Stripe points as they were before the turn (N, 3), and how k.X follows for one k (N, 3) a point.

    ``follow(k)`` gives slopes by the stripe's centre and by camera, plane and axis side by side.
    """

    lit: Lit
    crossing: Crossing
    points: Floats
    turned_back: Floats
    turn: Floats

    @classmethod
    def of(cls, lit: Lit, s: State, camera: Intrinsics) -> Placed:
        """The points of ``lit`` at a state."""
        c = crossing_of(lit, s, camera)
        depth = c.distances / np.einsum("ni,ni->n", c.normals, c.rays)
        points = np.where((depth > 0)[:, None], depth[:, None] * c.rays, np.nan)
        turn = turns_of(lit, s.direction)
        back = s.point_mm + np.einsum("nji,nj->ni", turn, points - s.point_mm)
        return cls(lit, c, points, back, turn)

    def follow(
        self, k: Floats, layout: Layout, chart: Chart, camera: Intrinsics
    ) -> tuple[Floats, Floats]:
        """Slopes of ``k . X`` by the centre (N,), and (N, m + 3 + 4 or 0) by the calibration."""
        c, s = self.crossing, chart.state
        kp = np.einsum("nij,nj->ni", self.turn, k)
        depth = self.points[:, 2]
        over = np.einsum("ni,ni->n", kp, self.points) / c.distances
        by_ray = depth[:, None] * (kp - over[:, None] * c.normals)
        # d X / d r = depth (1 - P n' / h), as depth n.r = h.
        by_centre, by_camera = through_camera(self.lit, c, by_ray[:, 0], by_ray[:, 1], camera)
        by_plane = plane_slopes(self.lit, chart, -over[:, None] * self.points, over)
        parts = [by_camera @ layout.free, by_plane]
        if layout.axis:
            spin = skew_of(s.direction) @ chart.by_direction
            arm, back = self.points - s.point_mm, self.turned_back - s.point_mm
            turn = self.turn.transpose(0, 2, 1)
            by_spin = (turn @ skew_of(arm) - skew_of(back)) @ spin
            parts += [(k - kp) @ chart.by_point, np.einsum("ni,nij->nj", k, by_spin)]
        return by_centre, np.hstack(parts)

    def columns(self, layout: Layout) -> Ints:
        """Which unknowns the slopes of :meth:`follow` belong to."""
        count = len(self.points)
        parts = [
            camera_columns(layout, count),
            block_columns(layout.planes.start, 3, self.lit.laser),
        ]
        if layout.axis:
            parts.append(axis_columns(layout, count))
        return np.concatenate(parts, axis=1)


def sphere_residuals(
    data: Data, layout: Layout, chart: Chart, camera: Intrinsics, sigmas: Sigmas
) -> list[Block]:
    """Stripes on spheres, and the spheres' diameters."""
    lit, s = data.sphere_points, chart.state
    seen = np.where(lit.along_v, lit.v_px, lit.u_px)
    gone = np.zeros_like(seen)
    for again in range(NEWTON + 1):
        placed = Placed.of(lit, s, camera)
        arm = placed.turned_back - s.centres_mm[lit.on]
        reach = np.linalg.norm(arm, axis=1)
        outward = arm / reach[:, None]
        by_centre, slopes = placed.follow(outward, layout, chart, camera)
        value = reach - 0.5 * s.diameters_mm[lit.on]
        if again < NEWTON:
            gone = gone - np.clip(value / by_centre, -FARTHEST_PX, FARTHEST_PX)
            lit = shifted(lit, seen + gone)
    sigma = sigmas.sphere * lit.sigma_px
    weight = 1.0 / (sigma * by_centre)
    own = np.concatenate([-outward, np.full((len(reach), 1), -0.5)], axis=1)
    known, count = data.spheres, len(data.spheres.names)
    first = len(data.board_names) + len(data.walls.names)
    where = np.concatenate(
        [placed.columns(layout), block_columns(layout.spheres.start, 4, lit.on)], axis=1
    )
    return [
        Block(
            "sphere stripes",
            weight * value - gone / sigma,
            where,
            weight[:, None] * np.hstack([slopes, own]),
            first + lit.on,
        ),
        Block(
            "spheres",
            (s.diameters_mm - known.value_mm) / known.sd_mm,
            layout.spheres.start + 4 * np.arange(count)[:, None] + 3,
            1.0 / known.sd_mm[:, None],
            first + np.arange(count),
            exact=True,
        ),
    ]


def length_residuals(
    data: Data, layout: Layout, chart: Chart, camera: Intrinsics, sigmas: Sigmas
) -> Block:
    """Distance of the two ends less the stated one, over its sd and the stripes' noise together."""
    placed, length, along = _ends(data, chart.state, camera)
    _, slopes = placed.follow(along, layout, chart, camera)
    weight = 1.0 / np.hypot(data.lengths.sd_mm, sigmas.ends_mm)
    columns = placed.columns(layout)
    return Block(
        "lengths",
        weight * (length - data.lengths.value_mm),
        np.concatenate([columns[0::2], columns[1::2]], axis=1),
        weight[:, None] * np.concatenate([slopes[0::2], slopes[1::2]], axis=1),
        np.full(len(length), -2),
        exact=True,
    )


def _ends(data: Data, s: State, camera: Intrinsics) -> tuple[Placed, Floats, Floats]:
    """The ends, the lengths (L,), and how a length follows each end (2 L, 3)."""
    placed = Placed.of(data.ends, s, camera)
    gap = placed.turned_back[0::2] - placed.turned_back[1::2]
    length = np.linalg.norm(gap, axis=1)
    along = np.repeat(gap / length[:, None], 2, axis=0)
    along[1::2] *= -1.0
    return placed, length, along


def ends_noise_mm(data: Data, layout: Layout, chart: Chart) -> Floats:
    """What the stripe's noise at both ends makes of each length (L,), 1 sigma at a state."""
    if not len(data.lengths.names):
        return np.zeros(0)
    camera = chart.state.intrinsics(data.width_px, data.height_px)
    placed, _, along = _ends(data, chart.state, camera)
    by_centre, _ = placed.follow(along, layout, chart, camera)
    noise = (data.ends.sigma_px * by_centre) ** 2
    return np.sqrt(noise[0::2] + noise[1::2])
