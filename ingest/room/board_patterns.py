"""Flat calibration boards: chessboard, ChArUco, circle grid; what is black on them, and their corners.

Board space: x right, y down, z away from the viewer, mm; the origin is where OpenCV has it: the first
inner corner (chessboard), the corner of the first square (ChArUco), the first circle (circle grid).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError
from .rays import Floats


@dataclass(frozen=True)
class Print:
    """What is printed, for the renderer.

    ``white`` (J, I) holds the cells between the lines ``x_mm`` (I + 1,) and ``y_mm`` (J + 1,); around
    them the plate is white, up to ``low_mm`` and ``high_mm``. ``circles_mm`` (N, 2) are black discs of
    ``radius_mm`` on it.
    """

    x_mm: Floats
    y_mm: Floats
    white: npt.NDArray[np.float32]
    circles_mm: Floats
    radius_mm: float
    low_mm: tuple[float, float]
    high_mm: tuple[float, float]


class Board(Protocol):
    """A pattern on a plate."""

    def corners_mm(self) -> Floats:
        """The points (N, 2) that a detector finds, in the order of OpenCV's object points and ids."""

    def printed(self) -> Print:
        """What is black and what is white."""


def _check(columns: int, rows: int, **lengths_mm: float) -> None:
    for name, value in (("columns", columns), ("rows", rows)):
        if value < 2:
            raise InputError(f"a board has at least 2 {name}, not {value}")
    for name, length in lengths_mm.items():
        if not 0 < length < 1e5:
            raise InputError(f"a board with {name} = {length:g} mm cannot be made")


def _bitmap(x_mm: Floats, y_mm: Floats, white: npt.NDArray[np.float32], margin_mm: float) -> Print:
    return Print(
        x_mm,
        y_mm,
        white,
        np.empty((0, 2)),
        1.0,
        (float(x_mm[0]) - margin_mm, float(y_mm[0]) - margin_mm),
        (float(x_mm[-1]) + margin_mm, float(y_mm[-1]) + margin_mm),
    )


def _grid(columns: int, rows: int, step_mm: float) -> Floats:
    """Points (N, 2), row by row."""
    y, x = np.mgrid[0:rows, 0:columns]
    return np.stack([x.ravel(), y.ravel()], axis=1) * step_mm


@dataclass(frozen=True)
class Chessboard:
    """``columns`` x ``rows`` inner corners, as ``findChessboardCorners`` counts; first square black."""

    columns: int
    rows: int
    square_mm: float

    def corners_mm(self) -> Floats:
        """See :class:`Board`."""
        return _grid(self.columns, self.rows, self.square_mm)

    def printed(self) -> Print:
        """See :class:`Board`."""
        _check(self.columns, self.rows, square_mm=self.square_mm)
        y, x = np.mgrid[0 : self.rows + 1, 0 : self.columns + 1]
        return _bitmap(
            np.arange(-1.0, self.columns + 1.0) * self.square_mm,
            np.arange(-1.0, self.rows + 1.0) * self.square_mm,
            ((x + y) % 2).astype(np.float32),
            self.square_mm,
        )


@dataclass(frozen=True)
class Charuco:
    """``columns`` x ``rows`` squares, ArUco markers in the white ones: OpenCV's ``CharucoBoard``."""

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_4X4_50"

    def corners_mm(self) -> Floats:
        """See :class:`Board`."""
        return _grid(self.columns - 1, self.rows - 1, self.square_mm) + self.square_mm

    def printed(self) -> Print:
        """See :class:`Board`."""
        import cv2

        _check(self.columns, self.rows, square_mm=self.square_mm, marker_mm=self.marker_mm)
        if self.marker_mm >= self.square_mm:
            raise InputError(
                f"markers of {self.marker_mm:g} mm do not fit into squares of {self.square_mm:g} mm"
            )
        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or number is None:
            raise InputError(
                f"OpenCV has no ArUco dictionary {self.dictionary!r}", hint="such as DICT_4X4_50"
            )
        known = cv2.aruco.getPredefinedDictionary(number)
        if self.columns * self.rows // 2 > len(known.bytesList):
            raise InputError(
                f"{self.dictionary} has {len(known.bytesList)} markers, the board needs "
                f"{self.columns * self.rows // 2}",
                hint="use a larger dictionary",
            )
        cells = known.markerSize + 2
        rim = (self.square_mm - self.marker_mm) / 2
        inside = rim + np.arange(cells + 1) * self.marker_mm / cells
        lines = np.concatenate([[0.0], inside])
        white = np.zeros((self.rows * (cells + 2), self.columns * (cells + 2)), np.float32)
        marker = 0
        for j in range(self.rows):
            for i in range(self.columns):
                if (i + j) % 2 == 0:
                    continue
                square = np.ones((cells + 2, cells + 2), np.float32)
                square[1:-1, 1:-1] = known.generateImageMarker(marker, cells) > 0
                at = (slice(j * (cells + 2), (j + 1) * (cells + 2)),)
                white[(*at, slice(i * (cells + 2), (i + 1) * (cells + 2)))] = square
                marker += 1
        ticks = [
            np.append((np.arange(n)[:, None] * self.square_mm + lines).ravel(), n * self.square_mm)
            for n in (self.columns, self.rows)
        ]
        return _bitmap(ticks[0], ticks[1], white, self.square_mm / 2)


@dataclass(frozen=True)
class CircleGrid:
    """Black circles, as ``findCirclesGrid`` counts them.

    Asymmetric: every second row is shifted by ``spacing_mm``; circles of a row are twice that apart.
    """

    columns: int
    rows: int
    spacing_mm: float
    diameter_mm: float
    asymmetric: bool = False

    def corners_mm(self) -> Floats:
        """See :class:`Board`."""
        if not self.asymmetric:
            return _grid(self.columns, self.rows, self.spacing_mm)
        y, x = np.mgrid[0 : self.rows, 0 : self.columns]
        return np.stack([(2 * x + y % 2).ravel(), y.ravel()], axis=1) * self.spacing_mm

    def printed(self) -> Print:
        """See :class:`Board`."""
        _check(self.columns, self.rows, spacing_mm=self.spacing_mm, diameter_mm=self.diameter_mm)
        if self.diameter_mm >= self.spacing_mm * (2**0.5 if self.asymmetric else 1.0):
            raise InputError(
                f"circles of {self.diameter_mm:g} mm that stand {self.spacing_mm:g} mm apart overlap"
            )
        centres = self.corners_mm()
        margin = self.spacing_mm
        low, high = centres.min(axis=0) - margin, centres.max(axis=0) + margin
        return Print(
            np.array([low[0], high[0]]),
            np.array([low[1], high[1]]),
            np.ones((1, 1), np.float32),
            centres,
            self.diameter_mm / 2,
            (float(low[0]), float(low[1])),
            (float(high[0]), float(high[1])),
        )
