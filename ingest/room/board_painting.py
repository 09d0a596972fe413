"""How much light comes back in each pixel that sees a printed board; its edges smooth, and in place."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from .board_patterns import Print
from .compiling import compiled
from .rays import Floats

#: Samples of a pixel along each axis; each covers its own part of the pixel, so edges stay in place.
_SAMPLES: Final = 4
#: Light that comes back from black print, relative to white; and from what is behind the board.
BLACK: Final = 0.06
BEHIND: Final = 0.25


@compiled
def _cover(lines: Floats, x: float, width: float) -> tuple[int, int, float]:
    """The two cells that the stretch of ``width`` about x lies in, and the share of the second.

    -1 is before the first line, the number of lines less one after the last.
    """
    low, high = 0, len(lines)
    while low < high:
        middle = (low + high) // 2
        if lines[middle] <= x:
            low = middle + 1
        else:
            high = middle
    cell = low - 1
    # The nearer of the two lines about x cuts off its part; a stretch over three cells is a blur.
    before = x - lines[cell] if cell >= 0 else math.inf
    after = lines[cell + 1] - x if cell + 1 < len(lines) else math.inf
    if before < after:
        return cell, cell - 1, max(0.5 - before / width, 0.0)
    return cell, cell + 1, max(0.5 - after / width, 0.0)


@compiled
def _cell(white: npt.NDArray[np.float32], j: int, i: int) -> float:
    if 0 <= j < white.shape[0] and 0 <= i < white.shape[1]:
        return white[j, i]
    return 1.0


@compiled
def _printed(
    lines_x: Floats,
    lines_y: Floats,
    white: npt.NDArray[np.float32],
    circles: Floats,
    radius: float,
    x: float,
    y: float,
    wide: float,
    high: float,
) -> tuple[float, bool]:
    """How white the print is, on average over a box about a point, and whether it is so all over."""
    for n in range(len(circles)):
        dx, dy = x - circles[n, 0], y - circles[n, 1]
        if abs(dx) <= radius + wide and abs(dy) <= radius + high:
            far = math.sqrt(dx * dx + dy * dy)
            # The box as it is seen along the radius.
            edge = (abs(dx) * wide + abs(dy) * high) / max(far, 1e-9)
            inside = 0.5 + (far - radius) / max(edge, 1e-9)
            # A box near the circle's edge is nowhere even: its corners may reach over.
            return min(max(inside, 0.0), 1.0), abs(far - radius) > wide + high
    if len(circles):
        return 1.0, True
    i0, i1, share_x = _cover(lines_x, x, wide)
    j0, j1, share_y = _cover(lines_y, y, high)
    if share_x == 0.0 and share_y == 0.0:
        return _cell(white, j0, i0), True
    near = (1 - share_x) * _cell(white, j0, i0) + share_x * _cell(white, j0, i1)
    far = (1 - share_x) * _cell(white, j1, i0) + share_x * _cell(white, j1, i1)
    return (1 - share_y) * near + share_y * far, False


@compiled
def _paint(
    rays: Floats,
    h: Floats,
    lines_x: Floats,
    lines_y: Floats,
    white: npt.NDArray[np.float32],
    circles: Floats,
    radius: float,
    plate: Floats,
    out: npt.NDArray[np.float32],
) -> None:
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            a0, b0 = rays[v, u, 0], rays[v, u, 1]
            # How far the ray goes over the pixel, along each of its axes, and along both.
            ea, eb = rays[v, u + 1, 0] - a0, rays[v, u + 1, 1] - b0
            fa, fb = rays[v + 1, u, 0] - a0, rays[v + 1, u, 1] - b0
            ga, gb = rays[v + 1, u + 1, 0] - a0 - ea - fa, rays[v + 1, u + 1, 1] - b0 - eb - fb
            total = 0.0
            # The whole pixel first: most see one even colour.
            samples, k = 1, 0
            while k < samples * samples:
                p, q = (k % samples + 0.5) / samples, (k // samples + 0.5) / samples
                k += 1
                a, b = a0 + p * ea + q * fa + p * q * ga, b0 + p * eb + q * fb + p * q * gb
                w = h[2, 0] * a + h[2, 1] * b + h[2, 2]
                if w <= 0.0:
                    total += BEHIND
                    continue
                x = (h[0, 0] * a + h[0, 1] * b + h[0, 2]) / w
                y = (h[1, 0] * a + h[1, 1] * b + h[1, 2]) / w
                xa, xb = (h[0, 0] - x * h[2, 0]) / w, (h[0, 1] - x * h[2, 1]) / w
                ya, yb = (h[1, 0] - y * h[2, 0]) / w, (h[1, 1] - y * h[2, 1]) / w
                wide = (abs(xa * ea + xb * eb) + abs(xa * fa + xb * fb)) / samples
                high = (abs(ya * ea + yb * eb) + abs(ya * fa + yb * fb)) / samples
                beyond = max((plate[0] - x) / wide, (x - plate[2]) / wide)
                beyond = max(beyond, (plate[1] - y) / high, (y - plate[3]) / high)
                if beyond >= 0.5:
                    total += BEHIND
                    continue
                light, even = _printed(lines_x, lines_y, white, circles, radius, x, y, wide, high)
                if samples == 1 and not (even and beyond <= -0.5):
                    samples, k = _SAMPLES, 0
                    continue
                on = min(0.5 - beyond, 1.0)
                total += on * (BLACK + (1.0 - BLACK) * light) + (1.0 - on) * BEHIND
            out[v, u] = total / (samples * samples)


def paint(rays: Floats, board_from_ray: Floats, printed: Print, out: npt.NDArray[np.float32]) -> None:
    """Fill ``out`` (H, W) with the share of the light that comes back.

    ``rays`` (H + 1, W + 1, 2) are those through the pixels' corners; ``board_from_ray`` (3, 3) takes
    (a, b, 1) to (x, y, 1) times a positive number, for what lies before the camera.
    """
    plate = np.array([*printed.low_mm, *printed.high_mm], np.float64)
    _paint(
        rays,
        board_from_ray,
        printed.x_mm,
        printed.y_mm,
        printed.white,
        printed.circles_mm,
        printed.radius_mm,
        plate,
        out,
    )
