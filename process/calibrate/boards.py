"""Find a calibration board in an image: its points to sub-pixel, or the reason why not.

The refinement window follows from the squares as seen: one that reaches the next corner pulls the
points (0.6 % of the focal length on real photographs). Points of a board are in ``schemas.board``'s
order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from ...schemas.errors import InputError
from .chessboard import explain_missing, find_classic, find_sector
from .lattice import (
    Grey,
    check_chessboard,
    disturbed,
    edge_blur_px,
    examine,
    in_one_piece,
)
from .patterns import Cause, Found, Refusal, find_charuco, find_circles

Floats = npt.NDArray[np.float64]
Detector = Literal["auto", "classic", "sector"]

#: Largest half-window of the corner refinement: 23 px across see enough of any corner.
WIDEST_WINDOW_PX = 11
#: Half-window as a share of the smallest square: clear of the next corner for any direction of the
#: edges.
WINDOW_SHARE = 0.4
#: At least this share of the corners must be clear of a stripe.
_CLEAR_SHARE = 0.5
#: A blur this wide, as a share of a square, leaves corners that move with the window.
BLUR_SHARE = 0.07
#: ... but less than this is sharp, however small the squares.
SHARP_PX = 1.5


@dataclass(frozen=True)
class BoardView:
    """One board found in one image.

    ``ids`` (N,) number the points in the board's order, ``points_px`` (N, 2) are (u, v) with pixel
    centres at integers, ``points_mm`` (N, 3) the same points in board space. ``square_px`` is the
    smallest spacing seen, ``window_px`` the half-window of the refinement (0: none),
    ``irregular_px`` the worst third difference along a line of points, ``blur_px`` the edges' blur
    (NaN where it is not measured).
    """

    name: str
    board: Board
    ids: npt.NDArray[np.int64]
    points_px: Floats
    points_mm: Floats
    width_px: int
    height_px: int
    square_px: float
    window_px: int
    irregular_px: float
    blur_px: float
    detector: str

    @property
    def whole(self) -> bool:
        """Whether every point of the board was found."""
        return len(self.ids) == self.board.points


@dataclass(frozen=True)
class NoBoard:
    """No usable board in an image, and why not; ``cause`` is one word of it."""

    name: str
    cause: Cause
    reason: str


def grey8(image: npt.NDArray[Any]) -> Grey:
    """``image`` (H, W), (H, W, 3) or (H, W, 4) of 8 or 16 bit as 8-bit grey (BT.601 luma).

    Raises
    ------
    InputError
        The image has another shape or type.
    """
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise InputError(f"an image of shape {image.shape} and type {image.dtype} cannot be searched")
    if image.ndim == 3:
        if image.shape[2] not in (3, 4):
            raise InputError(f"an image of shape {image.shape} is neither grey nor colour")
        code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        image = cv2.cvtColor(image, code)
    if image.dtype == np.uint16:
        # Sensors of 10 or 12 bit fill a part of the range: scale what is there.
        low, high = np.percentile(image, [0.5, 99.5])
        scaled = (image.astype(np.float32) - low) * (255.0 / max(high - low, 1.0))
        image = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(image)


def corner_window_px(square_px: float, blur_px: float = 0.0) -> int:
    """Half-window of the corner refinement where the smallest square is ``square_px`` wide.

    It grows beyond :data:`WIDEST_WINDOW_PX` only where edges are so soft that it would see but a ramp.
    """
    useful = max(WIDEST_WINDOW_PX, 3.0 * blur_px) if np.isfinite(blur_px) else WIDEST_WINDOW_PX
    return int(max(2, min(useful, WINDOW_SHARE * square_px)))


def find_board(
    image: npt.NDArray[Any],
    board: Board,
    *,
    name: str = "image",
    window_px: int | None = None,
    detector: Detector = "auto",
    strict: bool = True,
    hidden: npt.NDArray[np.bool_] | None = None,
) -> BoardView | NoBoard:
    """The board in ``image``, or why it cannot be used.

    ``window_px`` is the half-window of the refinement; None chooses it from the squares.
    ``detector`` is for chessboards: ``classic`` (OpenCV's quads; wants a white border), ``sector``
    (Duda and Frese 2018, needs none), ``auto`` (classic, and sector where classic finds nothing or
    nothing that holds). Without ``strict``, what the detector says is taken as it is: no test of
    the grid, the corners, the blur. A chessboard or circle grid must be whole; of a ChArUco board
    any 6 corners not in a line will do. ``hidden`` (H, W) marks what a laser's stripe lights: corners
    of a chessboard whose windows reach it are left out before the others are tested.
    """
    grey = grey8(image)
    if int(grey.max()) - int(grey.min()) < 20:
        return NoBoard(name, "flat", f"nothing in it: grey values span {grey.min()} to {grey.max()}")
    if board.kind == "chessboard":
        return _chessboard(grey, board, name, window_px, detector, hidden, strict=strict)
    finder = find_charuco if board.kind == "charuco" else find_circles
    found = finder(grey, board)
    if isinstance(found, Refusal):
        return NoBoard(name, found.cause, found.reason)
    return _view(grey, board, name, found, window_px, strict=strict)


def _chessboard(
    grey: Grey,
    board: Board,
    name: str,
    window_px: int | None,
    detector: Detector,
    hidden: npt.NDArray[np.bool_] | None,
    *,
    strict: bool,
) -> BoardView | NoBoard:
    failed: NoBoard | None = None
    partial: BoardView | None = None
    ways = {"classic": find_classic, "sector": find_sector}
    for way, find in ways.items():
        if detector not in ("auto", way):
            continue
        if way == "sector" and failed is None and partial is None:
            # Looking long for a board of another size is in vain.
            why = explain_missing(grey, board)
            if why is not None and why.clearly:
                return NoBoard(name, why.cause, why.reason)
        corners = find(grey, board)
        if corners is None:
            continue
        found = Found(np.arange(board.points), corners, way)
        view = _view(grey, board, name, found, window_px, hidden, strict=strict)
        if isinstance(view, NoBoard):
            if view.cause == "blur":
                return view
            failed = failed or view
        elif view.whole:
            return view
        else:
            partial = partial or view
    if partial is not None:
        return partial
    why = explain_missing(grey, board) if failed is None or failed.cause == "grid" else None
    if why is not None and (failed is None or why.cause in ("size", "cut")):
        return NoBoard(name, why.cause, why.reason)
    return failed or NoBoard(name, "none", "the board is there, but its corners were not found")


def _right_handed(points_px: Floats, board: Board) -> Floats:
    """A chessboard's points so that the board is seen from its front: x, y turn as u, v do."""
    grid = points_px.reshape(board.rows, board.cols, 2)
    ex, ey = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if ex[0] * ey[1] - ex[1] * ey[0] < 0:
        grid = grid[:, ::-1]
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _view(
    grey: Grey,
    board: Board,
    name: str,
    found: Found,
    window_px: int | None,
    hidden: npt.NDArray[np.bool_] | None = None,
    *,
    strict: bool,
) -> BoardView | NoBoard:
    points, ids = found.points_px, found.ids
    if board.kind == "chessboard":
        points = _right_handed(points, board)
    rough = examine(points, ids, board)
    if not np.isfinite(rough.square_px):
        return NoBoard(name, "few", rough.wrong)
    window = 0
    if board.kind in ("chessboard", "charuco"):
        window = window_px or _window(grey, points, ids, board, rough.square_px)
        points = _refined(grey, points, window)
    blur = np.nan
    lit = np.empty(0, np.int64)
    clear = np.ones(len(ids), np.bool_)
    if hidden is not None:
        clear = ~_reaches(hidden, points, window)
        lit = np.asarray(ids)[~clear]
        left = np.asarray(ids)[clear]
        if clear.sum() < _CLEAR_SHARE * len(clear) or not in_one_piece(points[clear], left, board):
            why = (
                f"a stripe hides {lit.size} of its {board.points} corners, the others are no flat board"
            )
            return NoBoard(name, "grid", why)
    lattice = examine(points[clear], np.asarray(ids)[clear], board)
    wanted = lattice.wrong and hidden is None
    dropped = disturbed(points, ids, board) if wanted else np.empty(0, np.int64)
    if strict and lattice.wrong and not dropped.size:
        return NoBoard(name, "grid", lattice.wrong + _too_wide(window, rough.square_px))
    if board.kind == "chessboard":
        wrong, faint = check_chessboard(grey, points, board, lit)
        if strict and wrong is not None:
            return NoBoard(name, wrong.cause, wrong.reason)
        dropped = np.unique(np.concatenate([dropped, faint, lit])).astype(np.int64)
        blur = edge_blur_px(grey, points, board)
        if strict and blur > max(SHARP_PX, BLUR_SHARE * lattice.median_px):
            return NoBoard(
                name,
                "blur",
                f"blurred: edges are {blur:.1f} px wide (1 sigma), squares {lattice.median_px:.0f} px",
            )
    if strict and dropped.size:
        kept = ~np.isin(ids, dropped)
        points, ids = points[kept], ids[kept]
        lattice = examine(points, ids, board)
    height, width = grey.shape
    return BoardView(
        name=name,
        board=board,
        ids=np.asarray(ids, np.int64),
        points_px=points,
        points_mm=board.object_points_mm()[ids],
        width_px=width,
        height_px=height,
        square_px=lattice.square_px,
        window_px=window,
        irregular_px=lattice.irregular_px,
        blur_px=blur,
        detector=found.detector,
    )


def _reaches(hidden: npt.NDArray[np.bool_], points: Floats, window_px: int) -> npt.NDArray[np.bool_]:
    """Which points (N, 2) have a window that reaches a hidden pixel."""
    size = 2 * window_px + 1
    near = cv2.dilate(hidden.astype(np.uint8), np.ones((size, size), np.uint8))
    column, row = np.rint(points).astype(int).T
    height, width = near.shape
    return np.asarray(near[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] > 0, np.bool_)


def _too_wide(window_px: int, square_px: float) -> str:
    if window_px <= WINDOW_SHARE * square_px + 1:
        return ""
    reach = f"the corner window of {window_px} px reaches the next corners"
    return f" ({reach}: squares are {square_px:.0f} px)"


def _window(grey: Grey, points: Floats, ids: npt.ArrayLike, board: Board, square_px: float) -> int:
    """Half-window: a share of the smallest square, no more than is useful, and clear of markers."""
    if board.marker_mm is not None:
        gap = 0.5 * (1.0 - board.marker_mm / min(board.square_x_mm, board.square_y_mm)) * square_px
        return int(max(2, min(corner_window_px(square_px), gap)))
    blur = 0.0
    if WINDOW_SHARE * square_px > WIDEST_WINDOW_PX and np.size(ids) == board.points:
        blur = edge_blur_px(grey, points, board)
    return corner_window_px(square_px, blur)


def _refined(grey: Grey, points_px: Floats, window_px: int) -> Floats:
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    start = np.ascontiguousarray(points_px.astype(np.float32).reshape(-1, 1, 2))
    done = cv2.cornerSubPix(grey, start, (window_px, window_px), (-1, -1), stop)
    return np.asarray(done, np.float64).reshape(-1, 2)
