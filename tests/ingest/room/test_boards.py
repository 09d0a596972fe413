"""Boards look as OpenCV expects, their corners are where truth says, and the laser lies on them."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.board_painting import BEHIND, BLACK
from turnscan.ingest.room.board_patterns import Board, Charuco, Chessboard, CircleGrid
from turnscan.ingest.room.boards import BoardCamera, camera_from_board_on_table
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.schemas.errors import InputError
from turnscan.schemas.scene import Emitter, Light, Sensor

from .rigs import LENS, QUIET, rig

LIGHT = Light(ambient_dn=200.0, stripe_sigma_px=1.2)


def pose(turn: tuple[float, ...], at: tuple[float, ...], board: Board | None = None) -> np.ndarray:
    """camera_from_board, with the middle of the board's corners (or its origin) at a place."""
    out = np.eye(4)
    out[:3, :3] = cv2.Rodrigues(np.array(turn, float))[0]
    middle = np.zeros(2) if board is None else board.corners_mm().mean(axis=0)
    out[:3, 3] = np.array(at) - out[:3, :2] @ middle
    return out


@pytest.fixture(scope="module")
def quiet() -> BoardCamera:
    return BoardCamera(rig(distortion=LENS), light=LIGHT, sensor=QUIET)


def opencv_corners(camera: BoardCamera, board: Board, at: np.ndarray) -> np.ndarray:
    """The corners by OpenCV's own projection (which knows no skew)."""
    c = camera.rig.camera
    matrix = np.array([[c.fx_px, 0, c.cx_px], [0, c.fy_px, c.cy_px], [0, 0, 1.0]])
    points = np.column_stack([board.corners_mm(), np.zeros(len(board.corners_mm()))])
    turn = cv2.Rodrigues(at[:3, :3])[0]
    return cv2.projectPoints(points, turn, at[:3, 3], matrix, np.array(c.distortion))[0].reshape(-1, 2)


BOARDS: list[Board] = [
    Chessboard(8, 6, 25.0),
    Charuco(8, 6, 28.0, 21.0),
    Charuco(5, 7, 34.0, 24.0, "DICT_6X6_250"),
    CircleGrid(8, 6, 26.0, 16.0),
    CircleGrid(4, 9, 18.0, 14.0, asymmetric=True),
]


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: type(b).__name__)
def test_corners_are_where_opencv_projects_them(quiet: BoardCamera, board: Board) -> None:
    at = pose((0.3, -0.25, 0.1), (5, 3, 500.0), board)
    view = quiet.look(board, at, seed=0)
    assert view.in_view.all()
    assert np.abs(view.corners_px - opencv_corners(quiet, board, at)).max() < 1e-9


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_opencv_finds_a_chessboard_where_it_is(noise: float) -> None:
    board = Chessboard(8, 6, 25.0)
    sensor = Sensor(noise_dn=noise, shot_dn_per_dn=0.0)
    # Sharper edges are undersampled, and cornerSubPix then errs with the phase of the pixels.
    camera = BoardCamera(rig(distortion=LENS), light=LIGHT, sensor=sensor, blur_px=1.2)
    view = camera.look(board, pose((0.3, -0.25, 0.1), (5, 3, 500.0), board), seed=0)
    ok, found = cv2.findChessboardCorners(view.image, (8, 6))
    assert ok
    start = found.reshape(-1, 1, 2).astype(np.float32)
    near = cv2.cornerSubPix(view.image, start, (8, 8), (-1, -1), (3, 100, 1e-5)).reshape(-1, 2)
    error = near - view.corners_px
    print(f"chessboard, noise {noise:g} DN: rms {np.sqrt((error**2).mean()):.4f} px")
    assert np.sqrt((error**2).mean()) < (0.03 if noise else 0.015)
    assert np.abs(error.mean(axis=0)).max() < 0.005


def test_opencv_finds_every_corner_of_a_charuco_board(quiet: BoardCamera) -> None:
    board = Charuco(8, 6, 28.0, 21.0)
    view = quiet.look(board, pose((0.3, -0.25, 0.1), (5, 3, 500.0), board), seed=0)
    theirs = cv2.aruco.CharucoBoard(
        (8, 6), 28.0, 21.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    assert np.abs(np.array(theirs.getChessboardCorners())[:, :2] - board.corners_mm()).max() < 1e-4
    found, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(view.image)
    assert sorted(ids.ravel().tolist()) == list(range(35))
    error = found.reshape(-1, 2) - view.corners_px[ids.ravel()]
    assert np.sqrt((error**2).mean()) < 0.08


@pytest.mark.parametrize("board", BOARDS[3:], ids=["symmetric", "asymmetric"])
def test_opencv_finds_circles(quiet: BoardCamera, board: CircleGrid) -> None:
    view = quiet.look(board, pose((0.3, -0.25, 0.1), (5, 3, 500.0), board), seed=0)
    flag = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    ok, found = cv2.findCirclesGrid(view.image, (board.columns, board.rows), flags=flag)
    assert ok
    error = found.reshape(-1, 2) - view.corners_px
    if np.abs(error).max() > 5:
        error = found.reshape(-1, 2)[::-1] - view.corners_px
    # The middle of an ellipse is not the picture of the circle's middle, and blobs are coarse.
    assert np.abs(error).max() < 0.3


def test_a_disc_is_centred_to_a_thousandth_of_a_pixel() -> None:
    """Square on, the centre of darkness is the disc's middle, wherever it falls on the pixels."""
    camera = BoardCamera(rig(), light=LIGHT, sensor=QUIET, encoding="mono16")
    board = CircleGrid(3, 3, 60.0, 30.0)
    for k in range(5):
        view = camera.look(board, pose((0, 0, 0), (k * 0.37, -k * 0.23, 1000.0), board), seed=0)
        for x, y in view.corners_px:
            v, u = np.mgrid[round(y) - 19 : round(y) + 20, round(x) - 19 : round(x) + 20]
            dark = view.image[v, u].max() - view.image[v, u].astype(float)
            centre = np.array([(dark * u).sum(), (dark * v).sum()]) / dark.sum()
            assert np.abs(centre - (x, y)).max() < 2e-3
            area = dark.sum() / (view.image[v, u].max() - 200 * 257 * BLACK)
            assert area == pytest.approx(math.pi * (15 * 0.76) ** 2, rel=0.003)


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-0.8, 0.8))
def test_edges_stand_where_the_print_ends(x: float, y: float, lean: float) -> None:
    """A long edge, at any lean: what is dark on one side of a line adds up to where the edge is."""
    camera = BoardCamera(rig(), light=LIGHT, sensor=QUIET, blur_px=0.0, encoding="mono16")
    board = Chessboard(2, 2, 150.0)
    view = camera.look(board, pose((0, 0, lean), (x, y, 1000.0), board), seed=0)
    # Along the line from corner 0 to corner 2: black to one side, white to the other.
    a, b = view.corners_px[0], view.corners_px[2]
    for part in (0.3, 0.45, 0.6):
        row = round((a + part * (b - a))[1])
        true = a[0] + (row - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        first = round(true) - 15
        stretch = view.image[row, first : first + 31].astype(float)
        left, right = stretch[0], stretch[-1]
        assert abs(left - right) > 10_000
        # As many pixels are as the left end as the edge is to the right of the first pixel's border.
        found = first - 0.5 + ((stretch - right) / (left - right)).sum()
        assert found == pytest.approx(true, abs=0.01)


def test_grey_values_of_print_plate_and_what_is_behind(quiet: BoardCamera) -> None:
    board = Chessboard(4, 3, 50.0)
    view = quiet.look(board, pose((0, 0, 0), (0, 0, 600.0), board), seed=0)
    values, counts = np.unique(view.image, return_counts=True)
    most = sorted(values[np.argsort(counts)[-3:]].tolist())
    assert most == [round(200 * BLACK), round(200 * BEHIND), 200]
    assert view.image.max() == 200
    longer = quiet.look(board, pose((0, 0, 0), (0, 0, 600.0), board), seed=0, exposure_us=5000)
    assert longer.image.max() == 100


def test_out_of_view_and_from_behind(quiet: BoardCamera) -> None:
    board = Chessboard(8, 6, 25.0)
    aside = quiet.look(board, pose((0, 0, 0), (200.0, 0, 500.0), board), seed=0)
    inside = (aside.corners_px[:, 0] < 639.5) & (aside.corners_px[:, 0] > -0.5)
    assert 0 < aside.in_view.sum() < 48
    assert np.array_equal(aside.in_view, inside)
    for at in (pose((0, math.pi, 0), (0, 0, 500.0), board), pose((0, 0, 0), (0, 0, -500.0), board)):
        away = quiet.look(board, at, seed=0, lasers=[0])
        assert not away.in_view.any()
        assert set(np.unique(away.image).tolist()) == {round(200 * BEHIND)}
        assert len(away.truth[0].row) == 0


def test_the_laser_lies_on_the_board_and_in_its_plane() -> None:
    weak = SimulatedRig(
        rig(distortion=LENS).calibration, emitters=[Emitter(laser=0, stripe_dn_at_1m=30.0)]
    )
    camera = BoardCamera(weak, light=Light(ambient_dn=20, stripe_sigma_px=1.5), sensor=QUIET)
    board = Chessboard(8, 6, 40.0)
    at = pose((0.2, -0.3, 0.1), (-60, 0, 900.0), board)
    lit, dark = (camera.look(board, at, seed=0, lasers=lasers) for lasers in ([0], []))
    truth = lit.truth[0]
    assert len(truth.row) > 150
    plane = weak.plane()
    assert truth.points_mm @ np.array(plane.normal) == pytest.approx(plane.distance_mm, abs=1e-9)
    on_board = (truth.points_mm - at[:3, 3]) @ at[:3, :3]
    assert np.abs(on_board[:, 2]).max() < 1e-9
    assert np.linalg.norm(truth.points_mm, axis=1) == pytest.approx(truth.range_mm)
    # What the laser adds is where truth says; on black squares it is much weaker.
    more = lit.image.astype(float) - dark.image
    x, y = on_board[:, 0] / 40.0, on_board[:, 1] / 40.0
    for row, u, i, j in zip(truth.row, truth.u_px, x, y, strict=True):
        middle = 0.2 < i % 1 < 0.8 and 0.2 < j % 1 < 0.8 and -1 < i < 8 and -1 < j < 6
        if not middle:
            continue
        part = more[row, round(u) - 8 : round(u) + 9]
        white = (math.floor(i) + math.floor(j)) % 2 == 1
        assert (part.max() > 8) == white
        if white:
            centre = (part * np.arange(round(u) - 8, round(u) + 9)).sum() / part.sum()
            assert abs(centre - u) < 0.15
            assert part.sum() == pytest.approx(
                truth.amplitude_dn[truth.row == row][0] * 1.5 * math.sqrt(2 * math.pi), rel=0.15
            )


def test_equal_arguments_give_equal_pictures() -> None:
    camera = BoardCamera(rig(), light=LIGHT, sensor=Sensor(speckle_contrast=0.2, impulse_share=0.01))
    at = pose((0.1, 0, 0), (-100, -80, 600.0))
    shot = [camera.look(Chessboard(5, 4, 30.0), at, seed=3, frame=f, lasers=[0]) for f in (1, 2, 1)]
    assert shot[0].image.tobytes() == shot[2].image.tobytes() != shot[1].image.tobytes()
    colour = BoardCamera(rig(), light=LIGHT, encoding="bgr8")
    assert colour.look(Chessboard(5, 4, 30.0), at, seed=3).image.shape == (480, 640, 3)


def test_a_board_on_the_turntable_turns_with_it() -> None:
    """A point of the board goes where the rig's own pose says that scene point is."""
    a = rig()
    on_table = pose((math.pi / 2, 0.2, 0.0), (100, 400, -50))
    for angle in (0.0, 0.7):
        at = camera_from_board_on_table(a, angle, on_table)
        corner = np.array([30.0, 20.0, 0.0, 1.0])
        expected = a.pose(angle).to_camera((on_table @ corner)[None, :3])
        assert (at @ corner)[:3] == pytest.approx(expected[0])


BAD: list[tuple[Board, str]] = [
    (Chessboard(1, 6, 25.0), "at least 2 columns, not 1"),
    (Chessboard(8, 6, -1.0), "square_mm = -1 mm cannot be made"),
    (Charuco(8, 6, 20.0, 20.0), "do not fit into squares"),
    (Charuco(8, 6, 20.0, 15.0, "DICT_WRONG"), "no ArUco dictionary 'DICT_WRONG'"),
    (Charuco(20, 20, 20.0, 15.0), "has 50 markers, the board needs 200"),
    (CircleGrid(4, 4, 10.0, 10.0), "overlap"),
    (CircleGrid(4, 4, math.nan, 5.0), "cannot be made"),
]


@pytest.mark.parametrize(("board", "message"), BAD, ids=lambda b: str(b)[:40])
def test_boards_that_cannot_be(quiet: BoardCamera, board: Board, message: str) -> None:
    with pytest.raises(InputError, match=message):
        quiet.look(board, np.eye(4), seed=0)


def test_poses_that_are_none(quiet: BoardCamera) -> None:
    for bad in (np.eye(3), np.diag([1.0, 1, -1, 1]), 2 * np.eye(4), np.full((4, 4), np.nan)):
        with pytest.raises(InputError, match="not a rigid transform"):
            quiet.look(Chessboard(4, 3, 10.0), bad, seed=0)
