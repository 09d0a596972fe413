"""Truth is exact: OpenCV's projection, and closed forms for wall, ball and board."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.rig import forward_project, lens, unproject_all
from turnscan.ingest.room.scene import Scene
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.scene import Mesh, Plane

from .rigs import LENS, ball, rig, truth_of, wall
from .test_rays import ball_mesh

LENSES = st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.003, 0.003)] * 2, st.floats(-0.1, 0.1))


@settings(max_examples=50, deadline=None)
@given(LENSES)
def test_projection_is_opencvs(distortion: tuple[float, ...]) -> None:
    camera = rig().camera.model_copy(update={"distortion": distortion})
    points = np.random.default_rng(0).uniform((-400, -300, 800), (400, 300, 3000), (50, 3))
    matrix = np.array(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]], float
    )
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    u, v = forward_project(points, camera)
    assert np.allclose(np.stack([u, v], axis=1), expected[:, 0], atol=1e-9)


def test_skew_leans_by_rows() -> None:
    """In closed form: skew adds fx skew yd to u, and nothing to v."""
    points = np.array([[100.0, 200.0, 1000.0], [-50.0, -300.0, 1500.0]])
    plain = forward_project(points, rig().camera)
    leaning = forward_project(points, rig(skew=0.01).camera)
    assert leaning[0] - plain[0] == pytest.approx([760 * 0.01 * 0.2, 760 * 0.01 * -0.2])
    assert np.array_equal(leaning[1], plain[1])


@settings(max_examples=50, deadline=None)
@given(LENSES, st.floats(-0.01, 0.01))
def test_unprojection_is_the_inverse(distortion: tuple[float, ...], skew: float) -> None:
    camera = rig().camera.model_copy(update={"distortion": distortion, "skew": skew})
    grid = np.stack(np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.2, 0.2, 9)), -1)
    rays = np.column_stack([grid.reshape(-1, 2), np.ones(81)])
    u, v = forward_project(rays, camera)
    back = unproject_all(lens(camera), np.stack([u, v], axis=1))
    assert np.abs(back - rays[:, :2]).max() < 1e-13


def test_a_lens_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(CalibrationError, match="folds the picture over inside the frame"):
        rig(distortion=(-3.0, 0.0, 0.0, 0.0, 0.0))


def test_a_plain_wall_in_closed_form() -> None:
    """Laser plane n.P = h and wall Z = 2000: X is one number, so the stripe is a straight column."""
    a = rig()
    truth = truth_of(wall(2000.0), a)
    n, h = a.plane().normal, a.plane().distance_mm
    x = (h - n[2] * 2000.0) / n[0]
    assert np.array_equal(truth.row, np.arange(480))
    assert truth.u_px == pytest.approx(np.full(480, 760.0 * x / 2000.0 + 318.5), abs=1e-9)
    z_up = -(np.arange(480) - 241.25) / 760.0 * 2000.0
    expected = np.stack([np.full(480, x), np.full(480, 2000.0), z_up], axis=1)
    assert np.abs(truth.points_mm - expected).max() < 1e-6
    assert truth.range_mm == pytest.approx(np.linalg.norm(expected, axis=1))
    # Lambert's cosine over the distance from the laser, which stands at (300, 0, 0).
    reach = np.linalg.norm(expected - np.array([300.0, 0.0, 0.0]), axis=1)
    assert truth.amplitude_dn == pytest.approx(900.0 * 0.7 * (2000.0 / reach) * 1000.0 / reach)
    assert truth.width_px == pytest.approx(np.full(480, 1.8))


@pytest.mark.parametrize("mesh", [False, True], ids=["sphere", "mesh of 80000 triangles"])
def test_a_ball_in_closed_form(*, mesh: bool) -> None:
    """Where the laser plane cuts a ball it draws a circle; the truth lies on both."""
    a = rig(distortion=LENS)
    centre, radius = np.array([0.0, 1200.0, 40.0]), 250.0
    shape = ball(tuple(centre), radius)
    # The middle of a facet lies inside of the ball: r (1 - cos(half a facet)).
    off = 1e-9
    if mesh:
        vertices, triangles = ball_mesh(radius, 200)
        off = radius * 1.5 * (math.pi / 200) ** 2
        shape = Mesh(
            kind="mesh",
            at_mm=tuple(centre),
            vertices_mm=tuple(tuple(v) for v in vertices.tolist()),
            triangles=tuple(tuple(t) for t in triangles.tolist()),
        )
    truth = truth_of(Scene([shape]), a)
    assert len(truth.row) > 150
    distance = np.linalg.norm(truth.points_mm - centre, axis=1)
    assert np.abs(distance - radius).max() < off
    camera_space = a.pose(0.0).to_camera(truth.points_mm)
    plane = a.plane()
    assert camera_space @ np.array(plane.normal) == pytest.approx(plane.distance_mm, abs=1e-9)
    # Only the near side is lit and seen.
    towards = -truth.points_mm / truth.range_mm[:, None]
    assert ((truth.points_mm - centre) * towards).sum(axis=1).min() > -off
    # No row between the first and the last is left out: both ends are silhouettes.
    exact = truth_of(Scene([ball(tuple(centre), radius)]), a)
    assert np.array_equal(np.unique(truth.row), np.arange(truth.row.min(), truth.row.max() + 1))
    assert abs(truth.row.min() - exact.row.min()) <= 1
    assert abs(truth.row.max() - exact.row.max()) <= 1


def test_a_leaning_board_in_closed_form() -> None:
    """A finite plane, turned: its truth is the line where it meets the laser's plane, to its edges."""
    a = rig()
    board = Plane(kind="plane", at_mm=(0, 1500, 0), turn_deg=(60, 10, 0), size_mm=(900, 700))
    truth = truth_of(Scene([board]), a)
    from .test_rays import rotation

    turn = rotation(board.turn_deg)
    local = (truth.points_mm - np.array(board.at_mm)) @ turn
    assert np.abs(local[:, 2]).max() < 1e-9
    assert np.abs(local[:, 1]).max() == pytest.approx(350, abs=3)
    # n.P = h and m.P = d meet in a line; where it meets the edges y = +-350, rows begin and end.
    n = np.array(a.plane().normal) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    ends = []
    for y in (-350.0, 350.0):
        edge = np.array(board.at_mm) + turn @ np.array([0, y, 0.0])
        t = (a.plane().distance_mm - n @ edge) / (n @ turn[:, 0])
        _, v = forward_project(a.pose(0.0).to_camera((edge + t * turn[:, 0])[None]), a.camera)
        ends.append(float(v[0]))
    assert truth.row.min() == math.ceil(min(ends))
    assert truth.row.max() == math.floor(max(ends))


@pytest.mark.parametrize("f", [0.5, 1.0])
def test_two_sides_of_one_sheet(f: float) -> None:
    """A thin board between laser and camera is lit on its far side: nothing is seen of it."""
    a = rig()
    # From (300, 0) the laser goes to the left; this board stands along the view, lit from its right.
    board = Plane(kind="plane", at_mm=(100, 900, 0), turn_deg=(0, 90, 0), size_mm=(100, 1400))
    lit = truth_of(Scene([board]), a)
    assert len(lit.row) == 0
    # Beyond the middle of the view the camera sees the side that is lit.
    seen = board.model_copy(update={"at_mm": (-200.0 * f, 1200.0, 0.0)})
    assert len(truth_of(Scene([seen]), a).row) > 5
