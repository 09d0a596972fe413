"""A chessboard made white: its print is taken out of a frame before stripes are sought.

White squares between black ones are thin bright places, too, and brighter than a faint laser; and
where a stripe crosses the edge of a square, its centre is drawn to the white side. The board's pose
says where the squares are: each one's own median grey is its print, and what is near an edge is left
out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from ...schemas.calibration import Intrinsics
from ..camera import project, undistort_points
from .pose import BoardPose

Floats = npt.NDArray[np.float64]

#: Nearer to an edge than this the blur of the edge is stronger than a faint stripe.
EDGE_PX = 2.0
#: Neighbouring cells have an edge between them if they differ by this share of the print's contrast.
_EDGE_SHARE = 0.2


@dataclass(frozen=True)
class WhiteBoard:
    """``grey`` (H, W): the frame with the squares as bright as the white ones, and flat at their edges.

    ``edge_px`` (H, W) is how far each pixel is from the nearest edge of a square; infinite far away.
    """

    grey: npt.NDArray[Any]
    edge_px: npt.NDArray[np.float32]


def whitened(
    grey: npt.NDArray[Any], board: Board, pose: BoardPose, camera: Intrinsics
) -> WhiteBoard | None:
    """The frame ``grey`` (H, W) without a chessboard's print; None for other boards."""
    if board.kind != "chessboard":
        return None
    square = _squares(grey.shape, board, pose, camera)
    if square is None:
        return None
    top, left, number = square
    height, width = number.shape
    part = grey[top : top + height, left : left + width]
    on = number >= 0
    inside = on & (_away_from(_borders(number, 0.0)) >= EDGE_PX)
    columns, rows = board.cols + 1, board.rows + 1
    level, known = _medians(number[inside], part[inside], columns * rows)
    white = _white(level, known, columns)
    if white is None:
        return None
    cell = np.where(on, number, 0)
    shown = np.where(on, np.where(known, level, white)[cell], float(white.mean()))
    edge_px = _away_from(_borders(shown, _EDGE_SHARE * float(np.ptp(level[known]))))
    flat = white[cell]
    clean = np.where(on, part + (flat - shown), part)
    # Beside the squares, near their edges, the board is white as well.
    clean = np.where(edge_px < EDGE_PX, np.where(on, flat, np.maximum(part, float(white.min()))), clean)
    out, far = grey.copy(), np.full(grey.shape, np.float32(np.inf))
    most = float(np.iinfo(grey.dtype).max) if np.issubdtype(grey.dtype, np.integer) else np.inf
    out[top : top + height, left : left + width] = np.clip(np.rint(clean), 0.0, most).astype(grey.dtype)
    far[top : top + height, left : left + width] = edge_px
    return WhiteBoard(out, far)


def _white(level: Floats, known: npt.NDArray[np.bool_], columns: int) -> Floats | None:
    """How bright each square would be if it were white, by a plane through the white ones; or None."""
    number = np.arange(len(level))
    i, j = number % columns, number // columns
    even = (i + j) % 2 == 0
    if (known & even).sum() < 4 or (known & ~even).sum() < 4:
        return None
    bright = even if np.median(level[known & even]) > np.median(level[known & ~even]) else ~even
    design = np.stack([np.ones(len(level)), i, j], axis=1)
    found = np.linalg.lstsq(design[known & bright], level[known & bright], rcond=None)[0]
    return np.asarray(design @ found, np.float64)


def _borders(value: npt.NDArray[Any], step: float) -> npt.NDArray[np.uint8]:
    """1 where a pixel differs by more than ``step`` from the one left of it, or above."""
    out = np.zeros(value.shape, np.uint8)
    out[:, 1:] |= np.abs(value[:, 1:] - value[:, :-1]) > step
    out[1:] |= np.abs(value[1:] - value[:-1]) > step
    return out


def _away_from(border: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    return np.asarray(cv2.distanceTransform(1 - border, cv2.DIST_L2, 3), np.float32)


def _squares(
    shape: tuple[int, ...], board: Board, pose: BoardPose, camera: Intrinsics
) -> tuple[int, int, npt.NDArray[np.int64]] | None:
    """Top, left, and the number of the square that each pixel from there shows; -1 beside them."""
    sx, sy = board.square_x_mm, board.square_y_mm
    x = np.linspace(-sx, board.cols * sx, 4 * (board.cols + 1) + 1)
    y = np.linspace(-sy, board.rows * sy, 4 * (board.rows + 1) + 1)
    flat = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    u, v = project(pose.to_camera(np.column_stack([flat, np.zeros(len(flat))])), camera)
    good = np.isfinite(u) & np.isfinite(v)
    if not good.any():
        return None
    low = np.floor([v[good].min() - 4, u[good].min() - 4]).astype(np.int64)
    high = np.ceil([v[good].max() + 5, u[good].max() + 5]).astype(np.int64)
    top, left = np.maximum(low, 0)
    bottom, right = np.minimum(high, shape[:2])
    if bottom - top < 3 or right - left < 3:
        return None
    rows, columns = np.mgrid[top:bottom, left:right]
    xn, yn = undistort_points(columns.ravel() + 0.0, rows.ravel() + 0.0, camera)
    # The board's plane from the rays by the inverse of (first column, second column, shift).
    plane = np.linalg.inv(
        np.column_stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation_mm])
    )
    with np.errstate(all="ignore"):
        third = plane[2, 0] * xn + plane[2, 1] * yn + plane[2, 2]
        i = np.floor((plane[0, 0] * xn + plane[0, 1] * yn + plane[0, 2]) / third / sx) + 1
        j = np.floor((plane[1, 0] * xn + plane[1, 1] * yn + plane[1, 2]) / third / sy) + 1
        on = (third > 0) & (i >= 0) & (i <= board.cols) & (j >= 0) & (j <= board.rows)
        number = np.where(on, j * (board.cols + 1) + i, -1.0)
    return int(top), int(left), number.astype(np.int64).reshape(rows.shape)


def _medians(
    number: npt.NDArray[np.int64], grey: npt.NDArray[Any], count: int
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """The median grey value of each number below ``count``, and whether there is one."""
    order = np.lexsort((grey, number))
    first = np.searchsorted(number[order], np.arange(count + 1))
    known = first[1:] > first[:-1]
    out = np.zeros(count)
    out[known] = grey[order][((first[:-1] + first[1:]) // 2)[known]]
    return out, known
