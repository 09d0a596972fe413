"""Boards are found to sub-pixel in rendered images, and refused with the reason when they should be."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendered_boards import (
    ACIRCLES,
    CHARUCO,
    CHESS,
    CIRCLES,
    VIEWS,
    exact_points,
    pose,
    render,
    rendered,
)

from turnscan.process.calibrate.boards import BoardView, NoBoard, corner_window_px, find_board
from turnscan.process.calibrate.camera import calibrate_camera
from turnscan.process.calibrate.lattice import disturbed, examine
from turnscan.schemas.board import Board
from turnscan.schemas.errors import InputError


@pytest.fixture(scope="module")
def chess_images() -> list[np.ndarray]:
    return rendered(CHESS)


def found(image: np.ndarray, board: Board, **how: object) -> BoardView:
    view = find_board(image, board, **how)  # type: ignore[arg-type]
    assert isinstance(view, BoardView), view
    return view


def refused(image: np.ndarray, board: Board, **how: object) -> NoBoard:
    view = find_board(image, board, **how)  # type: ignore[arg-type]
    assert isinstance(view, NoBoard), view
    return view


def worst_px(view: BoardView, turn: np.ndarray, shift: np.ndarray) -> float:
    """Largest distance from the truth; a symmetric board may be numbered from its other end."""
    exact = exact_points(view.board, turn, shift)
    ends = (exact[view.ids], exact[::-1][view.ids])
    return float(min(np.linalg.norm(view.points_px - e, axis=1).max() for e in ends))


def test_chessboard_corners_are_where_they_are(chess_images: list[np.ndarray]) -> None:
    for image, place in zip(chess_images, VIEWS, strict=True):
        view = found(image, CHESS)
        assert view.whole
        assert worst_px(view, *pose(CHESS, *place)) < 0.2
        assert 2 <= view.window_px <= max(2.0, 0.4 * view.square_px + 1)


@pytest.mark.parametrize("board", [CHARUCO, CIRCLES, ACIRCLES], ids=lambda b: b.kind)
def test_other_boards_calibrate_the_camera(board: Board) -> None:
    images = rendered(board)
    views = [found(image, board, name=str(i)) for i, image in enumerate(images)]
    estimate = calibrate_camera(views, fix=("skew", "k3"))
    camera = estimate.bundle.camera
    sigma = np.sqrt(np.diag(estimate.uncertainty.covariance))
    assert estimate.bundle.rms_px() < 0.25
    assert abs(camera[0] - 520) < max(4 * sigma[0], 1.0), estimate.parameters()
    assert abs(camera[2] - 235) < max(4 * sigma[2], 1.0), estimate.parameters()


def test_a_part_of_a_charuco_board_is_used() -> None:
    turn, shift = pose(CHARUCO, (15, 10, 0), (90, 40, 300))
    view = found(render(CHARUCO, turn, shift), CHARUCO)
    assert 6 <= len(view.ids) < CHARUCO.points
    assert worst_px(view, turn, shift) < 0.3


def test_a_mirrored_charuco_board_is_told() -> None:
    image = render(CHARUCO, *pose(CHARUCO, (10, 10, 0), (0, 0, 330)))
    no = refused(np.ascontiguousarray(image[:, ::-1]), CHARUCO)
    assert no.cause == "mirrored"


def test_exchanged_columns_and_rows_of_a_charuco_board_are_told() -> None:
    image = render(CHARUCO, *pose(CHARUCO, (10, 10, 0), (0, 0, 330)))
    no = refused(image, CHARUCO.transposed())
    assert no.cause in ("size", "few", "grid"), no


def test_a_smaller_charuco_board_than_the_real_one_is_told() -> None:
    image = render(CHARUCO, *pose(CHARUCO, (10, 10, 0), (0, 0, 330)))
    small = CHARUCO.model_copy(update={"cols": 4, "rows": 3})
    no = find_board(image, small)
    assert isinstance(no, NoBoard), no


def test_transposed_squares_give_the_same_corners(chess_images: list[np.ndarray]) -> None:
    """A chessboard of squares has no preferred direction: 6x9 is 9x6."""
    view = found(chess_images[0], CHESS.transposed())
    a = np.sort(view.points_px.round(2), axis=0)
    b = np.sort(found(chess_images[0], CHESS).points_px.round(2), axis=0)
    assert np.abs(a - b).max() < 0.05


def test_the_board_is_seen_from_its_front(chess_images: list[np.ndarray]) -> None:
    for board in (CHESS, CHESS.transposed()):
        for image in chess_images:
            for picture in (image, np.ascontiguousarray(image[:, ::-1])):
                view = found(picture, board)
                grid = view.points_px.reshape(board.rows, board.cols, 2)
                ex, ey = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
                assert ex[0] * ey[1] - ex[1] * ey[0] > 0


@pytest.mark.parametrize("size", [(8, 5), (9, 5), (7, 6)])
def test_a_larger_board_than_was_said_is_told(
    size: tuple[int, int], chess_images: list[np.ndarray]
) -> None:
    board = CHESS.model_copy(update={"cols": size[0], "rows": size[1]})
    assert refused(chess_images[1], board).cause == "size"


def test_a_smaller_board_than_was_said_is_never_taken(chess_images: list[np.ndarray]) -> None:
    board = CHESS.model_copy(update={"rows": 7})
    for image in chess_images[:4]:
        refused(image, board)


def test_a_board_without_white_border_is_found() -> None:
    for place in VIEWS[:4]:
        turn, shift = pose(CHESS, *place)
        view = found(render(CHESS, turn, shift, border=False), CHESS)
        assert worst_px(view, turn, shift) < 0.25


def test_a_cut_board_is_told() -> None:
    image = render(CHESS, *pose(CHESS, (5, 5, 0), (130, 0, 330)))
    no = refused(image, CHESS)
    assert no.cause == "cut", no
    assert "of 9x6 corners" in no.reason


def test_blur_is_measured_and_refused() -> None:
    turn, shift = pose(CHESS, (10, 10, 0), (0, 0, 330))
    sharp = found(render(CHESS, turn, shift, blur_px=1.0), CHESS)
    assert 0.9 < sharp.blur_px < 1.5
    no = refused(render(CHESS, turn, shift, blur_px=3.0), CHESS)
    assert no.cause == "blur"
    assert found(render(CHESS, turn, shift, blur_px=3.0), CHESS, strict=False).blur_px > 2.5


def test_nothing_is_found_in_nothing() -> None:
    assert refused(np.full((100, 120), 80, np.uint8), CHESS).cause == "flat"
    noise = np.random.default_rng(3).integers(0, 255, (200, 240)).astype(np.uint8)
    assert refused(noise, CHESS).cause == "none"
    assert refused(noise, CIRCLES).cause == "none"
    assert refused(noise, CHARUCO).cause == "none"


def test_sixteen_bit_and_colour_give_the_same_corners(chess_images: list[np.ndarray]) -> None:
    grey = chess_images[0]
    plain = found(grey, CHESS).points_px
    colour = found(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), CHESS).points_px
    deep = found(grey.astype(np.uint16) * 16, CHESS).points_px
    assert np.array_equal(plain, colour)
    assert np.abs(plain - deep).max() < 0.03


def test_other_arrays_are_refused() -> None:
    for bad in (np.zeros((4, 4), np.float32), np.zeros((4, 4, 2), np.uint8), np.zeros(4, np.uint8)):
        with pytest.raises(InputError):
            find_board(bad, CHESS)


def test_large_images_are_searched_small_and_refined_large(chess_images: list[np.ndarray]) -> None:
    large = cv2.resize(chess_images[1], None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
    view = found(large, CHESS, strict=False)
    small = found(chess_images[1], CHESS)
    # Were pixel centres mapped onto each other instead of borders, all would be off by 0.4 px.
    off = (view.points_px + 0.5) / 5 - 0.5 - small.points_px
    assert np.abs(off.mean(axis=0)).max() < 0.05
    assert np.abs(off).max() < 0.35


def test_a_row_that_is_13_px_off_is_no_grid() -> None:
    points = exact_points(CHESS, *pose(CHESS, (20, 15, 0), (0, 0, 330)))
    ids = np.arange(CHESS.points)
    assert not examine(points, ids, CHESS).wrong
    moved = points.copy()
    moved[-9:] += (9.0, 9.4)
    assert "not regular" in examine(moved, ids, CHESS).wrong
    assert not disturbed(moved, ids, CHESS).size


def test_a_single_corner_that_is_off_is_named() -> None:
    points = exact_points(CHESS, *pose(CHESS, (20, 15, 0), (0, 0, 330)))
    ids = np.arange(CHESS.points)
    for at in (0, 4, 30, 53):
        moved = points.copy()
        moved[at] += (0.0, 13.0)
        assert list(disturbed(moved, ids, CHESS)) == [at]


def test_the_window_never_reaches_the_next_corner() -> None:
    assert [corner_window_px(s) for s in (4, 10, 22, 27.5, 60)] == [2, 4, 8, 11, 11]
