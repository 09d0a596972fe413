"""Chessboard corners by OpenCV's two detectors, and what is seen where both find nothing."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from .lattice import Grey, axes
from .patterns import Refusal

Floats = npt.NDArray[np.float64]

#: The detectors work on images of at most these sizes; the corners are refined in the full one.
_CLASSIC_PX = 1600
_SECTOR_PX = 1000


def find_classic(grey: Grey, board: Board) -> Floats | None:
    """All corners by OpenCV's detector of quads, (N, 2) px to a pixel or two, row by row; or None."""
    small, scale = _shrunk(grey, _CLASSIC_PX)
    pattern = (board.cols, board.rows)
    ok, corners = cv2.findChessboardCorners(small, pattern)
    if not ok and scale < 1.0:
        scale = 1.0
        ok, corners = cv2.findChessboardCorners(grey, pattern)
    return _enlarged(corners, scale) if ok else None


def find_sector(grey: Grey, board: Board) -> Floats | None:
    """The same by the sector-based detector (Duda and Frese 2018), which needs no white border."""
    small, scale = _shrunk(grey, _SECTOR_PX)
    for flags in (cv2.CALIB_CB_EXHAUSTIVE, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE):
        ok, corners = cv2.findChessboardCornersSB(small, (board.cols, board.rows), flags=flags)
        if ok:
            return _enlarged(corners, scale)
    return None


def _shrunk(grey: Grey, most_px: int) -> tuple[Grey, float]:
    scale = min(1.0, float(most_px) / max(grey.shape))
    if scale == 1.0:
        return grey, scale
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return small.astype(np.uint8, copy=False), scale


def _enlarged(corners: Any, scale: float) -> Floats:
    """Points of a shrunk image in the full one: borders map onto borders, not pixel centres."""
    return (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5


def explain_missing(grey: Grey, board: Board) -> Refusal | None:
    """What is seen of the board all the same: a part, or one of another size; None: all of it."""
    small, scale = _shrunk(grey, _SECTOR_PX)
    ok, corners, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), cv2.CALIB_CB_LARGER)
    if not ok:
        return Refusal("none", "no chessboard found")
    rows, cols = meta.shape[:2]
    (long, short), (wide, narrow) = sorted((cols, rows))[::-1], sorted((board.cols, board.rows))[::-1]
    if long > wide or short > narrow:
        said = f"{board.cols}x{board.rows} inner corners were said"
        # One row more may be the board's outer edge, taken for corners.
        clearly = long >= wide and short >= narrow and long + short >= wide + narrow + 2
        text = f"a chessboard of {long}x{short} inner corners is seen, {said}"
        return Refusal("size", text, clearly)
    if (long, short) == (wide, narrow):
        return None
    seen = f"{long}x{short} of {wide}x{narrow} corners"
    grid = _enlarged(corners, scale).reshape(rows, cols, 2)
    # Where the corners and edges beyond the last ones would be, two squares on.
    ex, ey = axes(grid)
    around = (
        grid[:, 0] - 2 * ex[:, 0],
        grid[:, -1] + 2 * ex[:, -1],
        grid[0] - 2 * ey[0],
        grid[-1] + 2 * ey[-1],
    )
    beyond = np.concatenate(around)
    height, width = grey.shape
    if ((beyond < 0) | (beyond > (width - 1, height - 1))).any():
        return Refusal("cut", f"the board is cut by the image border: {seen} seen")
    return Refusal("none", f"only a part of the board was recognised: {seen}")
