"""Stripe points on flat surfaces: where in its row a stripe should be, and how that follows everything.

A stripe point lies on the laser's plane n.X = h and on a surface m.X = d, so its ray r makes
g = (h m - d n).r zero. The residual is how far, in the stripe's row, the seen centre is from the place
where g is zero, and all slopes are taken there: slopes at the seen, noisy place would pull the planes
(errors in variables: 60 mm at 7 m for 0.1 px).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ..camera import undistort_points
from ..uncertainty import through_lens
from .refine_blocks import Block, Sigmas, block_columns, camera_columns
from .refine_data import Data, Lit
from .refine_state import Chart, Layout, State

Floats = npt.NDArray[np.float64]

#: Newton's steps to where a stripe should be; the last one is in the residual itself.
NEWTON = 2
FARTHEST_PX = 20.0


@dataclass(frozen=True)
class Crossing:
    """Rays of stripe points with the laser planes they belong to."""

    rays: Floats
    normals: Floats
    distances: Floats
    xy: tuple[Floats, Floats]


def crossing_of(lit: Lit, s: State, camera: Intrinsics) -> Crossing:
    """The rays of stripe points, and the planes of their lasers at a state."""
    x, y = undistort_points(lit.u_px, lit.v_px, camera)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    return Crossing(rays, s.normals[lit.laser], s.distances_mm[lit.laser], (x, y))


def through_camera(
    lit: Lit, c: Crossing, gx: Floats, gy: Floats, camera: Intrinsics
) -> tuple[Floats, Floats]:
    """Derivatives by the stripe's centre (N,) and by the camera's ten numbers (N, 10)."""
    by_camera = np.empty((len(gx), 10))
    by_u, by_v = through_lens(gx, gy, *c.xy, lit.u_px, lit.v_px, camera, by_camera)
    return np.where(lit.along_v, by_v, by_u), by_camera


def on_surface(
    lit: Lit, c: Crossing, surface: Floats, offset: Floats, camera: Intrinsics
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """G for points on the surfaces ``m.X = offset`` and its derivatives.

    By the stripe's centre, the camera (N, 10), n (N, 3), h (N,); and h r, of which those by m are made.
    """
    q = c.distances[:, None] * surface - offset[:, None] * c.normals
    value = np.einsum("ni,ni->n", q, c.rays)
    by_centre, by_camera = through_camera(lit, c, q[:, 0], q[:, 1], camera)
    by_normal = -offset[:, None] * c.rays
    by_distance = np.einsum("ni,ni->n", surface, c.rays)
    return value, by_centre, by_camera, by_normal, by_distance, c.distances[:, None] * c.rays


def placed_at(
    lit: Lit, s: State, surface: Floats, offset: Floats, camera: Intrinsics
) -> tuple[Lit, Floats]:
    """The stripe points moved, each in its row, to where g is zero (two of Newton's steps of three).

    And how far they were moved, px.
    """
    seen = np.where(lit.along_v, lit.v_px, lit.u_px)
    at, moved = lit, np.zeros_like(seen)
    for _ in range(NEWTON):
        value, by_centre, *_ = on_surface(at, crossing_of(at, s, camera), surface, offset, camera)
        moved = moved - np.clip(value / by_centre, -FARTHEST_PX, FARTHEST_PX)
        at = shifted(lit, seen + moved)
    return at, moved


def shifted(lit: Lit, centre_px: Floats) -> Lit:
    """The same points with other centres, along u or v as each has it."""
    return replace(
        lit,
        u_px=np.where(lit.along_v, lit.u_px, centre_px),
        v_px=np.where(lit.along_v, centre_px, lit.v_px),
    )


def plane_slopes(lit: Lit, chart: Chart, by_normal: Floats, by_distance: Floats) -> Floats:
    """Derivatives (N, 3) by a plane's two tangents and its distance."""
    bent = np.einsum("ni,nij->nj", by_normal, chart.by_normals[lit.laser])
    return np.concatenate([bent, by_distance[:, None]], axis=1)


def bend_residuals(data: Data, layout: Layout, s: State, sigmas: Sigmas) -> list[Block]:
    """What the surfaces under the stripes are off their boards' planes: nothing, to bend and twist."""
    number = np.arange(len(data.board_of_stripe))
    out = []
    for k, (kind, sd) in enumerate((("bends", sigmas.bend_mm), ("twists", sigmas.twist_mm))):
        columns = (layout.bends.start + 2 * number + k)[:, None]
        slopes = np.full((len(number), 1), 1.0 / sd)
        out.append(Block(kind, s.bends_mm[:, k] / sd, columns, slopes, data.board_of_stripe))
    return out


def stripe_residuals(
    data: Data, layout: Layout, chart: Chart, camera: Intrinsics, sigmas: Sigmas
) -> Block:
    """Stripes on boards: how far each centre is from where laser and board say, in sigmas."""
    lit, s = data.stripes, chart.state
    facing, shift = s.board_turns[lit.on, :, 2], s.board_shifts_mm[lit.on]
    bends = s.bends_mm[data.stripe]
    offset = np.einsum("ni,ni->n", facing, shift) + bends[:, 0] + data.along * bends[:, 1]
    lit, gone = placed_at(lit, s, facing, offset, camera)
    c = crossing_of(lit, s, camera)
    value, by_centre, by_camera, by_normal, by_distance, by_m = on_surface(
        lit, c, facing, offset, camera
    )
    along = np.einsum("ni,ni->n", c.normals, c.rays)[:, None]
    turned = np.cross(facing, by_m - along * shift)
    by_turn = np.einsum("ni,nij->nj", turned, chart.by_board_turns[lit.on])
    slopes = np.concatenate(
        [
            by_camera @ layout.free,
            plane_slopes(lit, chart, by_normal, by_distance),
            by_turn,
            -along * facing,
            -along,
            -along * data.along[:, None],
        ],
        axis=1,
    )
    sigma = sigmas.stripe * np.sqrt(sigmas.memory) * lit.sigma_px
    weight = 1.0 / (sigma * by_centre)
    columns = np.concatenate(
        [
            camera_columns(layout, len(value)),
            block_columns(layout.planes.start, 3, lit.laser),
            block_columns(layout.boards.start, 6, lit.on),
            block_columns(layout.bends.start, 2, data.stripe),
        ],
        axis=1,
    )
    return Block("stripes", weight * value - gone / sigma, columns, weight[:, None] * slopes, lit.on)
