"""The compiled part of uncertainty.py: deviations of the range of many points, block by block."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from .compiled import exact_kernel

Floats = npt.NDArray[np.float64]
Plane = tuple[float, float, float, float]

#: Points whose slopes are held at a time, so that they stay in the nearest cache.
_BLOCK: Final = 256


@exact_kernel
def sigma_range_into(
    rays: Floats,
    pixels: Floats,
    sigma_px: Floats,
    along_v: bool,
    random: bool,
    camera: tuple[float, ...],
    plane: Plane,
    factor: Floats,
    out: Floats,
) -> None:
    """As :func:`sigma_range_mm` of the ideal rays (2, N) of pixels (2, N), into ``out``.

    ``factor`` (14, r) is that of the calibration's share; ``random``: whether the stripe's is in it.
    """
    fx, fy, _, _, skew = camera[:5]
    by_ray, slopes = np.empty((3, _BLOCK), np.float64), np.empty((14, _BLOCK), np.float64)
    for start in range(0, len(out), _BLOCK):
        stop = min(start + _BLOCK, len(out))
        x, y, u, v = (
            rays[0, start:stop],
            rays[1, start:stop],
            pixels[0, start:stop],
            pixels[1, start:stop],
        )
        sigma, variance = sigma_px[start:stop], out[start:stop]
        _by_ray(x, y, camera, plane, by_ray)
        for i in range(stop - start):
            by_xd, by_yd = by_ray[0, i], by_ray[1, i]
            by_pixel = (by_yd - skew * by_xd) / fy if along_v else by_xd / fx
            # Rays outside the lens model keep their NaN even where nothing is uncertain.
            variance[i] = (by_pixel * sigma[i]) ** 2 if random else 0.0 * by_pixel
        if factor.shape[1] > 0:
            _by_numbers(x, y, u, v, camera, plane, by_ray, slopes)
        for k in range(factor.shape[1]):
            _add_squares(slopes, factor, k, variance)
        for i in range(stop - start):
            variance[i] = math.sqrt(variance[i])


@exact_kernel
def _by_ray(
    x: Floats,
    y: Floats,
    camera: tuple[float, ...],
    plane: Plane,
    out: Floats,
) -> None:
    """Derivatives of the range by the distorted ray: by xd, by yd; and the range over n . ray."""
    k1, k2, p1, p2, k3 = camera[5:]
    nx, ny, nz, h = plane
    for i in range(len(x)):
        a, b = x[i], y[i]
        r2 = a * a + b * b
        q = nx * a + ny * b + nz
        depth = h / q
        depth = depth if (depth > 0.0) & (depth < np.inf) else np.nan
        s2 = 1.0 + r2
        distance = depth * math.sqrt(s2)
        # d range / d (x, y) is distance * (ray / s^2 - n / q); then through the inverse Jacobian.
        gx, gy = distance * (a / s2 - nx / q), distance * (b / s2 - ny / q)
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        xx = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        xy = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        yy = radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
        det = xx * yy - xy * xy
        out[0, i] = (yy * gx - xy * gy) / det
        out[1, i] = (xx * gy - xy * gx) / det
        out[2, i] = distance / q


@exact_kernel
def _by_numbers(
    x: Floats,
    y: Floats,
    u: Floats,
    v: Floats,
    camera: tuple[float, ...],
    plane: Plane,
    by_ray: Floats,
    out: Floats,
) -> None:
    """Derivatives of the range by the 14 numbers, as :func:`range_slopes` gives them, into (14, N)."""
    fx, fy, cx, cy, skew = camera[:5]
    nx, ny, nz, h = plane
    for i in range(len(x)):
        a, b, by_xd, by_yd = x[i], y[i], by_ray[0, i], by_ray[1, i]
        by_u, by_v = by_xd / fx, (by_yd - skew * by_xd) / fy
        yd, xs = (v[i] - cy) / fy, (u[i] - cx) / fx
        out[0, i] = -by_u * xs
        out[1, i] = -by_v * yd
        out[2, i] = -by_u
        out[3, i] = -by_v
        out[4, i] = -by_xd * yd
        r2 = a * a + b * b
        radial = -(by_xd * a + by_yd * b) * r2
        out[5, i] = radial
        out[6, i] = radial * r2
        out[7, i] = -(by_xd * 2.0 * a * b + by_yd * (r2 + 2.0 * b * b))
        out[8, i] = -(by_xd * (r2 + 2.0 * a * a) + by_yd * 2.0 * a * b)
        out[9, i] = radial * r2 * r2
    for i in range(len(x)):
        over = by_ray[2, i]
        out[10, i] = -over * x[i]
        out[11, i] = -over * y[i]
        out[12, i] = -over
        out[13, i] = over * (nx * x[i] + ny * y[i] + nz) / h


@exact_kernel
def _add_squares(slopes: Floats, factor: Floats, k: int, variance: Floats) -> None:
    """Add the square of slopes . factor[:, k] of each point."""
    total = np.zeros(len(variance), np.float64)
    for j in range(14):
        weight = factor[j, k]
        for i in range(len(variance)):
            total[i] += slopes[j, i] * weight
    for i in range(len(variance)):
        variance[i] += total[i] * total[i]
