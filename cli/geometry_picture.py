"""Pictures of laser planes and of the axis: what was found, what is left over, the gates in words."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.errors import StorageError

if TYPE_CHECKING:
    from ..process.calibrate.axis_result import AxisFit
    from ..process.calibrate.plane import PlaneFit
    from ..schemas.calibration import Intrinsics
    from ..schemas.quality import Quality

Floats = npt.NDArray[np.float64]
Canvas = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]
Area = tuple[int, int, int, int]

_INK: Colour = (60, 50, 45)
_FAINT: Colour = (200, 195, 190)
_GOOD: Colour = (70, 130, 60)
_BAD: Colour = (50, 50, 200)
_BLUE: Colour = (190, 110, 40)
#: Everything is drawn this much larger and shrunk at the end, which smooths it.
_OVER = 2
_WIDTH, _ROW = 1500, 620


def draw_planes(
    fits: Sequence[PlaneFit], numbers: Sequence[int], judged: Sequence[Quality], out: Path
) -> None:
    """Write a PNG: for each laser the stripe points in its plane, and how far its views are off it.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    canvas: Canvas = np.full((_ROW * len(fits) * _OVER, _WIDTH * _OVER, 3), 255, np.uint8)
    for i, (fit, number, quality) in enumerate(zip(fits, numbers, judged, strict=True)):
        top = i * _ROW
        title = f"laser {number}: {fit.used} views, rms {fit.rms_mm:.2f} mm, {quality.verdict.upper()}"
        _text(canvas, title, (24, top + 36), 0.75, _BAD if quality.failed() else _INK)
        _stripes(canvas, fit, (24, top + 70, 760, top + _ROW - 60))
        _gates(canvas, quality, 820, top + 76)
        shown = sorted(fit.residuals, key=lambda r: r.name)
        _bars(
            canvas,
            [r.mean_mm for r in shown],
            [r.rms_mm for r in shown],
            [r.used for r in shown],
            (820, top + 110 + 26 * len(quality.gates), _WIDTH - 24, top + _ROW - 60),
            "mean distance of a view's stripe from the plane, mm (line: rms; red: left out)",
        )
    _write(canvas, out)


def draw_axis(
    fit: AxisFit, quality: Quality, camera: Intrinsics, frame: npt.NDArray[Any] | None, out: Path
) -> None:
    """Write a PNG: the first frame with the axis and what turned, and how far the angles are off.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    canvas: Canvas = np.full((_ROW * _OVER, _WIDTH * _OVER, 3), 255, np.uint8)
    title = f"axis: {len(fit.frames)} frames, rms {fit.rms_px:.2f} px, {quality.verdict.upper()}"
    _text(canvas, title, (24, 36), 0.75, _BAD if quality.failed() else _INK)
    scale = min(736 / camera.width_px, (_ROW - 130) / camera.height_px)
    _scene(canvas, fit, camera, frame, (24, 70), scale)
    _gates(canvas, quality, 820, 76)
    top = 110 + 26 * len(quality.gates)
    middle = (top + _ROW) // 2
    order = np.argsort([f.angle_rad for f in fit.frames])
    shown = [fit.frames[i] for i in order]
    none = [0.0] * len(shown)
    _bars(
        canvas,
        [float(np.rad2deg(f.off_rad)) for f in shown],
        none,
        [True] * len(shown),
        (820, top, _WIDTH - 24, middle - 40),
        "angle less scaled nominal angle, deg, by angle",
    )
    _bars(
        canvas,
        [f.rms_px for f in shown],
        none,
        [True] * len(shown),
        (820, middle + 20, _WIDTH - 24, _ROW - 60),
        "rms residual of a frame, px",
    )
    _write(canvas, out)


def _stripes(canvas: Canvas, fit: PlaneFit, area: Area) -> None:
    points = fit.points_mm[:: max(1, len(fit.points_mm) // 20000)]
    off = points @ fit.normal - fit.distance_mm
    outward = points.mean(axis=0) - fit.normal * (fit.normal @ points.mean(axis=0))
    outward = outward / np.linalg.norm(outward)
    side = np.cross(fit.normal, outward)
    x, y = points @ outward, points @ side
    limit = max(float(np.percentile(np.abs(off), 98)), 1e-3)
    left, top, right, bottom = area
    # The camera's centre is at the left edge: what the stripes leave open is seen as well.
    scale = min((right - left) / float(x.max()), (bottom - top) / max(float(np.ptp(y)), 1.0))
    px, py = left + x * scale, (top + bottom) / 2 + (y - (y.min() + y.max()) / 2) * scale
    shade = np.clip((off / limit + 1) * 127.5, 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(shade.reshape(-1, 1), cv2.COLORMAP_COOL).reshape(-1, 3)
    for a, b, c in zip(px, py, colours, strict=True):
        cv2.circle(canvas, (round(a * _OVER), round(b * _OVER)), 2, tuple(int(v) for v in c), -1)
    _line(canvas, (left, bottom + 8), (right, bottom + 8), _FAINT)
    for tick in _ticks(0.0, (right - left) / scale):
        at = left + tick * scale
        _line(canvas, (at, bottom + 4), (at, bottom + 12), _INK)
        _text(canvas, f"{tick:g}", (round(at) - 12, bottom + 30), 0.42, _INK)
    text = f"stripe points in the plane, mm from the camera; colour: +-{limit:.2f} mm off it"
    _text(canvas, text, (left, bottom + 50), 0.45, _INK)


def _scene(
    canvas: Canvas,
    fit: AxisFit,
    camera: Intrinsics,
    frame: npt.NDArray[Any] | None,
    corner: tuple[int, int],
    scale: float,
) -> None:
    from ..process.calibrate.boards import grey8
    from ..process.camera import project

    width, height = round(camera.width_px * scale) * _OVER, round(camera.height_px * scale) * _OVER
    left, top = corner[0] * _OVER, corner[1] * _OVER
    if frame is not None:
        grey = cv2.resize(grey8(frame), (width, height), interpolation=cv2.INTER_AREA)
        canvas[top : top + height, left : left + width] = (grey // 2 + 120)[:, :, None]
    view = canvas[top : top + height, left : left + width]

    def at(points: Floats) -> list[tuple[int, int]]:
        u, v = project(points, camera)
        good = np.isfinite(u) & (np.abs(u) < 1e5) & (np.abs(v) < 1e5)
        return [
            (round((a + 0.5) * scale * _OVER), round((b + 0.5) * scale * _OVER))
            for a, b in zip(u[good], v[good], strict=True)
        ]

    placed, _, _ = fit.turning.place(fit.sightings)
    for spot in at(placed[:: max(1, len(placed) // 4000)]):
        cv2.circle(view, spot, 3, _GOOD, -1, cv2.LINE_AA)
    size = float(np.median(np.linalg.norm(placed - fit.point_mm, axis=1)))
    along = np.linspace(-0.3, 1.6, 60)[:, None] * size * fit.direction + fit.point_mm
    path = at(along)
    for a, b in pairwise(path):
        cv2.line(view, a, b, _BAD, 2 * _OVER, cv2.LINE_AA)
    for spot in at(fit.point_mm[None]):
        cv2.circle(view, spot, 5 * _OVER, _BAD, 2 * _OVER, cv2.LINE_AA)
    text = f"axis (ring: origin, {fit.positive_turn}) and every corner as fitted, in all frames"
    _text(canvas, text, (corner[0], corner[1] + height // _OVER + 24), 0.45, _INK)


def _gates(canvas: Canvas, quality: Quality, x: int, y: int) -> None:
    for i, gate in enumerate(quality.gates):
        mark = "passed" if gate.passed else "FAILED"
        colour = _GOOD if gate.passed else _BAD
        _text(canvas, f"{mark}  {gate.sentence()}", (x, y + 26 * i), 0.5, colour)


def _bars(
    canvas: Canvas,
    values: Sequence[float],
    spread: Sequence[float],
    used: Sequence[bool],
    area: Area,
    title: str,
) -> None:
    left, top, right, bottom = area
    _text(canvas, title, (left, top), 0.45, _INK)
    top += 12
    high = max(1e-6, *values, *spread)
    low = min(0.0, *values, *(-s for s in spread))
    left += 60
    scale = (bottom - top) / (high - low)
    zero = top + high * scale
    step = (right - left) / max(1, len(values))
    for i, (v, s, good) in enumerate(zip(values, spread, used, strict=True)):
        x = left + (i + 0.5) * step
        colour = _BLUE if good else _BAD
        half = max(1.0, 0.35 * step)
        _box(
            canvas,
            (x - half, min(zero, zero - v * scale)),
            (x + half, max(zero, zero - v * scale)),
            colour,
        )
        if s > 0:
            _line(canvas, (x, zero - s * scale), (x, zero + s * scale), _INK)
    _line(canvas, (left, zero), (right, zero), _INK)
    for tick in _ticks(low, high):
        _text(canvas, f"{tick:g}", (left - 56, round(zero - tick * scale) + 5), 0.42, _INK)
        _line(canvas, (left - 6, zero - tick * scale), (left, zero - tick * scale), _INK)


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers between the two."""
    span = max(high - low, 1e-9)
    power = 10.0 ** np.floor(np.log10(span))
    step = next(m * power / 10 for m in (1, 2, 5, 10, 20, 50) if span / (m * power / 10) <= 6)
    first = int(np.ceil(low / step - 1e-9))
    return [float(f"{k * step:.6g}") for k in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def _text(canvas: Canvas, text: str, at: tuple[int, int], size: float, colour: Colour) -> None:
    where = (at[0] * _OVER, at[1] * _OVER)
    cv2.putText(canvas, text, where, cv2.FONT_HERSHEY_SIMPLEX, size * _OVER, colour, _OVER, cv2.LINE_AA)


def _line(canvas: Canvas, a: tuple[float, float], b: tuple[float, float], colour: Colour) -> None:
    ends = [(round(p[0] * _OVER), round(p[1] * _OVER)) for p in (a, b)]
    cv2.line(canvas, ends[0], ends[1], colour, _OVER, cv2.LINE_AA)


def _box(canvas: Canvas, a: tuple[float, float], b: tuple[float, float], colour: Colour) -> None:
    ends = [(round(p[0] * _OVER), round(p[1] * _OVER)) for p in (a, b)]
    cv2.rectangle(canvas, ends[0], ends[1], colour, -1)


def _write(canvas: Canvas, out: Path) -> None:
    small = cv2.resize(canvas, None, fx=1 / _OVER, fy=1 / _OVER, interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small)
    assert ok
    try:
        out.write_bytes(data.tobytes())
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}") from error
