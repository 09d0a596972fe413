"""Where the joint adjustment begins: poses of boards and bodies from the calibration that is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Calibration
from ...schemas.errors import CalibrationError, InputError
from ..camera import undistort_points
from .axis import fit_axis
from .axis_adjust import Sightings
from .pose import board_poses, rotation_of
from .refine_blocks import Sigmas
from .refine_data import Data, Lit, Turned
from .refine_references import ends_noise_mm
from .refine_residuals import residuals
from .refine_state import Layout, State, moved

Floats = npt.NDArray[np.float64]

#: A corner is expected to be as good as this, or as bad.
_CORNER_PX = (0.02, 2.0)
#: Boards are rarely flatter; how flat these are is found from the stripes.
_FIRST_BEND_MM = (0.1, 0.1)


def first_state(data: Data, start: Calibration) -> State:
    """The state that ``start`` and single views make of boards and table; no references yet.

    Raises
    ------
    CalibrationError
        A board has no pose, or the turning fits no axis.
    """
    camera = start.intrinsics_or_fail()
    turns, shifts = [], []
    for number, name in enumerate(data.board_names):
        mine = data.corners.board == number
        try:
            pose = board_poses(data.corners.seen_px[mine], data.corners.points_mm[mine], camera)[0]
        except InputError as error:
            raise CalibrationError(f"the board in {name}: {error}", hint=error.hint) from error
        turns.append(pose.rotation)
        shifts.append(pose.translation_mm)
    axis = start.turntable
    point = np.array(axis.point_mm if axis is not None else (0.0, 0.0, 0.0), np.float64)
    direction = np.array(axis.direction if axis is not None else (0.0, -1.0, 0.0), np.float64)
    bodies, body_shifts, phi = np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0)
    scale, offset = 1.0, 0.0
    if data.turned is not None:
        assert axis is not None
        bodies, body_shifts, phi, point, direction = _turning(data.turned, start, point, direction)
        offset = float(np.mean(phi - data.turned.nominal_rad))
    return State(
        camera=np.array(
            [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew, *camera.distortion]
        ),
        normals=np.array([p.normal for p in start.lasers], np.float64).reshape(-1, 3),
        distances_mm=np.array([p.distance_mm for p in start.lasers], np.float64),
        point_mm=point,
        direction=direction,
        board_turns=np.array(turns),
        board_shifts_mm=np.array(shifts),
        body_turns=bodies,
        body_shifts_mm=body_shifts,
        phi_rad=phi,
        scale=scale,
        offset_rad=offset,
        size=1.0,
        wall_normals=np.zeros((0, 3)),
        wall_distances_mm=np.zeros(0),
        centres_mm=np.zeros((0, 3)),
        diameters_mm=np.zeros(0),
        bends_mm=np.zeros((len(data.board_of_stripe), 2)),
    )


def _turning(
    t: Turned, start: Calibration, point: Floats, direction: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Bodies, angles and axis as `calibrate axis` finds them; its direction as in ``start``."""
    axis = start.axis_or_fail()
    sightings = Sightings(t.frame, t.body, t.points_mm, t.seen_px)
    names = [str(k) for k in range(len(t.nominal_rad))]
    camera = start.intrinsics_or_fail().model_copy(update={"covariance": None})
    # Angles counted as the table turns, not as the head does: the sign is known by now.
    fit = fit_axis(sightings, names, t.nominal_rad, camera, head="fixed", angle_sd_rad=t.sd_rad)
    if len(fit.frames) < len(names):
        raise CalibrationError(
            f"{len(names) - len(fit.frames)} of {len(names)} frames of the turning table contradict "
            f"the others ({fit.left_out[0][1]})",
            hint="calibrate axis leaves such frames out before it saves its observations",
        )
    if (fit.positive_turn == "clockwise") == (fit.direction @ direction > 0):
        raise CalibrationError(
            f"the table turns the other way than the calibration says ({axis.positive_turn}, head "
            f"{axis.head})",
            hint="give the calibration that calibrate axis made from these observations",
        )
    flip = 1.0 if fit.direction @ direction > 0 else -1.0
    found = flip * fit.direction
    # The origin stays beside where it was.
    near = fit.point_mm + found * ((point - fit.point_mm) @ found)
    turning = fit.turning
    return turning.rotations, turning.translations_mm, flip * turning.phi_rad, near, found


def with_references(data: Data, state: State) -> State:
    """The state with walls through their stripes, and spheres through theirs.

    Raises
    ------
    CalibrationError
        A reference's stripe lies where laser and rays do not meet.
    """
    walls, distances = [], []
    for number, name in enumerate(data.walls.names):
        points = _points(data, data.wall_points, number, state, name)
        mine = data.wall_points.on == number
        sheets = np.stack([data.wall_points.laser[mine], data.wall_points.phi_rad[mine]])
        # One stripe is a line: of all planes through it the one that faces the camera's ray most.
        middle = points.mean(axis=0)
        size, axes = np.linalg.svd(points - middle, full_matrices=False)[1:]
        along = axes[0]
        wide = size[1] > 0.05 * np.linalg.norm(middle) * np.sqrt(len(points))
        several = np.unique(sheets, axis=1).shape[1] > 1
        normal = axes[2] if several and wide else middle - along * (middle @ along)
        normal = normal / np.linalg.norm(normal)
        normal = normal if normal @ middle > 0 else -normal
        walls.append(normal)
        distances.append(float(normal @ middle))
    centres = []
    for number, name in enumerate(data.spheres.names):
        points = _points(data, data.sphere_points, number, state, name)
        centres.append(_centre(points, 0.5 * float(data.spheres.value_mm[number])))
    return replace(
        state,
        diameters_mm=data.spheres.value_mm.copy(),
        wall_normals=np.array(walls).reshape(-1, 3),
        wall_distances_mm=np.array(distances),
        centres_mm=np.array(centres).reshape(-1, 3),
    )


def _points(data: Data, lit: Lit, number: int, state: State, name: str) -> Floats:
    """A reference's stripe points in camera space, turned back."""
    mine = lit.on == number
    camera = state.intrinsics(data.width_px, data.height_px)
    x, y = undistort_points(lit.u_px[mine], lit.v_px[mine], camera)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    normals, distances = state.normals[lit.laser[mine]], state.distances_mm[lit.laser[mine]]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = distances / np.einsum("ni,ni->n", normals, rays)
    out = np.where((depth > 0)[:, None], depth[:, None] * rays, np.nan)
    if not np.isfinite(out).all():
        raise CalibrationError(
            f"{name}: {int((~np.isfinite(out).all(axis=1)).sum())} of its stripe points lie beyond "
            "where the laser's plane and the rays meet",
            hint="is it the right laser, and the right calibration?",
        )
    arm = out - state.point_mm
    turned = [
        rotation_of(-state.direction * p) @ a for p, a in zip(lit.phi_rad[mine], arm, strict=True)
    ]
    return state.point_mm + np.array(turned)


def _centre(points: Floats, radius: float) -> Floats:
    """Centre of the sphere of this radius through points: behind their middle, then Gauss-Newton."""
    middle = points.mean(axis=0)
    centre = middle * (1.0 + radius / np.linalg.norm(middle))
    for _ in range(50):
        arm = points - centre
        reach = np.linalg.norm(arm, axis=1)
        step = np.linalg.lstsq(arm / reach[:, None], reach - radius, rcond=1e-6)[0]
        centre = centre + step
        if np.abs(step).max() < 1e-9:
            break
    return centre


def first_sigmas(data: Data, layout: Layout, state: State) -> Sigmas:
    """Sigmas to begin with: corners by their own residuals, stripes as stated."""
    chart = moved(state, layout, np.zeros(layout.width))
    noise = ends_noise_mm(data, layout, chart)
    plain = Sigmas(1.0, 1.0, 1.0, 1.0, 1.0, noise, *_FIRST_BEND_MM)
    spread = {
        b.kind: float(np.clip(1.4826 * np.nanmedian(np.abs(b.values)), *_CORNER_PX))
        for b in residuals(data, layout, chart, plain)
        if b.kind in ("corners", "turning")
    }
    return Sigmas(spread["corners"], spread.get("turning", 1.0), 1.0, 1.0, 1.0, noise, *_FIRST_BEND_MM)
