"""Options that describe a board, and the board that they describe."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import UsageError

if TYPE_CHECKING:
    from ..schemas.board import Board


class KindWord(StrEnum):
    """Kinds of boards."""

    chessboard = "chessboard"
    charuco = "charuco"
    circles = "circles"
    acircles = "acircles"


class DetectorWord(StrEnum):
    """How chessboards are found."""

    auto = "auto"
    classic = "classic"
    sector = "sector"


PatternOption = Annotated[
    str | None,
    typer.Option(
        "--pattern",
        metavar="COLSxROWS",
        help="Inner corners of a chessboard or ChArUco board (squares less one), or circles.",
    ),
]
SquareOption = Annotated[
    str | None,
    typer.Option(
        "--square-mm", metavar="MM[xMM]", help="Cell, or distance of circles; 30x29.8 if not square."
    ),
]
BoardKindOption = Annotated[KindWord, typer.Option("--board", help="Kind of board.")]
MarkerOption = Annotated[float | None, typer.Option("--marker-mm", help="ChArUco: side of a marker.")]
DictionaryOption = Annotated[
    str | None, typer.Option("--dictionary", metavar="NAME", help="ChArUco: such as 5X5_100.")
]
LegacyOption = Annotated[
    bool, typer.Option("--legacy", help="ChArUco: printed before OpenCV 4.6, even rows.")
]
CornerWindowOption = Annotated[
    int | None,
    typer.Option(
        "--corner-window",
        metavar="PX",
        min=1,
        max=60,
        help="Half-window of the corner refinement; else from the squares' size, 11 at most.",
    ),
]
DetectorOption = Annotated[
    DetectorWord,
    typer.Option("--detector", help="classic wants a white border, sector none; auto tries both."),
]


def parse_board(
    kind: KindWord,
    pattern: str | None,
    square_mm: str | None,
    marker_mm: float | None,
    dictionary: str | None,
    *,
    legacy: bool = False,
) -> Board:
    """The board that the options describe.

    Raises
    ------
    UsageError
        An option is missing, is no size, or contradicts another.
    """
    from pydantic import ValidationError

    from ..schemas.board import Board

    if pattern is None or square_mm is None:
        raise UsageError(
            "the board is not described",
            hint="such as --pattern 9x6 --square-mm 30: 9 by 6 inner corners, 30 mm squares",
        )
    counts = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", pattern.strip())
    if counts is None:
        raise UsageError(f"--pattern {pattern!r}: expected COLSxROWS", hint="such as --pattern 9x6")
    sides = re.fullmatch(r"([0-9.]+)(?:[xX]([0-9.]+))?", square_mm.strip())
    try:
        x = float(sides.group(1)) if sides else 0.0
        y = float(sides.group(2) or sides.group(1)) if sides else 0.0
    except ValueError:
        x = y = 0.0
    if x <= 0 or y <= 0:
        raise UsageError(
            f"--square-mm {square_mm!r}: expected a length in mm, or two", hint="such as 30, or 30x29.8"
        )
    name = dictionary.upper().removeprefix("DICT_") if dictionary else None
    try:
        return Board(
            kind=kind.value,
            cols=int(counts.group(1)),
            rows=int(counts.group(2)),
            square_x_mm=x,
            square_y_mm=y,
            marker_mm=marker_mm,
            dictionary=name,
            legacy=legacy,
        )
    except ValidationError as error:
        first = error.errors()[0]
        text = str(first["msg"]).removeprefix("Value error, ")
        where = f"{first['loc'][0]}: " if first["loc"] else ""
        raise UsageError(
            f"the board cannot be: {where}{text}", hint="see --help for each option"
        ) from error
