"""A picture of a point cloud: an oblique view and a plan, coloured by height, with scale and legend."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.errors import InputError, StorageError

Floats = npt.NDArray[np.float64]

_PAPER = (255, 255, 255)
_INK = (60, 50, 45)
_FAINT = (190, 185, 180)
#: Everything is drawn this much larger and shrunk at the end, which smooths it.
_OVER = 2


def draw_cloud(
    x_mm: npt.ArrayLike,
    y_mm: npt.ArrayLike,
    z_mm: npt.ArrayLike,
    out: Path,
    *,
    title: str,
    about: Sequence[str] = (),
    width_px: int = 1400,
    height_px: int = 720,
    azimuth_deg: float = -55.0,
    elevation_deg: float = 32.0,
) -> None:
    """Write a PNG of the points (scene space, mm): oblique on the left, plan on the right.

    What lies beyond the 0.2 and 99.8 percentiles is left out. If most points are high above the rest
    (a ceiling), the oblique view is cut below them, so that one can look inside. ``about`` is kept as
    the file's description (PNG text).

    Raises
    ------
    InputError
        There are no points.
    StorageError
        The file cannot be written.
    """
    points = np.stack([np.asarray(a, np.float64) for a in (x_mm, y_mm, z_mm)], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{out}: there are no points to draw")
    low, high = np.percentile(points, [0.2, 99.8], axis=0)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    if not len(points):
        points = np.array([[0.0, 0.0, 0.0]])
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, 1.0)
    colours = _colours((points[:, 2] - low[2]) / span[2])
    canvas = np.full((height_px * _OVER, width_px * _OVER, 3), 255, np.uint8)
    head, foot = 56 * _OVER, 64 * _OVER
    left = int(width_px * 0.56) * _OVER
    view = canvas[head : canvas.shape[0] - foot, :left]
    cut = low[2] + 0.86 * span[2] if _has_ceiling(points, low, span) else np.inf
    keep = points[:, 2] <= cut
    _splat(view, *_oblique(points[keep], azimuth_deg, elevation_deg), colours[keep])
    plan = canvas[head : canvas.shape[0] - foot, left:]
    scale = _splat(plan, points[keep, 0], -points[keep, 1], points[keep, 2], colours[keep])
    _scale_bar(canvas, left + 40 * _OVER, canvas.shape[0] - 30 * _OVER, scale)
    _legend(canvas, 40 * _OVER, canvas.shape[0] - 30 * _OVER, low[2], high[2])
    _text(canvas, title, (24 * _OVER, 36 * _OVER), 0.72)
    _text(canvas, "plan, z up", (left + 24 * _OVER, 36 * _OVER), 0.55)
    small = cv2.resize(canvas, (width_px, height_px), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small)
    assert ok
    try:
        out.write_bytes(_described(np.asarray(data).tobytes(), "\n".join(about)))
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}") from error


def _described(png: bytes, text: str) -> bytes:
    """``png`` with a tEXt chunk "Description" (PNG specification, 11.3.3.2) after its header chunk."""
    if not text:
        return png
    body = b"tEXtDescription\0" + text.encode("latin-1", "backslashreplace")
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    # Eight bytes of signature, then IHDR: 4 of length, 4 of type, 13 of content, 4 of CRC.
    return png[:33] + chunk + png[33:]


def _has_ceiling(points: Floats, low: Floats, span: Floats) -> bool:
    """Whether the top tenth holds a wide, flat layer."""
    top = points[points[:, 2] > low[2] + 0.9 * span[2]]
    if len(top) < 0.03 * len(points):
        return False
    reach = np.ptp(top[:, :2], axis=0) / span[:2]
    return bool((reach > 0.6).all())


def _colours(part: Floats) -> npt.NDArray[np.uint8]:
    index = np.clip(np.rint(np.asarray(part) * 255), 0, 255).astype(np.uint8)
    mapped = cv2.applyColorMap(index.reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    return mapped.reshape(-1, 3).astype(np.uint8)


def _oblique(points: Floats, azimuth_deg: float, elevation_deg: float) -> tuple[Floats, Floats, Floats]:
    """Right, down and towards-the-eye coordinates of an orthographic view."""
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    eye = np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])
    up = np.cross(eye, right)
    return points @ right, -(points @ up), points @ eye


def _splat(
    view: npt.NDArray[np.uint8], right: Floats, down: Floats, near: Floats, colour: npt.NDArray[Any]
) -> float:
    """Draw points as small squares, the nearest on top; returns px per mm."""
    height, width = view.shape[:2]
    margin = 28 * _OVER
    # A cloud of one point has no extent: then the view is 1 mm wide.
    span = max(np.ptp(right) / (width - 2 * margin), np.ptp(down) / (height - 2 * margin), 1 / width)
    scale = 1.0 / float(span)
    px = (right - (right.min() + right.max()) / 2) * scale + width / 2
    py = (down - (down.min() + down.max()) / 2) * scale + height / 2
    order = np.argsort(near, kind="stable")
    column = np.rint(px[order]).astype(np.int64)
    row = np.rint(py[order]).astype(np.int64)
    shade = colour[order]
    size = 3 if len(near) < 120_000 else 2
    for dy in range(size):
        for dx in range(size):
            # Later assignments win, so the nearest points, which come last, stay on top.
            view[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1)] = shade
    return scale


def _text(canvas: npt.NDArray[np.uint8], text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(
        canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size * _OVER, _INK, round(1.2 * _OVER), cv2.LINE_AA
    )


def _scale_bar(canvas: npt.NDArray[np.uint8], x: int, y: int, scale: float) -> None:
    room_mm = 160 * _OVER / scale
    power = 10.0 ** math.floor(math.log10(room_mm))
    length = max(m * power for m in (1.0, 2.0, 5.0) if m * power <= room_mm)
    end = x + round(length * scale)
    cv2.line(canvas, (x, y), (end, y), _INK, 2 * _OVER, cv2.LINE_AA)
    for at in (x, end):
        cv2.line(canvas, (at, y - 6 * _OVER), (at, y + 6 * _OVER), _INK, _OVER, cv2.LINE_AA)
    text = f"{length / 1000:g} m" if length >= 1000 else f"{length:g} mm"
    _text(canvas, text, (end + 12 * _OVER, y + 5 * _OVER), 0.5)


def _legend(canvas: npt.NDArray[np.uint8], x: int, y: int, low: float, high: float) -> None:
    width, thick = 220 * _OVER, 10 * _OVER
    bar = _colours(np.linspace(0.0, 1.0, width))
    canvas[y - thick // 2 : y + thick // 2, x : x + width] = bar[None]
    cv2.rectangle(canvas, (x, y - thick // 2), (x + width, y + thick // 2), _FAINT, 1)
    _text(canvas, f"z {low:.0f} to {high:.0f} mm", (x + width + 14 * _OVER, y + 5 * _OVER), 0.5)
