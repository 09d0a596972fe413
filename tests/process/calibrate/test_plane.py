"""The laser's plane: exact without noise, honest with it, not fooled by other lines, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from posed import BOARD, CAMERA, DISTANCE, NORMAL, plane_views, random_pose, stripe_on

from turnscan.process.calibrate.plane import PlaneFit, fit_planes
from turnscan.process.calibrate.plane_consensus import PlaneView
from turnscan.process.calibrate.pose import board_poses, rotation_of
from turnscan.process.calibrate.stripe_lines import StripeLine, find_stripe_lines
from turnscan.process.camera import project, undistort_points
from turnscan.schemas.calibration import Intrinsics
from turnscan.schemas.errors import CalibrationError


def in_sigmas(fit: PlaneFit, covariance: np.ndarray) -> np.ndarray:
    """The three errors of a plane along the axes of its covariance, in their own sigmas."""
    error = np.append(fit.normal - NORMAL, fit.distance_mm - DISTANCE)
    size, axes = np.linalg.eigh(covariance)
    # The normal keeps its length: one of the four directions is empty.
    return (axes[:, 1:].T @ error) / np.sqrt(size[1:])


def test_exact_views_give_the_exact_plane() -> None:
    views = plane_views(np.random.default_rng(3), 6, corner_px=0.0, stripe_px=1e-9)
    (fit,) = fit_planes(views, CAMERA)
    assert np.abs(fit.normal - NORMAL).max() < 1e-8
    assert abs(fit.distance_mm - DISTANCE) < 1e-5
    assert fit.used == 6
    assert not fit.left_out
    assert np.linalg.eigvalsh(fit.covariance).min() > -1e-12


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**20), turn=st.tuples(*[st.floats(-0.3, 0.3)] * 3))
def test_the_order_and_turn_of_the_board_do_not_matter(
    seed: int, turn: tuple[float, float, float]
) -> None:
    """Board space is the board's own business: turned and shifted, the same plane comes out."""
    views = plane_views(np.random.default_rng(seed), 5, corner_px=0.05)
    own, shift = rotation_of(np.array(turn)), np.array([30.0, -12.0, 8.0])
    moved = []
    for v in reversed(views):
        board = v.board_mm @ own.T + shift
        pose = board_poses(v.corners_px, v.board_mm, CAMERA)[0]
        turned = type(pose)(
            pose.rotation @ own.T,
            pose.translation_mm - pose.rotation @ own.T @ shift,
            pose.normal_matrix,
            pose.residuals_px,
        )
        assert np.allclose(turned.to_camera(board), v.pose.to_camera(v.board_mm), atol=1e-9)
        moved.append(v)
    (one,), (two,) = fit_planes(views, CAMERA), fit_planes(moved, CAMERA)
    assert np.abs(one.normal - two.normal).max() < 1e-7
    assert one.distance_mm == pytest.approx(two.distance_mm, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("board_error_mm", "seed"), [(0.0, 0), (0.5, 5000)])
def test_stated_covariance_is_what_repeats_scatter(board_error_mm: float, seed: int) -> None:
    """Also when boards are bent, which nobody told the fit: the views' own scatter must show it."""
    runs = 24
    off = []
    for k in range(runs):
        views = plane_views(np.random.default_rng(seed + k), 12, board_error_mm=board_error_mm)
        (fit,) = fit_planes(views, CAMERA)
        off.append(in_sigmas(fit, fit.conditional))
    ratio = float(np.sqrt(np.mean(np.square(off))))
    # 72 numbers: their rms scatters by 8 %.
    assert 0.8 < ratio < 1.25, ratio


@pytest.mark.slow
def test_covariance_carries_the_camera() -> None:
    """With a camera that is wrong within its own sigmas, the plane is within its own, too."""
    sigma = np.diag([3.0, 3.0, 4.0, 4.0, 1e-9, 2e-3, 2e-3, 1e-4, 1e-4, 1e-3]) ** 2
    off = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        wrong = rng.standard_normal(10) * np.sqrt(np.diag(sigma))
        lens = np.array(CAMERA.distortion) + wrong[5:]
        believed = CAMERA.model_copy(
            update={
                "fx_px": CAMERA.fx_px + wrong[0],
                "fy_px": CAMERA.fy_px + wrong[1],
                "cx_px": CAMERA.cx_px + wrong[2],
                "cy_px": CAMERA.cy_px + wrong[3],
                "distortion": tuple(lens),
                "covariance": tuple(map(tuple, sigma.tolist())),
            }
        )
        views = plane_views(rng, 10, known=believed)
        (fit,) = fit_planes(views, believed)
        off.append(in_sigmas(fit, fit.covariance))
        # Leaving the camera out would claim far too much.
        assert fit.covariance[2, 2] > 3 * fit.conditional[2, 2]
    ratio = float(np.sqrt(np.mean(np.square(off))))
    assert 0.7 < ratio < 1.35, ratio


def fixed_line(u0: float, slope: float) -> StripeLine:
    """A straight line that stands still in the image: on a wall behind the board, or a door frame."""
    v = np.arange(50.0, 900.0, 2.0)
    _, yn = undistort_points(np.zeros_like(v), v, CAMERA)
    x = (u0 - CAMERA.cx_px) / CAMERA.fx_px + slope * yn
    u, _ = project(np.stack([x, yn, np.ones_like(x)], axis=1), CAMERA)
    rays = np.stack(undistort_points(u, v, CAMERA), axis=1)
    return StripeLine(
        u, v, np.full(len(v), 0.05), rays, along_v=False, straightness_px=0.05, contrast_dn=200.0
    )


def test_a_brighter_line_that_stands_still_is_not_the_laser() -> None:
    """Its rays make a plane through the camera's centre, on which every board puts it perfectly."""
    wall = fixed_line(300.0, 0.02)
    views = [
        PlaneView(v.name, v.pose, v.corners_px, v.board_mm, (wall, *v.lines))
        for v in plane_views(np.random.default_rng(8), 8)
    ]
    (fit,) = fit_planes(views, CAMERA)
    assert np.linalg.norm(np.cross(fit.normal, NORMAL)) < 2e-3
    only = [PlaneView(v.name, v.pose, v.corners_px, v.board_mm, (wall,)) for v in views]
    with pytest.raises(CalibrationError, match="no 3 views agree") as caught:
        fit_planes(only, CAMERA)
    assert "wall" in str(caught.value.hint)


def test_a_view_whose_board_moved_is_left_out_by_name() -> None:
    views = plane_views(np.random.default_rng(11), 10)
    rotation, translation = random_pose(np.random.default_rng(99), (500.0, 600.0))
    line = stripe_on(rotation, translation, np.random.default_rng(1))
    assert line is not None
    u, v = project(BOARD @ rotation.T + translation + rotation[:, 2] * 4.0, CAMERA)
    corners = np.stack([u, v], axis=1)
    pose = board_poses(corners, BOARD, CAMERA)[0]
    views.insert(4, PlaneView("moved.png", pose, corners, BOARD, (line,)))
    (fit,) = fit_planes(views, CAMERA)
    assert [name for name, _ in fit.left_out] == ["moved.png"]
    assert fit.used == 10
    assert np.abs(in_sigmas(fit, fit.conditional)).max() < 4


def test_two_lasers_in_every_frame_are_told_apart_by_place() -> None:
    other = np.array([0.90, -0.05, 0.42]) / np.linalg.norm([0.90, -0.05, 0.42])
    views = []
    rng = np.random.default_rng(21)
    while len(views) < 7:
        rotation, translation = random_pose(rng, (400.0, 800.0))
        one = stripe_on(rotation, translation, rng)
        two = stripe_on(rotation, translation, rng, normal=other, distance=300.0)
        u, v = project(BOARD @ rotation.T + translation, CAMERA)
        if one is None or two is None:
            continue
        corners = np.stack([u, v], axis=1)
        pose = board_poses(corners, BOARD, CAMERA)[0]
        views.append(PlaneView(f"v{len(views)}", pose, corners, BOARD, (two, one)))
    left, right = fit_planes(views, CAMERA, lasers=2)
    assert np.linalg.norm(np.cross(left.normal, NORMAL)) < 2e-3
    assert np.linalg.norm(np.cross(right.normal, other)) < 2e-3
    with pytest.raises(CalibrationError):
        fit_planes(views, CAMERA, lasers=3)


def test_boards_in_one_plane_are_refused_with_the_mm_at_stake() -> None:
    rotation, translation = random_pose(np.random.default_rng(0), (600.0, 600.0))
    poses = [(rotation, translation + rotation @ np.array([k * 2.0, k * 3.0, 0.0])) for k in range(6)]
    with pytest.raises(CalibrationError, match=r"nearly on one line .* mm at") as caught:
        fit_planes(plane_views(np.random.default_rng(4), 6, poses=poses), CAMERA)
    assert "nearer and farther" in str(caught.value.hint)


def test_two_views_are_too_few() -> None:
    with pytest.raises(CalibrationError, match="in 2 of 2 views, 3 at least"):
        fit_planes(plane_views(np.random.default_rng(4), 2), CAMERA)


@pytest.mark.parametrize("horizontal", [False, True])
def test_stripes_are_found_to_a_tenth_of_a_pixel(horizontal: bool) -> None:
    """Rendered through the lens, faint on a bright, uneven ground, beside a brighter short piece."""
    rng = np.random.default_rng(5)
    camera = Intrinsics(
        width_px=640, height_px=480, fx_px=620.0, fy_px=618.0, cx_px=322.0, cy_px=239.0,
        distortion=(0.11, -0.19, -0.001, -0.002, -0.03),
    )  # fmt: skip
    t = np.linspace(-0.55, 0.55, 4000)
    ray = np.stack([t, 0.05 + 0.1 * t], axis=1) if horizontal else np.stack([-0.1 + 0.1 * t, t], axis=1)
    u, v = project(np.concatenate([ray, np.ones((len(t), 1))], axis=1), camera)
    along, across = (u, v) if horizontal else (v, u)
    shape = (camera.height_px, camera.width_px)
    grid = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    where = np.interp(grid[1 if horizontal else 0], along, across)
    image = (
        120 + 0.05 * grid[1] + 60 * np.exp(-0.5 * ((grid[0 if horizontal else 1] - where) / 1.5) ** 2)
    )
    image[200:230, 400:404] += 90
    frame = np.clip(np.rint(image + rng.normal(0, 2, shape)), 0, 255).astype(np.uint8)
    lines = find_stripe_lines(frame, camera, horizontal=horizontal)
    best = lines[0]
    expected = np.interp(best.u_px if horizontal else best.v_px, along, across)
    error = (best.v_px if horizontal else best.u_px) - expected
    assert len(error) > 400
    assert best.along_v is horizontal
    assert abs(float(np.mean(error))) < 0.02
    assert float(np.sqrt(np.mean(error**2))) < 0.12
