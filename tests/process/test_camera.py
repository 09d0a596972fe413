"""The camera model: against OpenCV where that applies, against itself where it does not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.process.camera import (
    distort,
    ideal_camera,
    pixels,
    project,
    undistort_points,
)
from turnscan.process.undistort import FrameUndistorter
from turnscan.schemas.calibration import Intrinsics

PAPER = Intrinsics(
    width_px=640,
    height_px=480,
    fx_px=761.74797,
    fy_px=762.26178,
    cx_px=296.92665,
    cy_px=271.50956,
    distortion=(-0.20997, 0.1649, 0.0008, -0.00001, 0.0),
)
SKEWED = PAPER.model_copy(
    update={"skew": 0.001, "distortion": (0.1137, -0.1937, -0.0011, -0.0022, -0.035)}
)


def grid(camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0 : camera.height_px : 20j, 0 : camera.width_px : 20j]
    return u.ravel(), v.ravel()


def test_projection_is_opencvs_where_there_is_no_skew() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-400, -300, 900], [400, 300, 3000], (500, 3))
    k = np.array([[PAPER.fx_px, 0, PAPER.cx_px], [0, PAPER.fy_px, PAPER.cy_px], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, np.array(PAPER.distortion))
    u, v = project(points, PAPER)
    assert np.allclose(np.stack([u, v], 1), expected.reshape(-1, 2), atol=1e-9, rtol=0)


def test_skew_moves_u_by_fx_skew_yd() -> None:
    xd, yd = np.array([0.1, -0.2]), np.array([0.3, 0.25])
    u0, v0 = pixels(xd, yd, PAPER)
    u1, v1 = pixels(xd, yd, SKEWED)
    assert u1 - u0 == pytest.approx(PAPER.fx_px * 0.001 * yd)
    assert np.array_equal(v0, v1)


@pytest.mark.parametrize("camera", [PAPER, SKEWED])
def test_undistortion_is_inverted_to_1e_10_px(camera: Intrinsics) -> None:
    u, v = grid(camera)
    again = pixels(*distort(*undistort_points(u, v, camera), camera), camera)
    assert np.abs(np.stack(again) - np.stack([u, v])).max() < 1e-10


@settings(max_examples=60, deadline=None)
@given(
    k=st.tuples(*[st.floats(-0.25, 0.25)] * 2, *[st.floats(-0.003, 0.003)] * 2, st.floats(-0.1, 0.1)),
    skew=st.floats(-0.01, 0.01),
)
def test_round_trip_of_any_mild_lens(k: tuple[float, ...], skew: float) -> None:
    camera = PAPER.model_copy(update={"distortion": k, "skew": skew})
    xn, yn = np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.3, 0.3, 9))
    back = undistort_points(*pixels(*distort(xn, yn, camera), camera), camera)
    assert np.abs(back[0] - xn).max() < 1e-12
    assert np.abs(back[1] - yn).max() < 1e-12


def test_beyond_the_fold_there_is_no_ray() -> None:
    # r (1 - 0.5 r^2) never exceeds 0.544: pixels farther out belong to no ray.
    camera = PAPER.model_copy(update={"distortion": (-0.5, 0, 0, 0, 0)})
    u = camera.cx_px + camera.fx_px * np.array([0.5, 0.6, 2.0])
    xn, _ = undistort_points(u, np.full(3, camera.cy_px), camera)
    assert xn[0] * (1 - 0.5 * xn[0] ** 2) == pytest.approx(0.5, abs=1e-12)
    assert np.isnan(xn[1:]).all()


def test_points_behind_the_camera_have_no_pixel() -> None:
    u, _ = project([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], PAPER)
    assert np.isnan(u[0])
    assert u[1] == pytest.approx(PAPER.cx_px)


def test_an_undistorted_frame_shows_lines_where_points_say() -> None:
    """A smooth blob drawn at a distorted place is found at the undistorted one."""
    v, u = np.mgrid[0:480, 0:640].astype(float)
    for cu, cv_ in ((100.0, 80.0), (560.0, 400.0), (300.0, 240.0)):
        frame = np.rint(250 * np.exp(-((u - cu) ** 2 + (v - cv_) ** 2) / 2 / 25)).astype(np.uint8)
        out = FrameUndistorter(SKEWED)(frame).astype(float)
        found = (out * u).sum() / out.sum(), (out * v).sum() / out.sum()
        xn, yn = undistort_points(cu, cv_, SKEWED)
        expected = SKEWED.fx_px * xn + SKEWED.cx_px, SKEWED.fy_px * yn + SKEWED.cy_px
        assert found == pytest.approx([float(e) for e in expected], abs=0.05)


def test_the_ideal_camera_has_no_lens() -> None:
    u, v = grid(PAPER)
    x, y = undistort_points(u, v, ideal_camera(SKEWED))
    assert np.allclose(x, (u - PAPER.cx_px) / PAPER.fx_px)
    assert np.allclose(y, (v - PAPER.cy_px) / PAPER.fy_px)
