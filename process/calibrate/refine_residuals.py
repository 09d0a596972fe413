"""Residuals of the joint adjustment, each over its own sigma, with analytic derivatives.

Corners of boards, and of bodies that turn with the table, are reprojected; stripes and references have
files of their own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .pose import rotation_of, skew_of
from .projection import project_with_derivatives
from .refine_blocks import Block, Sigmas, block_columns, camera_columns
from .refine_data import Data
from .refine_references import length_residuals, sphere_residuals, wall_residuals
from .refine_state import Chart, Layout, State
from .refine_stripes import bend_residuals, stripe_residuals

Floats = npt.NDArray[np.float64]


def residuals(data: Data, layout: Layout, chart: Chart, sigmas: Sigmas) -> list[Block]:
    """All residuals at a state; NaN where the lens model cannot follow."""
    camera = chart.state.intrinsics(data.width_px, data.height_px)
    out = [_corners(data, layout, chart, sigmas.corner_px)]
    if len(data.stripes.on):
        out.append(stripe_residuals(data, layout, chart, camera, sigmas))
        out += bend_residuals(data, layout, chart.state, sigmas)
    if data.turned is not None:
        out += _turned(data, layout, chart, sigmas.turned_px)
    if len(data.walls.names):
        out += wall_residuals(data, layout, chart, camera, sigmas)
    if len(data.spheres.names):
        out += sphere_residuals(data, layout, chart, camera, sigmas)
    if len(data.lengths.names):
        out.append(length_residuals(data, layout, chart, camera, sigmas))
    return out


def _corners(data: Data, layout: Layout, chart: Chart, sigma: float) -> Block:
    c, s = data.corners, chart.state
    arm = np.einsum("nij,nj->ni", s.board_turns[c.board], c.points_mm)
    placed = arm + s.board_shifts_mm[c.board]
    with np.errstate(all="ignore"):
        seen, by_camera, by_pose = project_with_derivatives(s.camera, placed, arm)
    seen[placed[:, 2] <= 0] = np.nan
    by_pose[:, :, :3] = by_pose[:, :, :3] @ chart.by_board_turns[c.board]
    count = 2 * len(placed)
    slopes = np.concatenate([by_camera @ layout.free, by_pose], axis=2).reshape(count, -1)
    board = np.repeat(c.board, 2)
    columns = np.concatenate(
        [camera_columns(layout, count), block_columns(layout.boards.start, 6, board)], axis=1
    )
    return Block("corners", ((seen - c.seen_px) / sigma).ravel(), columns, slopes / sigma, board)


def _turned(data: Data, layout: Layout, chart: Chart, sigma: float) -> list[Block]:
    t, s = data.turned, chart.state
    assert t is not None
    each = np.array([rotation_of(s.direction * p) for p in s.phi_rad])
    turn = each[t.frame]
    grown = np.einsum("nij,nj->ni", s.body_turns[t.body], t.points_mm)
    arm_of_body = s.size * grown
    arm = arm_of_body + s.body_shifts_mm[t.body] - s.point_mm
    turned = np.einsum("nij,nj->ni", turn, arm)
    placed = s.point_mm + turned
    with np.errstate(all="ignore"):
        seen, by_camera, by_pose = project_with_derivatives(s.camera, placed, turned)
    seen[placed[:, 2] <= 0] = np.nan
    by_point = by_pose[:, :, 3:]
    spin = skew_of(s.direction) @ chart.by_direction
    by_turned = by_point @ turn
    parts = [
        by_camera @ layout.free,
        by_point @ ((np.eye(3) - turn) @ chart.by_point),
        by_point @ ((turn @ skew_of(arm) - skew_of(turned)) @ spin),
        -by_turned @ skew_of(arm_of_body) @ chart.by_body_turns[t.body],
        by_turned,
    ]
    count = 2 * len(placed)
    axis = np.broadcast_to(np.arange(layout.axis.start, layout.axis.stop), (count, 4))
    columns = [
        camera_columns(layout, count),
        axis,
        block_columns(layout.bodies.start, 6, np.repeat(t.body, 2)),
    ]
    if layout.phi:
        by_phi = np.einsum("nij,nj->ni", by_point, np.cross(s.direction, turned))
        parts.append(np.where((t.frame > 0)[:, None], by_phi, 0.0)[:, :, None])
        columns.append(layout.phi.start + np.maximum(np.repeat(t.frame, 2) - 1, 0)[:, None])
    if layout.size:
        parts.append(by_turned @ grown[:, :, None])
        columns.append(np.full((count, 1), layout.size.start))
    slopes = np.concatenate(parts, axis=2).reshape(count, -1) / sigma
    values = ((seen - t.seen_px) / sigma).ravel()
    where = np.concatenate(columns, axis=1)
    out = [Block("turning", values, where, slopes, np.full(count, -1))]
    if layout.phi:
        out.append(_angles(t.nominal_rad, t.sd_rad, layout, s))
    if layout.size:
        one = np.array([[1.0 / t.size_sd]])
        value = np.array([(s.size - 1.0) / t.size_sd])
        out.append(
            Block("size", value, np.array([[layout.size.start]]), one, np.array([-1]), exact=True)
        )
    return out


def _angles(nominal: Floats, sd: float, layout: Layout, s: State) -> Block:
    """Phi = scale nominal + offset, to ``sd``; phi of the first frame is 0 and no unknown."""
    count = len(nominal)
    value = (s.phi_rad - s.scale * nominal - s.offset_rad) / sd
    slopes = np.stack([np.ones(count), -nominal, -np.ones(count)], axis=1) / sd
    slopes[0, 0] = 0.0
    columns = np.stack(
        [
            layout.phi.start + np.maximum(np.arange(count) - 1, 0),
            np.full(count, layout.angles.start),
            np.full(count, layout.angles.start + 1),
        ],
        axis=1,
    )
    return Block("angles", value, columns, slopes, np.full(count, -1), exact=True)
