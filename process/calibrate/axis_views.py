"""From frames to sightings: points of a board, or corners of markers, that turn with the table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from ...schemas.calibration import Intrinsics
from ...schemas.errors import CalibrationError
from .axis_adjust import Sightings
from .boards import NoBoard, find_board, grey8
from .markers import find_markers, marker_points_mm
from .plane_views import check_size

#: A marker that is seen in fewer frames says nothing about the axis.
_LEAST_SEEN = 2


@dataclass(frozen=True)
class Watched:
    """Sightings of all frames, the markers (or the board) behind the bodies, and what was odd."""

    sightings: Sightings
    bodies: tuple[str, ...]
    odd: tuple[tuple[str, str], ...]


def watch_board(
    frames: Iterable[tuple[str, npt.NDArray[Any]]], board: Board, camera: Intrinsics
) -> Watched:
    """The points of one board in every frame that shows it."""
    parts: list[tuple[int, int, npt.NDArray[np.float64], npt.NDArray[np.float64]]] = []
    odd = []
    # Points are meant about the board's middle: its turning is then no shift.
    middle = board.object_points_mm().mean(axis=0)
    for k, (name, image) in enumerate(frames):
        check_size(name, image, camera)
        found = find_board(image, board, name=name)
        if isinstance(found, NoBoard):
            odd.append((name, found.reason))
        else:
            parts.append((k, 0, found.points_mm - middle, found.points_px))
    return Watched(_joined(parts, f"the board ({board.describe()})", odd), ("board",), tuple(odd))


def watch_markers(
    frames: Iterable[tuple[str, npt.NDArray[Any]]],
    dictionary: str,
    side_mm: float,
    camera: Intrinsics,
    *,
    numbers: set[int] | None = None,
) -> Watched:
    """The corners of all markers of one size; where they stand on the table is found by the fit."""
    parts: list[tuple[int, int, npt.NDArray[np.float64], npt.NDArray[np.float64]]] = []
    odd: list[tuple[str, str]] = []
    corners = marker_points_mm(side_mm)
    for k, (name, image) in enumerate(frames):
        check_size(name, image, camera)
        found, twice = find_markers(grey8(image), dictionary, numbers=numbers)
        if twice:
            shown = ", ".join(map(str, twice))
            odd.append((name, f"marker {shown} is seen twice: which one is meant?"))
        parts += [(k, m.number, corners, m.corners_px) for m in found]
    seen = [p[1] for p in parts]
    rare = {n for n in seen if seen.count(n) < _LEAST_SEEN}
    for number in sorted(rare):
        odd.append((f"marker {number}", "seen in one frame only"))
    parts = [p for p in parts if p[1] not in rare]
    what = f"markers of {dictionary}"
    sightings = _joined(parts, what, odd)
    return Watched(sightings, tuple(f"marker {n}" for n in sorted({p[1] for p in parts})), tuple(odd))


def _joined(
    parts: list[tuple[int, int, npt.NDArray[np.float64], npt.NDArray[np.float64]]],
    what: str,
    odd: list[tuple[str, str]],
) -> Sightings:
    if not parts:
        why = f": {odd[0][1]}" if odd else ""
        raise CalibrationError(
            f"{what} was found in no frame{why}",
            hint="is it the right pattern or dictionary, sharp and whole in the frames?",
        )
    return Sightings(
        frame=np.concatenate([np.full(len(p[3]), p[0]) for p in parts]),
        body=np.concatenate([np.full(len(p[3]), p[1]) for p in parts]),
        points_mm=np.concatenate([p[2] for p in parts]),
        seen_px=np.concatenate([p[3] for p in parts]),
    )
