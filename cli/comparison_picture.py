"""A picture of the shifts between two derivations: where they are, by range, by length."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.errors import StorageError

if TYPE_CHECKING:
    from ..process.compare import ShiftGrid, Shifts

Canvas = npt.NDArray[np.uint8]
Box = tuple[int, int, int, int]
Floats = npt.NDArray[np.float64]

_OVER = 2
_INK = (60, 50, 45)
_FAINT = (225, 221, 217)
_RMS = (178, 114, 0)
_BIAS = (0, 94, 213)
_WIDTH, _HEIGHT = 1280, 760


def draw(out: Path, title: str, shifts: Shifts, grid: ShiftGrid) -> None:
    """Write the PNG; raises a StorageError if it cannot be written."""
    canvas: Canvas = np.full((_HEIGHT * _OVER, _WIDTH * _OVER, 3), 255, np.uint8)
    told = shifts.statistics()
    _text(canvas, title[:100], 28, 34, 0.62)
    if told.rms_mm is None or told.bias_mm is None or told.p95_mm is None or told.max_mm is None:
        _text(canvas, "no points match", 28, 62, 0.5)
    else:
        line = (
            f"{told.matched} points: rms {told.rms_mm:.3g} mm, bias of range {told.bias_mm:+.3g} mm, "
            f"95 % below {told.p95_mm:.3g} mm, largest {told.max_mm:.3g} mm"
        )
        _text(canvas, line, 28, 62, 0.5)
        _map(canvas, (70, 110, 640, 660), grid, told.p95_mm)
        _ranges(canvas, (780, 110, 1240, 360), told)
        _lengths(canvas, (780, 450, 1240, 660), shifts)
    small = cv2.resize(canvas, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small)
    assert ok
    try:
        out.write_bytes(np.asarray(data).tobytes())
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}") from error


def _map(canvas: Canvas, box: Box, grid: ShiftGrid, most_mm: float) -> None:
    """Mean length over frame (across) and row (down)."""
    x0, y0, x1, y1 = box
    mean = grid.mean_mm()
    part = np.nan_to_num(mean / max(most_mm, 1e-12), nan=0.0)
    shade = np.clip(np.rint(part * 255), 0, 255).astype(np.uint8)
    image = np.asarray(cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS))
    image[np.isnan(mean)] = (246, 244, 242)
    size = ((x1 - x0) * _OVER, (y1 - y0) * _OVER)
    inside = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    canvas[y0 * _OVER : y1 * _OVER, x0 * _OVER : x1 * _OVER] = inside
    _frame(canvas, box)
    _text(canvas, "mean shift over frame and row", x0, y0 - 12, 0.5)
    _text(canvas, "0", x0 - 4, y1 + 20, 0.42)
    _text(canvas, f"frame {grid.frames}", x1 - 70, y1 + 20, 0.42)
    _text(canvas, "row 0", x0 - 48, y0 + 10, 0.42)
    _text(canvas, f"{grid.rows}", x0 - 42, y1, 0.42)
    bar = np.linspace(0, 255, 180 * _OVER).round().astype(np.uint8)[None]
    ramp = np.asarray(cv2.applyColorMap(np.repeat(bar, 10 * _OVER, 0), cv2.COLORMAP_VIRIDIS))
    canvas[(y1 + 34) * _OVER : (y1 + 44) * _OVER, x0 * _OVER : (x0 + 180) * _OVER] = ramp
    _text(canvas, f"0 to {most_mm:.3g} mm and more", x0 + 192, y1 + 44, 0.45)


def _ranges(canvas: Canvas, box: Box, told: Any) -> None:
    """Rms of the shift and bias of the range, by range."""
    bins = told.by_range
    x = np.array([(b.from_mm + b.to_mm) / 2 for b in bins])
    low, high = min(b.from_mm for b in bins), max(b.to_mm for b in bins)
    rms, bias = (np.array([getattr(b, n) for b in bins]) for n in ("rms_mm", "bias_mm"))
    bottom, top = min(0.0, float(bias.min())), max(float(rms.max()), float(bias.max()), 1e-9)
    bottom, top = bottom - 0.06 * (top - bottom), top + 0.06 * (top - bottom)
    _axes(
        canvas,
        box,
        (low, high),
        (bottom, top),
        "range, mm",
        "rms (blue) and bias of range (orange), mm",
    )
    for values, colour in ((rms, _RMS), (bias, _BIAS)):
        px = _scaled(x, low, high, box[0], box[2])
        py = _scaled(values, bottom, top, box[3], box[1])
        line = np.stack([px, py], axis=1).round().astype(np.int32)
        closed = False
        cv2.polylines(canvas, [line.reshape(-1, 1, 2)], closed, colour, 2 * _OVER, cv2.LINE_AA)
        for point in line:
            cv2.circle(canvas, (int(point[0]), int(point[1])), 4 * _OVER, colour, -1, cv2.LINE_AA)


def _lengths(canvas: Canvas, box: Box, shifts: Shifts) -> None:
    """How many points have a shift of which length."""
    edges, counts = shifts.length_histogram()
    most = 1.06 * (float(counts.max()) or 1.0)
    _axes(
        canvas,
        box,
        (0.0, float(edges[-1])),
        (0.0, most),
        "length of the shift, mm",
        "points",
    )
    left = _scaled(edges, 0.0, float(edges[-1]), box[0], box[2]).round().astype(int)
    top = _scaled(counts, 0.0, most, box[3], box[1]).round().astype(int)
    for i, y in enumerate(top):
        canvas[y : box[3] * _OVER, left[i] + 1 : max(left[i + 1], left[i] + 2)] = _RMS
    _frame(canvas, box)


def _scaled(values: npt.NDArray[Any], low: float, high: float, at_low: int, at_high: int) -> Floats:
    part = (np.asarray(values, np.float64) - low) / max(high - low, 1e-300)
    return np.asarray((at_low + part * (at_high - at_low)) * _OVER)


def _axes(
    canvas: Canvas, box: Box, x: tuple[float, float], y: tuple[float, float], under: str, over: str
) -> None:
    x0, y0, x1, y1 = box
    for value in _ticks(*x):
        at = int(_scaled(np.array(value), *x, x0, x1))
        canvas[y0 * _OVER : y1 * _OVER, at : at + _OVER] = _FAINT
        _text(canvas, f"{value:g}", at // _OVER - 14, y1 + 18, 0.42)
    for value in _ticks(*y):
        at = int(_scaled(np.array(value), *y, y1, y0))
        canvas[at : at + _OVER, x0 * _OVER : x1 * _OVER] = _FAINT
        _text(canvas, f"{value:g}", x0 - 62, at // _OVER + 4, 0.42)
    _frame(canvas, box)
    _text(canvas, under, x0, y1 + 40, 0.45)
    _text(canvas, over, x0, y0 - 12, 0.5)


def _ticks(low: float, high: float) -> Floats:
    """About five round numbers within [low, high]."""
    width = max(high - low, 1e-12) / 5
    power = 10.0 ** math.floor(math.log10(width))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= width)
    ticks = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step
    # 0.30000000000000004 is no round number.
    return np.round(ticks, 12)


def _frame(canvas: Canvas, box: Box) -> None:
    x0, y0, x1, y1 = (v * _OVER for v in box)
    cv2.rectangle(canvas, (x0, y0), (x1, y1), _INK, _OVER)


def _text(canvas: Canvas, text: str, x: int, y: int, size: float) -> None:
    at = (x * _OVER, y * _OVER)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size * _OVER, _INK, _OVER, cv2.LINE_AA)
