"""The least squares behind `calibrate camera`: exact on exact points, honest about noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered_boards import CHESS, HEIGHT, TRUTH, WIDTH, intrinsics_of, made_views

from turnscan.process.calibrate.boards import BoardView
from turnscan.process.calibrate.camera import CameraEstimate, calibrate_camera
from turnscan.process.calibrate.camera_quality import CameraLimits, camera_quality, coverage
from turnscan.process.calibrate.covariance import ray_sigma_mm_per_m
from turnscan.process.calibrate.projection import (
    NAMES,
    project_points,
    project_with_derivatives,
    rotation_of,
)
from turnscan.process.camera import project
from turnscan.schemas.board import Board
from turnscan.schemas.errors import CalibrationError, InputError

FREE = ()  # nothing held: skew is estimated


def off_in_sigmas(estimate: CameraEstimate) -> np.ndarray:
    spread = np.sqrt(np.diag(estimate.uncertainty.covariance))
    return (estimate.bundle.camera - TRUTH) / np.where(spread > 0, spread, np.inf)


def moved(view: BoardView, by_px: np.ndarray, only: Sequence[int] | slice = slice(None)) -> BoardView:
    points = view.points_px.copy()
    points[only] += by_px
    return replace(view, points_px=points)


def test_projection_is_that_of_the_camera_model() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform((-100, -100, 300), (100, 100, 500), (50, 3))
    u, v = project(points, intrinsics_of(TRUTH))
    assert np.abs(project_points(TRUTH, points) - np.stack([u, v], axis=1)).max() < 1e-10


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_derivatives_are_those_of_the_projection(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = TRUTH * (1 + rng.normal(0, 0.1, 10)) + rng.normal(0, 0.01, 10)
    turned = rng.uniform(-80, 80, (5, 3))
    shift = np.array([rng.uniform(-50, 50), rng.uniform(-50, 50), rng.uniform(300, 600)])
    pixels, by_camera, by_pose = project_with_derivatives(camera, turned + shift, turned)
    assert np.allclose(pixels, project_points(camera, turned + shift), atol=1e-9)
    for i in range(10):
        step = np.zeros(10)
        step[i] = 1e-6 * max(1.0, abs(camera[i]))
        there = project_points(camera + step, turned + shift)
        back = project_points(camera - step, turned + shift)
        assert np.allclose((there - back) / (2 * step[i]), by_camera[:, :, i], rtol=1e-5, atol=1e-4)
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-6 if i < 3 else 1e-4

        def at(p: np.ndarray) -> np.ndarray:
            return project_points(camera, turned @ rotation_of(p[:3]).T + shift + p[3:])

        slope = (at(step) - at(-step)) / (2 * step[i])
        assert np.allclose(slope, by_pose[:, :, i], rtol=1e-4, atol=1e-3)


def test_rotations_are_rotations() -> None:
    turns = rotation_of(np.array([[0, 0, 0], [1e-10, 0, 0], [0.3, -0.2, 0.5], [0, 0, np.pi / 2]]))
    assert np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(turns[3] @ (1, 0, 0), (0, 1, 0))


def test_exact_points_give_the_camera_back_with_its_skew() -> None:
    estimate = calibrate_camera(made_views(8, noise_px=0.0), fix=FREE)
    assert np.abs(estimate.bundle.camera - TRUTH).max() < 1e-5
    assert estimate.bundle.rms_px() < 1e-6


def test_held_parameters_stay_and_have_no_variance() -> None:
    views = made_views(8)
    estimate = calibrate_camera(views, fix=("skew", "k2", "k3", "principal-point"))
    held = [NAMES.index(n) for n in ("skew", "k2", "k3")]
    assert not estimate.bundle.camera[held].any()
    middle = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    assert np.allclose(estimate.bundle.camera[2:4], middle, atol=1e-9)
    covariance = estimate.uncertainty.covariance
    assert not covariance[[*held, 2, 3]].any()
    free = np.setdiff1d(np.arange(10), [*held, 2, 3])
    assert (np.diag(covariance)[free] > 0).all()


def test_a_held_aspect_makes_fx_and_fy_one_number() -> None:
    estimate = calibrate_camera(made_views(8), fix=("skew", "aspect"))
    assert estimate.bundle.camera[0] == pytest.approx(estimate.bundle.camera[1], abs=1e-9)
    covariance = estimate.uncertainty.covariance
    assert covariance[0, 0] == pytest.approx(covariance[0, 1]) == pytest.approx(covariance[1, 1])


def test_stated_sigmas_are_true_ones() -> None:
    """Over 30 seeded runs errors have the size of their sigmas; 1 and 2 sigma cover their share."""
    z = np.concatenate(
        [off_in_sigmas(calibrate_camera(made_views(10, seed=s), fix=FREE)) for s in range(30)]
    )
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15
    assert 0.60 < np.mean(np.abs(z) < 1) < 0.78
    assert np.mean(np.abs(z) < 2) > 0.92


def test_noise_is_that_of_one_coordinate() -> None:
    estimate = calibrate_camera(made_views(15, noise_px=0.2))
    assert estimate.uncertainty.noise_px == pytest.approx(0.2, rel=0.06)
    assert estimate.bundle.rms_px() == pytest.approx(0.2 * 2**0.5, rel=0.08)


def test_views_that_disagree_enlarge_the_sigmas() -> None:
    """A board that is bent a little, differently in each view, is no independent noise."""
    rng = np.random.default_rng(4)
    bent = []
    for view in made_views(12, noise_px=0.05):
        x, y = (view.points_mm[:, :2] / (160, 100) - 0.5).T
        wave = rng.normal(0, 0.4, (6, 2))
        terms = np.stack([x * y, x * x, y * y, x**3, y**3, x * x * y], axis=1)
        bent.append(moved(view, terms @ wave))
    estimate = calibrate_camera(bent, fix=FREE, keep_all=True)
    assert estimate.uncertainty.birge > 1.5
    assert np.sqrt(np.mean(off_in_sigmas(estimate) ** 2)) < 2.0
    assert "disagree" in " ".join(camera_quality(estimate, CameraLimits()).notes)


def test_weights_by_view_gain_where_noise_differs() -> None:
    error = {"equal": 0.0, "by-view": 0.0}
    for seed in range(6):
        sharp, soft = (
            made_views(8, noise_px=0.03, seed=seed),
            made_views(8, noise_px=0.3, seed=90 + seed),
        )
        for how in error:
            found = calibrate_camera([*sharp, *soft], fix=FREE, weighting=how, keep_all=True)  # type: ignore[arg-type]
            error[how] += float(np.abs(found.bundle.camera[:4] - TRUTH[:4]).sum())
    assert error["by-view"] < 0.6 * error["equal"]


def test_a_view_that_contradicts_the_rest_is_left_out() -> None:
    views = made_views(10)
    rng = np.random.default_rng(2)
    views[3] = moved(views[3], rng.normal(0, 1.5, (54, 2)))
    estimate = calibrate_camera(views, fix=FREE)
    assert [item.what for item in estimate.left_out] == ["view3"]
    assert "rms" in estimate.left_out[0].why
    assert len(estimate.views) == 9
    assert np.abs(off_in_sigmas(estimate)).max() < 4
    assert len(calibrate_camera(views, fix=FREE, keep_all=True).views) == 10


def test_a_corner_that_is_off_is_left_out_alone() -> None:
    views = made_views(10)
    views[5] = moved(views[5], np.array([4.0, -3.0]), [17])
    estimate = calibrate_camera(views, fix=FREE)
    assert [item.what for item in estimate.left_out] == ["view5 corner 17"]
    assert 17 not in estimate.views[5].ids
    assert np.abs(off_in_sigmas(estimate)).max() < 4


FLIPS = {
    "mirrored": ((-1, 1), (slice(None), slice(None, None, -1))),
    "mirrored and upside down": ((1, -1), (slice(None, None, -1), slice(None))),
    "upside down": ((-1, -1), (slice(None, None, -1), slice(None, None, -1))),
}


def flipped(view: BoardView, how: str) -> BoardView:
    signs, order = FLIPS[how]
    grid = view.points_px.reshape(6, 9, 2)[order].reshape(-1, 2)
    size = np.array([WIDTH - 1, HEIGHT - 1])
    return replace(view, points_px=np.where(np.array(signs) < 0, size - grid, grid))


@pytest.mark.parametrize("how", FLIPS)
def test_views_the_wrong_way_round_among_others_are_told(how: str) -> None:
    """Where the principal point is off the middle; else a flip hardly changes anything."""
    camera = TRUTH.copy()
    camera[2], camera[3] = 310.0, 252.0
    plain = made_views(9, camera=camera)
    assert not calibrate_camera(plain, fix=FREE).left_out
    told = 0
    for at in range(0, 9, 2):
        views = list(plain)
        views[at] = flipped(views[at], how)
        left_out = calibrate_camera(views, fix=FREE).left_out
        assert not left_out or [item.what for item in left_out] == [f"view{at}"]
        told += any(f"{how} by" in item.why for item in left_out)
    assert told >= 4


def test_no_view_is_suspected_where_a_flip_cannot_be_told() -> None:
    """A principal point in the middle: mirrored views fit as well as plain ones do."""
    camera = TRUTH.copy()
    camera[2], camera[3] = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    for seed in range(3):
        views = made_views(9, camera=camera, seed=seed)
        views[4] = flipped(views[4], "mirrored")
        assert not calibrate_camera(views, fix=FREE).left_out


def test_a_view_blurred_more_than_the_others_is_left_out() -> None:
    views = made_views(8)
    views[2] = replace(views[2], blur_px=2.1)
    assert [item.what for item in calibrate_camera(views).left_out] == ["view2"]


def test_views_that_all_contradict_each_other_are_refused() -> None:
    rng = np.random.default_rng(3)
    views = [
        moved(v, rng.normal(0, 3.0, (54, 2))) if i % 2 else v for i, v in enumerate(made_views(12))
    ]
    with pytest.raises(CalibrationError):
        calibrate_camera(views)


def test_cells_that_are_not_square_are_used_as_said() -> None:
    board = Board(cols=9, rows=6, square_x_mm=20, square_y_mm=18)
    estimate = calibrate_camera(made_views(8, noise_px=0.0, board=board), fix=FREE)
    assert np.abs(estimate.bundle.camera - TRUTH).max() < 1e-5


def test_exchanged_sides_of_cells_are_told_with_the_consequence() -> None:
    board = Board(cols=9, rows=6, square_x_mm=20, square_y_mm=19)
    said = board.model_copy(update={"square_x_mm": 19.0, "square_y_mm": 20.0})
    views = [
        replace(v, board=said, points_mm=said.object_points_mm()) for v in made_views(8, board=board)
    ]
    with pytest.raises(CalibrationError, match=r"not the other way round.* mm in 1 m"):
        calibrate_camera(views)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_views(count: int) -> None:
    with pytest.raises(InputError, match=f"{count} views of the board are too few"):
        calibrate_camera(made_views(count))


def test_mixed_image_sizes_are_named() -> None:
    views = made_views(6)
    views[2] = replace(views[2], width_px=640, height_px=480)
    with pytest.raises(InputError, match=r"2 sizes: 480 x 360 px \(5\), 640 x 480 px \(1\).*view2"):
        calibrate_camera(views)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_parallel_views_are_refused(tilt_deg: float) -> None:
    """Whether they face the camera or are all tilted alike."""
    turn = rotation_of(np.deg2rad(np.array([tilt_deg, 0.3 * tilt_deg, 0.0])))
    points = CHESS.object_points_mm()
    template = made_views(1)[0]
    rng = np.random.default_rng(6)
    views = []
    for i in range(8):
        at = np.array([rng.uniform(-30, 30), rng.uniform(-20, 20), rng.uniform(280, 500)])
        seen = project_points(TRUTH, points @ turn.T + at - turn @ points.mean(axis=0))
        seen = seen + rng.normal(0, 0.02, seen.shape)
        views.append(replace(template, name=f"v{i}", points_px=seen))
    with pytest.raises(CalibrationError, match=r"parallel|do not fix|explains") as caught:
        calibrate_camera(views)
    assert "tilt" in (caught.value.hint or "")


def test_views_of_one_pose_are_refused() -> None:
    view = made_views(1)[0]
    with pytest.raises(CalibrationError):
        calibrate_camera([replace(view, name=str(i)) for i in range(6)])


def test_gates_judge_what_they_name() -> None:
    estimate = calibrate_camera(made_views(8))
    quality = camera_quality(estimate, CameraLimits())
    assert quality.verdict == "passed", quality.failed()
    values = {g.name: g.value for g in quality.gates}
    assert values["views"] == 8
    assert values["rms"] == pytest.approx(estimate.bundle.rms_px())
    assert values["coverage"] == pytest.approx(coverage(estimate.views))
    for name, limits in {
        "views": CameraLimits(least_views=9),
        "rms": CameraLimits(most_rms_px=0.01),
        "coverage": CameraLimits(least_coverage=1.0),
        "view spread": CameraLimits(least_spread_deg=170),
        "condition": CameraLimits(most_condition=1.5),
        "focal sigma": CameraLimits(most_focal_sigma_percent=1e-4),
    }.items():
        assert [g.name for g in camera_quality(estimate, limits).failed()] == [name]


def test_ray_sigma_is_that_of_the_focal_length() -> None:
    """f off by 1 % alone: the ray at (x, y) is off by 10 sqrt(x^2 + y^2) mm at 1 m."""
    camera = np.array([500.0, 500.0, 239.5, 179.5, 0, 0, 0, 0, 0, 0])
    covariance = np.zeros((10, 10))
    covariance[:2, :2] = 25.0
    _, worst = ray_sigma_mm_per_m(camera, covariance, (480, 360))
    assert worst == pytest.approx(10 * np.hypot(239.5, 179.5) / 500, rel=1e-6)


def test_a_principal_point_off_is_mostly_a_turn() -> None:
    camera = np.array([5000.0, 5000.0, 239.5, 179.5, 0, 0, 0, 0, 0, 0])
    covariance = np.zeros((10, 10))
    covariance[2, 2] = 1.0
    usual, _ = ray_sigma_mm_per_m(camera, covariance, (480, 360))
    assert usual < 0.01 * 1000 / 5000
