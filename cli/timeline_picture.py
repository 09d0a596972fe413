"""A picture of which calibration holds when: a band a rig, a bar a certification, a tick a scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..schemas.errors import StorageError
from .places import show_time

if TYPE_CHECKING:
    from ..store.timeline import Entry

Band = tuple[list["Entry"], list[int], tuple[int, int]]
Colour = tuple[int, int, int]

_OVER = 2
_INK: Colour = (60, 50, 45)
_FAINT: Colour = (215, 210, 205)
_WITHDRAWN: Colour = (120, 120, 225)
_REPLACED: Colour = (200, 195, 190)
_LEFT, _RIGHT = 260, 240
#: Bars of calibrations that hold, told apart by colour (Okabe and Ito's palette, as BGR).
_HOLDING: list[Colour] = [(178, 114, 0), (115, 158, 0), (0, 159, 230), (167, 121, 204), (0, 94, 213)]


def draw(rigs: dict[str, Band], out: Path, *, width_px: int = 1200) -> None:
    """Write the PNG; raises a StorageError if it cannot be written."""
    heights = [34 + 30 * len(entries) + 36 for entries, _, _ in rigs.values()]
    height_px = 30 + (sum(heights) or 60)
    canvas = np.full((height_px * _OVER, width_px * _OVER, 3), 255, np.uint8)
    top = 12
    if not rigs:
        _text(canvas, "no calibration was ever certified", 24, 44, 0.6)
    for (rig, band), height in zip(rigs.items(), heights, strict=True):
        _band(canvas, rig, band, top, width_px)
        top += height
    small = cv2.resize(canvas, (width_px, height_px), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small)
    assert ok
    try:
        out.write_bytes(np.asarray(data).tobytes())
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}") from error


def _band(canvas: np.ndarray, rig: str, band: Band, top: int, width_px: int) -> None:
    entries, scans, (begin, end) = band
    right = width_px - _RIGHT
    bottom = top + 34 + 30 * len(entries)

    def x(t_ns: int | None, otherwise: int) -> int:
        if t_ns is None:
            return otherwise
        return round(_LEFT + (right - _LEFT) * (t_ns - begin) / (end - begin))

    _text(canvas, f"rig {rig}", 24, top + 20, 0.6)
    for t_ns in np.linspace(begin, end, 5).round().astype(int):
        at = x(int(t_ns), 0)
        _box(canvas, at, top + 28, at + 1, bottom + 14, _FAINT)
        _text(canvas, show_time(int(t_ns))[:10], at - 34, top + 20, 0.4)
    names = list(dict.fromkeys(e.certified.calibration for e in entries))
    for i, entry in enumerate(entries):
        event, y = entry.certified, top + 34 + 30 * i
        colour = _WITHDRAWN if entry.state == "withdrawn" else _REPLACED
        ends = (x(event.from_ns, _LEFT), max(x(event.to_ns, right), x(event.from_ns, _LEFT) + 2))
        _box(canvas, ends[0], y + 9, ends[1], y + 15, colour)
        shade = _HOLDING[names.index(event.calibration) % len(_HOLDING)]
        for some in entry.effective:
            begins, stops = x(some[0], _LEFT), max(x(some[1], right), x(some[0], _LEFT) + 2)
            _box(canvas, begins, y + 3, stops, y + 21, shade)
        # A range without an end goes on beyond the picture: an arrow says so.
        if event.from_ns is None:
            holds = any(some[0] is None for some in entry.effective)
            _arrow(canvas, _LEFT, y + 12, -1, shade if holds else colour)
        if event.to_ns is None:
            holds = any(some[1] is None for some in entry.effective)
            _arrow(canvas, right, y + 12, 1, shade if holds else colour)
        _text(canvas, event.calibration, 36, y + 17, 0.48)
        forced = ", forced" if event.objections else ""
        _text(canvas, entry.state + forced, right + 16, y + 17, 0.45)
    for t_ns in scans:
        at = x(t_ns, 0)
        _box(canvas, at, bottom + 2, at + 2, bottom + 14, _INK)
    if scans:
        _text(canvas, "scans", 36, bottom + 13, 0.45)


def _arrow(canvas: np.ndarray, x: int, y: int, way: int, colour: Colour) -> None:
    """A triangle at x whose tip points left (-1) or right (1)."""
    corners = [(x, y - 9), (x, y + 9), (x + 10 * way, y)]
    cv2.fillConvexPoly(canvas, np.array(corners, np.int32) * _OVER, colour, cv2.LINE_AA)


def _box(canvas: np.ndarray, x0: int, y0: int, x1: int, y1: int, colour: Colour) -> None:
    canvas[y0 * _OVER : y1 * _OVER, x0 * _OVER : x1 * _OVER] = colour


def _text(canvas: np.ndarray, text: str, x: int, y: int, size: float) -> None:
    at = (x * _OVER, y * _OVER)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size * _OVER, _INK, _OVER, cv2.LINE_AA)
