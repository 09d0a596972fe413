"""A calibration board: its kind, how its points are counted, and where they lie in board space.

Board space: origin at point 0, x along a row of points, y along a column of points, z = 0 on the
board and pointing away from the viewer (x right, y down as printed), mm. Points are numbered row by
row: ``id = row * cols + col``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from .document import Model

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

BoardKind = Literal["chessboard", "charuco", "circles", "acircles"]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=2, le=200)]

#: OpenCV's predefined dictionaries (objdetect/aruco_dictionary), without the prefix DICT_.
DICTIONARIES: Final = (
    *(f"{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)),
    "ARUCO_ORIGINAL",
    "ARUCO_MIP_36H12",
    "APRILTAG_16H5",
    "APRILTAG_25H9",
    "APRILTAG_36H10",
    "APRILTAG_36H11",
)


class Board(Model):
    """One flat board.

    ``cols`` and ``rows`` count the points that are found on it: inner corners (``chessboard``,
    ``charuco``: one less than the squares each way) or circle centres (``circles``, ``acircles``).
    Points are ``square_x_mm`` apart along a row and ``square_y_mm`` along a column; in an ``acircles``
    grid a row's circles are 2 ``square_x_mm`` apart and every other row is shifted by ``square_x_mm``
    (as OpenCV counts: the usual 4x11 grid has 11 rows of 4). ``marker_mm`` and ``dictionary`` belong to
    ``charuco`` alone, and so does ``legacy`` (a board printed by OpenCV before 4.6 with an even number
    of rows of squares, which begins with a marker at the top left).
    """

    kind: BoardKind = "chessboard"
    cols: Count
    rows: Count
    square_x_mm: Positive
    square_y_mm: Positive
    marker_mm: Positive | None = None
    dictionary: str | None = None
    legacy: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind == "charuco":
            if self.marker_mm is None or self.dictionary is None:
                raise ValueError("a ChArUco board needs marker_mm and dictionary")
            if self.dictionary not in DICTIONARIES:
                raise ValueError(f"dictionary {self.dictionary!r} is none of {' '.join(DICTIONARIES)}")
            if self.marker_mm >= min(self.square_x_mm, self.square_y_mm):
                raise ValueError(f"markers of {self.marker_mm:g} mm do not fit into the squares")
            if not math.isclose(self.square_x_mm, self.square_y_mm, rel_tol=0.2):
                raise ValueError("the squares of a ChArUco board differ by more than 20 % in x and y")
        elif self.marker_mm is not None or self.dictionary is not None or self.legacy:
            raise ValueError(f"marker_mm, dictionary and legacy belong to charuco, not to {self.kind}")
        if self.kind == "chessboard" and min(self.cols, self.rows) < 3:
            raise ValueError(
                f"{self.cols}x{self.rows} inner corners: a chessboard needs 3 at least each way"
            )
        return self

    @property
    def points(self) -> int:
        """How many points the whole board has."""
        return self.cols * self.rows

    def object_points_mm(self) -> npt.NDArray[np.float64]:
        """All points in board space, (cols * rows, 3) float64 in mm, row by row."""
        import numpy as np

        row, col = np.divmod(np.arange(self.points), self.cols)
        across = 2 * col + row % 2 if self.kind == "acircles" else col
        zero = np.zeros(self.points)
        return np.stack([across * self.square_x_mm, row * self.square_y_mm, zero], axis=1)

    def size_mm(self) -> tuple[float, float]:
        """Width and height of the area that the points span."""
        across = 2 * (self.cols - 1) + 1 if self.kind == "acircles" else self.cols - 1
        return across * self.square_x_mm, (self.rows - 1) * self.square_y_mm

    def transposed(self) -> Board:
        """The board with columns and rows exchanged: what a user may have meant."""
        return self.model_copy(
            update={
                "cols": self.rows,
                "rows": self.cols,
                "square_x_mm": self.square_y_mm,
                "square_y_mm": self.square_x_mm,
            }
        )

    def describe(self) -> str:
        """The board in a few words, such as ``chessboard 9x6, 25 mm``."""
        size = f"{self.square_x_mm:g}"
        if self.square_y_mm != self.square_x_mm:
            size += f" x {self.square_y_mm:g}"
        extra = f", markers {self.dictionary} {self.marker_mm:g} mm" if self.kind == "charuco" else ""
        return f"{self.kind} {self.cols}x{self.rows}, {size} mm{extra}"
