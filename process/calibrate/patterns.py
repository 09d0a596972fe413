"""ChArUco boards and circle grids in an 8-bit grey image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.board import Board

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

#: Fewer corners fix neither pose nor lens.
FEWEST_CORNERS = 6


Cause = Literal["none", "cut", "size", "grid", "blur", "mirrored", "few", "flat"]


@dataclass(frozen=True)
class Refusal:
    """Why no board in an image is usable, in a word and a sentence; ``clearly``: beyond doubt."""

    cause: Cause
    reason: str
    clearly: bool = False


@dataclass(frozen=True)
class Found:
    """Points as a detector gave them: ids (N,), points (N, 2) px, and the detector's name."""

    ids: npt.NDArray[np.int64]
    points_px: Floats
    detector: str


def dictionary(name: str) -> Any:
    """OpenCV's predefined ArUco dictionary, such as ``4X4_50``."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def charuco_board(board: Board) -> Any:
    """OpenCV's description of a ChArUco board, which counts squares."""
    assert board.marker_mm is not None
    assert board.dictionary is not None
    square = min(board.square_x_mm, board.square_y_mm)
    made = cv2.aruco.CharucoBoard(
        (board.cols + 1, board.rows + 1), square, board.marker_mm, dictionary(board.dictionary)
    )
    made.setLegacyPattern(board.legacy)
    return made


def find_charuco(grey: Grey, board: Board) -> Found | Refusal:
    """Corners of a ChArUco board, those that are seen; or why they cannot be used."""
    found = _detect_charuco(grey, board)
    if len(found.ids) >= FEWEST_CORNERS:
        if np.linalg.matrix_rank(found.points_px - found.points_px.mean(axis=0), tol=5.0) < 2:
            return Refusal("few", f"the {len(found.ids)} corners seen lie in one line")
        return found
    flipped = _detect_charuco(np.ascontiguousarray(grey[:, ::-1]), board)
    if len(flipped.ids) >= FEWEST_CORNERS:
        text = f"{len(flipped.ids)} corners are found once it is flipped, {len(found.ids)} as it is"
        return Refusal("mirrored", f"the image is mirrored: {text}; points from it would be, too")
    assert board.dictionary is not None
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary(board.dictionary)).detectMarkers(grey)
    seen = [] if ids is None else [int(i) for i in np.ravel(ids)]
    if not seen:
        return Refusal("none", f"no marker of dictionary {board.dictionary} found")
    # Markers stand in every other square and are numbered through.
    other = sum(i >= (board.cols + 1) * (board.rows + 1) // 2 for i in seen)
    size = f"{board.cols}x{board.rows} inner corners"
    if other:
        return Refusal("size", f"{other} of {len(seen)} markers do not belong to a board of {size}")
    if len(_detect_charuco(grey, board.transposed()).ids) >= FEWEST_CORNERS:
        return Refusal("size", f"columns and rows are exchanged: the markers do not stand as on {size}")
    return Refusal("few", f"{len(seen)} markers, but only {len(found.ids)} corners between them found")


def _detect_charuco(grey: Grey, board: Board) -> Found:
    detector = cv2.aruco.CharucoDetector(charuco_board(board))
    found: Any = detector.detectBoard(grey)
    points, ids = found[:2]
    if points is None or ids is None:
        return Found(np.empty(0, np.int64), np.empty((0, 2)), "charuco")
    flat = np.asarray(ids, np.int64).ravel()
    order = np.argsort(flat)
    return Found(flat[order], np.asarray(points, np.float64).reshape(-1, 2)[order], "charuco")


def _blobs(grey: Grey, board: Board) -> Any:
    """A detector of round blobs of any size that fits that many into the image."""
    # These two have no type stubs.
    features: Any = cv2
    wanted = features.SimpleBlobDetector_Params()
    wanted.filterByArea = True
    wanted.minArea = 20.0
    wanted.maxArea = float(grey.size) / board.points
    wanted.minDistBetweenBlobs = 5.0
    wanted.filterByConvexity = True
    wanted.minConvexity = 0.9
    wanted.filterByInertia = False
    return features.SimpleBlobDetector_create(wanted)


def find_circles(grey: Grey, board: Board) -> Found | Refusal:
    """Centres of all circles of a grid, dark on bright or bright on dark; or why not."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    for picture in (grey, cv2.bitwise_not(grey)):
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            ok, centres = cv2.findCirclesGrid(
                picture, (board.cols, board.rows), flags=flags, blobDetector=_blobs(grey, board)
            )
            if ok:
                points = np.asarray(centres, np.float64).reshape(-1, 2)
                return Found(np.arange(board.points), points, "circles")
    seen = max(len(_blobs(grey, board).detect(p)) for p in (grey, cv2.bitwise_not(grey)))
    return Refusal("none", f"no grid of {board.cols}x{board.rows} circles among {seen} round spots")
