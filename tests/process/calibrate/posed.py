"""Boards, stripes and turning markers as an exact camera would see them, with noise as stated."""

from __future__ import annotations

import numpy as np

from turnscan.process.calibrate.axis_adjust import Sightings
from turnscan.process.calibrate.markers import marker_points_mm
from turnscan.process.calibrate.plane_consensus import PlaneView
from turnscan.process.calibrate.pose import board_poses, rotation_of
from turnscan.process.calibrate.stripe_lines import StripeLine
from turnscan.process.camera import project, undistort_points
from turnscan.schemas.calibration import Intrinsics

CAMERA = Intrinsics(
    width_px=1280,
    height_px=960,
    fx_px=1430.0,
    fy_px=1425.0,
    cx_px=650.0,
    cy_px=470.0,
    skew=0.001,
    distortion=(-0.12, 0.08, 0.0005, -0.0004, 0.01),
)
#: A laser 150 mm beside the camera, its sheet tilted towards the middle of the view.
NORMAL = np.array([0.93, -0.08, 0.36])
NORMAL = NORMAL / np.linalg.norm(NORMAL)
DISTANCE = 200.0

BOARD = np.stack(
    [*(a.ravel() * 20.0 for a in np.meshgrid(np.arange(9.0), np.arange(6.0))), np.zeros(54)], axis=1
)


def stripe_on(
    rotation: np.ndarray,
    translation: np.ndarray,
    rng: np.random.Generator,
    *,
    normal: np.ndarray = NORMAL,
    distance: float = DISTANCE,
    sigma_px: float = 0.1,
    camera: Intrinsics = CAMERA,
) -> StripeLine | None:
    """Where a laser's plane meets a board of 320 x 260 mm, a point every half mm, noise along u."""
    facing, offset = rotation[:, 2], float(rotation[:, 2] @ translation)
    along = np.cross(normal, facing)
    along = along / np.linalg.norm(along)
    start = np.linalg.solve(np.stack([normal, facing, along]), [distance, offset, along @ translation])
    points = start + np.linspace(-300, 300, 1201)[:, None] * along
    flat = (points - translation) @ rotation
    inside = (np.abs(flat[:, 0] - 80) < 160) & (np.abs(flat[:, 1] - 50) < 130)
    u, v = project(points[inside], camera)
    seen = np.isfinite(u) & (u > 5) & (u < camera.width_px - 5) & (v > 5) & (v < camera.height_px - 5)
    if seen.sum() < 60:
        return None
    u, v = u[seen] + sigma_px * rng.standard_normal(int(seen.sum())), v[seen]
    xn, yn = undistort_points(u, v, camera)
    return StripeLine(
        u,
        v,
        np.full(len(u), sigma_px),
        np.stack([xn, yn], axis=1),
        along_v=False,
        straightness_px=0.1,
        contrast_dn=80.0,
    )


def random_pose(rng: np.random.Generator, reach: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A board turned by up to 30 degrees, its middle near the sheet at a random range."""
    rotation = rotation_of(rng.uniform(-0.5, 0.5, 3))
    depth = rng.uniform(*reach)
    middle = np.array([0.0, rng.uniform(-0.1, 0.1) * depth, depth])
    middle[0] = (DISTANCE - NORMAL[1] * middle[1] - NORMAL[2] * depth) / NORMAL[0] + rng.uniform(
        -60, 60
    )
    return rotation, middle - rotation @ np.array([80.0, 50.0, 0.0])


def plane_views(
    rng: np.random.Generator,
    count: int,
    *,
    corner_px: float = 0.1,
    stripe_px: float = 0.1,
    reach: tuple[float, float] = (400.0, 800.0),
    camera: Intrinsics = CAMERA,
    known: Intrinsics | None = None,
    poses: list[tuple[np.ndarray, np.ndarray]] | None = None,
    board_error_mm: float = 0.0,
) -> list[PlaneView]:
    """Views whose corners and stripes carry noise; ``known`` is the camera that the fit believes in."""
    out: list[PlaneView] = []
    believed = known or camera
    while len(out) < count:
        rotation, translation = poses[len(out)] if poses else random_pose(rng, reach)
        u, v = project(BOARD @ rotation.T + translation, camera)
        corners = np.stack([u, v], axis=1)
        visible = (corners > 0).all() and (u < camera.width_px).all() and (v < camera.height_px).all()
        moved = (
            translation + rotation[:, 2] * rng.normal(0, board_error_mm)
            if board_error_mm
            else translation
        )
        line = stripe_on(rotation, moved, rng, sigma_px=stripe_px, camera=camera)
        if line is None or not visible:
            assert poses is None, "a given pose is out of view"
            continue
        corners = corners + corner_px * rng.standard_normal(corners.shape)
        if known is not None:
            xn, yn = undistort_points(line.u_px, line.v_px, known)
            line = StripeLine(
                line.u_px,
                line.v_px,
                line.sigma_px,
                np.stack([xn, yn], axis=1),
                along_v=False,
                straightness_px=0.1,
                contrast_dn=80.0,
            )
        pose = board_poses(corners, BOARD, believed)[0]
        out.append(PlaneView(f"view{len(out)}", pose, corners, BOARD, (line,)))
    return out


#: An axis as a desk scanner has it: leaning, half a metre away.
AXIS_POINT = np.array([15.0, 60.0, 450.0])
AXIS_DIRECTION = np.array([0.04, -0.92, -0.38]) / np.linalg.norm([0.04, -0.92, -0.38])


def turning_markers(
    rng: np.random.Generator,
    angles_rad: np.ndarray,
    *,
    sigma_px: float = 0.15,
    side_mm: float = 30.0,
    sense: int = 1,
    camera: Intrinsics = CAMERA,
    point: np.ndarray = AXIS_POINT,
    direction: np.ndarray = AXIS_DIRECTION,
) -> Sightings:
    """Four markers on a table that turns by ``sense * angle``, right-handed about the direction."""
    up = direction
    x = np.cross(up, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    # Seen from outside: a marker's own z points into the table.
    table = np.stack([x, -np.cross(up, x), -up], axis=1)
    frames, bodies, places, seen = [], [], [], []
    for k, angle in enumerate(angles_rad):
        turn = rotation_of(up * sense * angle)
        for m, (radius, around) in enumerate(((70, 0.1), (65, 1.7), (72, 3.2), (68, 4.8))):
            own = rotation_of(np.array([0.0, 0.0, 0.3 * m]))
            centre = radius * np.array([np.cos(around), np.sin(around), 0.0])
            placed = (marker_points_mm(side_mm) @ own.T + centre) @ table.T
            u, v = project(placed @ turn.T + point, camera)
            pixels = np.stack([u, v], axis=1) + sigma_px * rng.standard_normal((4, 2))
            frames += [k] * 4
            bodies += [m] * 4
            places.append(marker_points_mm(side_mm))
            seen.append(pixels)
    return Sightings(np.array(frames), np.array(bodies), np.concatenate(places), np.concatenate(seen))
