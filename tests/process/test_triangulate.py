"""Triangulation: the paper's formulas, both heads, rigid motion, uncertainty against simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.process.camera import project
from turnscan.process.stages import PointChain
from turnscan.process.triangulate import (
    intersect,
    scene_from_turntable,
    turntable_from_camera,
)
from turnscan.process.uncertainty import sigma_range_mm
from turnscan.schemas.calibration import (
    Calibration,
    Intrinsics,
    LaserPlane,
    PaperCalibration,
    TurntableAxis,
)
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.recipe import Extract, Recipe, Triangulate, Undistort

PAPER = PaperCalibration(
    rig="xiao",
    width_px=640,
    height_px=480,
    f_px=762.0,
    cx_px=320.0,
    cy_px=240.0,
    L_mm=300.0,
    D_mm=130.0,
    theta_rad=1.2,
    c_mm=17.0,
)
RECIPE = Recipe(name="t", stages=(Extract(), Undistort(), Triangulate()))


def stripes(u: np.ndarray, row: np.ndarray, angle: np.ndarray | float = 0.0) -> dict[str, np.ndarray]:
    n = len(u)
    return {
        "frame": np.zeros(n, np.uint32),
        "laser": np.zeros(n, np.uint8),
        "row": row.astype(np.uint16),
        "angle_rad": np.broadcast_to(np.float64(angle), n),
        "u_px": u,
        "sigma_u_px": np.full(n, 0.05),
        "amplitude_dn": np.ones(n),
        "width_px": np.ones(n),
        "flags": np.zeros(n, np.uint16),
    }


def papers_formulas(u: np.ndarray, v_up: np.ndarray, alpha: float) -> np.ndarray:
    """Formulas (2)-(5) as corrected in docs/conventions.md; u, v from the principal point, v up."""
    f, big_l, d, theta, c = PAPER.f_px, PAPER.L_mm, PAPER.D_mm, PAPER.theta_rad, PAPER.c_mm
    x = d - big_l / (1 + (u / f) * math.tan(theta))
    y = (d - x) * math.tan(theta)
    z = v_up * y / f
    return np.stack(
        [
            (y + c) * math.sin(alpha) + x * math.cos(alpha),
            (y + c) * math.cos(alpha) - x * math.sin(alpha),
            z,
        ],
        axis=1,
    )


@pytest.mark.parametrize("alpha", [0.0, 0.7, -2.0])
def test_the_papers_model_is_a_special_case(alpha: float) -> None:
    u = np.linspace(-100.0, 280.0, 12)
    row = np.arange(12) * 40
    expected = papers_formulas(u, 240.0 - row, alpha)
    p = PointChain(RECIPE, PAPER.calibration()).points(stripes(u + 320.0, row, alpha))
    found = np.stack([p["x_mm"], p["y_mm"], p["z_mm"]], axis=1)
    assert np.allclose(found, expected, rtol=1e-12, atol=1e-9)


def test_the_cloud_is_not_mirrored() -> None:
    """Three points to the right of, above and behind each other keep their handedness."""
    plane = LaserPlane(laser=0, normal=(1.0, 0.0, 0.0), distance_mm=50.0)
    p = intersect([0.1, 0.1, 0.05], [0.0, -0.1, 0.0], plane)
    table = turntable_from_camera(TurntableAxis(point_mm=(0, 0, 0), direction=(0, -1, 0)))
    a, up, far = table(p)
    assert up[2] > a[2], "higher in the picture (smaller v) is higher in the scene"
    assert far[1] > a[1], "farther from the camera is farther along y"
    assert np.linalg.det(table.rotation) == pytest.approx(1.0)


def test_head_and_turn_decide_the_sign() -> None:
    x = np.array([[100.0, 0.0, 5.0]])
    for head, turn, expected in (
        ("fixed", "counterclockwise", [0.0, -100.0, 5.0]),
        ("fixed", "clockwise", [0.0, 100.0, 5.0]),
        ("rotates", "counterclockwise", [0.0, 100.0, 5.0]),
        ("rotates", "clockwise", [0.0, -100.0, 5.0]),
    ):
        axis = TurntableAxis(point_mm=(0, 0, 0), direction=(0, -1, 0), head=head, positive_turn=turn)
        assert scene_from_turntable(x, math.pi / 2, axis)[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("head", "turn", "sense"),
    [
        ("fixed", "counterclockwise", 1),
        ("fixed", "clockwise", -1),
        ("rotates", "counterclockwise", -1),
        ("rotates", "clockwise", 1),
    ],
)
def test_a_mark_seen_at_several_angles_is_one_point(head: str, turn: str, sense: int) -> None:
    """``sense``: which way a mark of the scene moves in turntable space as the angle grows.

    An object carries its marks with it; a turning head sees a standing mark move the other way.
    """
    axis = TurntableAxis(
        point_mm=(10.0, 30.0, 400.0), direction=(0.0, -0.8, -0.6), head=head, positive_turn=turn
    )
    table = turntable_from_camera(axis)
    mark = np.array([40.0, 15.0, 20.0])
    for angle in (0.0, 0.5, 3.0):
        c, s = math.cos(sense * angle), math.sin(sense * angle)
        moved = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ mark
        seen = (moved - table.translation_mm) @ table.rotation  # turntable to camera space
        assert scene_from_turntable(table(seen[None]), angle, axis)[0] == pytest.approx(mark)


@settings(max_examples=50, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-500, 500)] * 3),
    angle=st.floats(-7, 7),
)
def test_rigid_motion_of_the_axis_is_rigid_motion_of_the_cloud(
    turn: tuple[float, ...], shift: tuple[float, ...], angle: float
) -> None:
    import cv2

    rotation, _ = cv2.Rodrigues(np.array(turn))
    direction = rotation @ np.array([0.0, -1.0, 0.0])
    x_direction = rotation @ np.array([1.0, 0.0, 0.0])
    a = TurntableAxis(point_mm=(0, 0, 0), direction=(0, -1, 0))
    b = TurntableAxis(point_mm=shift, direction=tuple(direction), x_direction=tuple(x_direction))
    rng = np.random.default_rng(0)
    points = rng.uniform(-200, 200, (20, 3))
    moved = points @ rotation.T + np.array(shift)
    one = scene_from_turntable(turntable_from_camera(a)(points), angle, a)
    two = scene_from_turntable(turntable_from_camera(b)(moved), angle, b)
    assert np.allclose(one, two, atol=1e-9)


def test_rays_beside_and_behind_give_no_point() -> None:
    plane = LaserPlane(laser=0, normal=(1.0, 0.0, 0.0), distance_mm=50.0)
    p = intersect([0.0, -0.1, 0.1], [0.0, 0.0, 0.0], plane)
    assert np.isnan(p[:2]).all()
    assert p[2] == pytest.approx([50.0, 0.0, 500.0])


def test_limits_drop_and_count() -> None:
    recipe = Recipe(
        name="t",
        stages=(Extract(), Undistort(), Triangulate(min_range_mm=700, max_range_mm=1500)),
    )
    chain = PointChain(recipe, PAPER.calibration())
    u = np.linspace(330.0, 600.0, 50)
    p = chain.points(stripes(u, np.full(50, 240)))
    assert len(p["x_mm"]) + chain.dropped == 50
    assert chain.dropped > 0
    assert p["range_mm"].min() >= 700
    assert p["range_mm"].max() <= 1500


def test_a_laser_without_plane_is_an_error() -> None:
    columns = stripes(np.array([400.0]), np.array([10]))
    columns["laser"][:] = 3
    with pytest.raises(CalibrationError, match="no plane of laser 3"):
        PointChain(RECIPE, PAPER.calibration()).points(columns)


def test_horizontal_stripes_exchange_u_and_v() -> None:
    camera = Intrinsics(width_px=640, height_px=480, fx_px=700, fy_px=700, cx_px=320, cy_px=240)
    calibration = Calibration(
        rig="h",
        camera=camera,
        lasers=(LaserPlane(laser=0, normal=(0.0, 0.6, 0.8), distance_mm=300.0),),
        turntable=TurntableAxis(point_mm=(0, 0, 400), direction=(0, -1, 0)),
    )
    recipe = Recipe(name="h", stages=(Extract(orientation="horizontal"), Undistort(), Triangulate()))
    truth = intersect(np.array([0.1, -0.2]), np.array([0.05, 0.1]), calibration.lasers[0])
    u, v = project(truth, camera)
    p = PointChain(recipe, calibration).points(stripes(v, np.rint(u)))
    # u was rounded to whole columns, so only what does not depend on it is compared.
    scene = turntable_from_camera(calibration.axis_or_fail())(truth)
    assert p["y_mm"] == pytest.approx(scene[:, 1], abs=1e-6)


COVARIANCE_CAMERA = np.diag([1.0, 1.0, 0.5, 0.5, 1e-6, 1e-4, 1e-3, 1e-6, 1e-6, 1e-3])
COVARIANCE_PLANE = np.diag([1e-6, 1e-6, 1e-6, 0.04])


def test_sigma_range_is_what_a_simulation_gives() -> None:
    base = PAPER.calibration()
    assert base.camera is not None
    camera = base.camera.model_copy(
        update={"covariance": tuple(map(tuple, COVARIANCE_CAMERA.tolist()))}
    )
    plane = base.lasers[0].model_copy(
        update={"covariance": tuple(map(tuple, COVARIANCE_PLANE.tolist()))}
    )
    u, v = np.array([380.0, 500.0]), np.array([100.0, 300.0])
    predicted = sigma_range_mm(u, v, np.full(2, 0.1), along_v=False, camera=camera, plane=plane)
    rng = np.random.default_rng(3)
    ranges = []
    for _ in range(4000):
        dc = rng.multivariate_normal(np.zeros(10), COVARIANCE_CAMERA)
        dp = rng.multivariate_normal(np.zeros(4), COVARIANCE_PLANE)
        moved = camera.model_copy(
            update={
                "fx_px": camera.fx_px + dc[0],
                "fy_px": camera.fy_px + dc[1],
                "cx_px": camera.cx_px + dc[2],
                "cy_px": camera.cy_px + dc[3],
                "skew": dc[4],
                "distortion": tuple(dc[5:]),
            }
        )
        other = plane.model_copy(
            update={
                "normal": tuple(np.array(plane.normal) + dp[:3]),
                "distance_mm": plane.distance_mm + dp[3],
            }
        )
        from turnscan.process.camera import undistort_points
        from turnscan.process.triangulate import range_of

        noisy = u + rng.normal(0, 0.1, 2)
        ranges.append(range_of(intersect(*undistort_points(noisy, v, moved), other)))
    observed = np.std(np.array(ranges), axis=0)
    assert observed / predicted == pytest.approx([1.0, 1.0], abs=0.06)


def test_sensitivity_is_the_papers() -> None:
    """|dy/du| = y^2 / (L f) on the row of the principal point, for the exact stripe centre."""
    calibration = PAPER.calibration()
    u = np.array([330.0])
    p = PointChain(RECIPE, calibration).points(stripes(u, np.array([240])))
    depth = intersect(np.array([10.0 / 762.0]), np.array([0.0]), calibration.lasers[0])[0, 2]
    expected = 0.05 * depth**2 / (PAPER.L_mm * PAPER.f_px)
    assert p["sigma_range_mm"][0] == pytest.approx(expected, rel=0.02)
