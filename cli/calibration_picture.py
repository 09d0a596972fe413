"""A picture of a camera calibration: residual arrows and coverage, a bar a view, the gates in words."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from ..process.calibrate.camera_quality import coverage_cells
from ..schemas.errors import StorageError

if TYPE_CHECKING:
    from ..process.calibrate.camera import CameraEstimate
    from ..schemas.quality import Quality

Canvas = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

_INK: Colour = (60, 50, 45)
_FAINT: Colour = (190, 185, 180)
_GOOD: Colour = (70, 130, 60)
_BAD: Colour = (50, 50, 200)
_COVER: Colour = (245, 235, 215)
#: Everything is drawn this much larger and shrunk at the end, which smooths it.
_OVER = 2
_WIDTH, _LEFT, _TOP, _MARGIN, _TALLEST = 1500, 940, 70, 24, 860


def draw_camera(estimate: CameraEstimate, quality: Quality, out: Path) -> None:
    """Write a PNG: every corner's residual, enlarged, where it was seen, over the cells that were seen.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    camera = estimate.intrinsics
    scale = min((_LEFT - 2 * _MARGIN) / camera.width_px, _TALLEST / camera.height_px)
    shown = round(camera.height_px * scale)
    height = max(_TOP + shown + 70, 110 + 34 * len(quality.gates) + 320)
    canvas: Canvas = np.full((height * _OVER, _WIDTH * _OVER, 3), 255, np.uint8)
    verdict = {"passed": "passed", "failed": "FAILED", "not judged": "not judged"}[quality.verdict]
    title = f"camera calibration, {camera.width_px} x {camera.height_px} px: {verdict}"
    _text(canvas, title, (_MARGIN, 36), 0.8, _BAD if quality.failed() else _INK)
    area = (_MARGIN, _TOP, _MARGIN + round(camera.width_px * scale), _TOP + shown)
    _coverage(canvas, estimate, area)
    _arrows(canvas, estimate, area, scale)
    _gates(canvas, quality, _LEFT + 10, 70)
    _bars(canvas, estimate, (_LEFT + 10, 110 + 34 * len(quality.gates), _WIDTH - _MARGIN, height - 60))
    small = cv2.resize(canvas, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small)
    assert ok
    try:
        out.write_bytes(data.tobytes())
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}") from error


def _coverage(canvas: Canvas, estimate: CameraEstimate, area: tuple[int, int, int, int]) -> None:
    cells = coverage_cells(estimate.views)
    left, top, right, bottom = area
    x = np.linspace(left, right, cells.shape[1] + 1)
    y = np.linspace(top, bottom, cells.shape[0] + 1)
    for row, col in np.argwhere(cells > 0):
        _box(canvas, (x[col], y[row]), (x[col + 1], y[row + 1]), _COVER, filled=True)
    _box(canvas, (left, top), (right, bottom), _FAINT)
    share = float((cells > 0).mean())
    text = f"shaded: seen by the board ({100 * share:.0f} % of {cells.size} cells)"
    _text(canvas, text, (left + 330, bottom + 34), 0.5, _INK)


def _arrows(
    canvas: Canvas, estimate: CameraEstimate, area: tuple[int, int, int, int], scale: float
) -> None:
    bundle, views = estimate.bundle, estimate.views
    residuals = np.concatenate(bundle.residuals_px)
    points = np.concatenate([v.points_px for v in views])
    usual = float(np.median(np.linalg.norm(residuals, axis=1)))
    # The median arrow is 9 px long in the picture, enlarged by a round number.
    magnify = _round_number(9.0 / max(usual * scale, 1e-9))
    rms = bundle.rms_px()
    for at, off in zip(points, residuals, strict=True):
        start = (area[0] + (at[0] + 0.5) * scale, area[1] + (at[1] + 0.5) * scale)
        end = (start[0] + off[0] * scale * magnify, start[1] + off[1] * scale * magnify)
        colour = _BAD if float(np.hypot(*off)) > 3 * rms else _GOOD
        a, b = _at(start), _at(end)
        cv2.arrowedLine(canvas, a, b, colour, _OVER, cv2.LINE_AA, 0, 0.3)
    bottom = area[3] + 34
    length = rms * scale * magnify
    cv2.arrowedLine(
        canvas,
        _at((area[0], bottom - 5)),
        _at((area[0] + length, bottom - 5)),
        _INK,
        _OVER,
        cv2.LINE_AA,
    )
    text = f"rms {rms:.3f} px; arrows {magnify:g} times"
    _text(canvas, text, (round(area[0] + length + 12), bottom), 0.5, _INK)


def _round_number(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value))


def _gates(canvas: Canvas, quality: Quality, x: int, y: int) -> None:
    for i, gate in enumerate(quality.gates):
        mark, colour = ("passed", _GOOD) if gate.passed else ("FAILED", _BAD)
        _text(canvas, mark, (x, y + 34 * i), 0.5, colour)
        _text(canvas, gate.sentence(), (x + 76, y + 34 * i), 0.48, _INK)


def _bars(canvas: Canvas, estimate: CameraEstimate, area: tuple[int, int, int, int]) -> None:
    """The rms of every view, in the order of the inputs."""
    left, top, right, bottom = area
    rms = estimate.bundle.view_rms_px()
    _text(canvas, f"rms of each view, px (largest {rms.max():.3f})", (left, top + 4), 0.5, _INK)
    top += 20
    step = (right - left) / len(rms)
    full = max(float(rms.max()), 1e-9)
    usual = float(np.median(rms))
    for i, value in enumerate(rms):
        high = (bottom - top) * value / full
        colour = _BAD if value > 2 * usual else _GOOD
        corner = (left + (i + 0.15) * step, bottom - high)
        _box(canvas, corner, (left + (i + 0.85) * step, bottom), colour, filled=True)
    worst = int(rms.argmax())
    text = f"{len(rms)} views; worst: {estimate.views[worst].name}"
    _text(canvas, text[:70], (left, bottom + 24), 0.45, _INK)


def _at(point: tuple[float, float]) -> tuple[int, int]:
    return round(point[0] * _OVER), round(point[1] * _OVER)


def _box(
    canvas: Canvas,
    first: tuple[float, float],
    second: tuple[float, float],
    colour: Colour,
    *,
    filled: bool = False,
) -> None:
    cv2.rectangle(canvas, _at(first), _at(second), colour, -1 if filled else _OVER)


def _text(canvas: Canvas, text: str, at: tuple[int, int], size: float, colour: Colour) -> None:
    where = (at[0] * _OVER, at[1] * _OVER)
    thick = round(1.2 * _OVER)
    plain = text.encode("ascii", "replace").decode()
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(canvas, plain, where, font, size * _OVER, colour, thick, cv2.LINE_AA)
