"""Stripe points to scene points in one compiled pass: lens, laser plane, turn, deviation of the range.

In blocks that stay in the nearest cache, from the columns of STRIPES straight into those of POINTS. The
steps are those of camera.py, triangulate.py and uncertainty.py, each rounded as written: a point does
not depend on the block or the place in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from .camera import undistort_into
from .compiled import exact_kernel
from .deviation import sigma_range_into
from .triangulate import scene_points_into

Floats = npt.NDArray[np.float64]

_BLOCK: Final = 512


@dataclass(frozen=True)
class Geometry:
    """What turns stripe points into scene points, as plain numbers.

    ``lasers`` (L,) are the lasers' numbers, ``planes`` (L, 4) their planes, ``factors`` (L, 14, r) the
    covariance factors of camera and plane; ``random``: whether the stripe's own deviation counts.
    ``limits`` are the least and the largest range and the largest radius about the axis, in mm.
    """

    camera: tuple[float, ...]
    lasers: npt.NDArray[np.int64]
    planes: Floats
    factors: Floats
    axis: Floats
    horizontal: bool
    random: bool
    limits: tuple[float, float, float]


def scene_columns(
    stripes: Mapping[str, npt.NDArray[Any]], geometry: Geometry
) -> tuple[dict[str, npt.NDArray[Any]], npt.NDArray[np.bool_], int]:
    """Columns x_mm to sigma_range_mm of POINTS, which of them to keep, and how many that are.

    A point of another laser, without a ray, or outside of the limits is not kept. Lengths are computed
    in float64 and come in the type of ``u_px``.
    """
    n, kind = len(stripes["u_px"]), stripes["u_px"].dtype
    names = ("x_mm", "y_mm", "z_mm", "range_mm", "sigma_range_mm")
    made = {name: np.empty(n, kind) for name in names}
    keep = np.empty(n, np.bool_)
    taken = tuple(np.ascontiguousarray(stripes[name]) for name in _TAKEN)
    g = geometry
    numbers = (g.camera, g.lasers, g.planes, g.factors, g.axis, g.horizontal, g.random, g.limits)
    kept = _to_scene(taken, *numbers, tuple(made.values()), keep)
    return made, keep, int(kept)


_TAKEN: Final = ("laser", "row", "angle_rad", "u_px", "sigma_u_px")


@exact_kernel
def _to_scene(
    stripes: tuple[Any, ...],
    camera: tuple[float, ...],
    numbers: npt.NDArray[np.int64],
    planes: Floats,
    factors: Floats,
    axis: Floats,
    horizontal: bool,
    random: bool,
    limits: tuple[float, float, float],
    out: tuple[Any, ...],
    keep: npt.NDArray[np.bool_],
) -> int:
    """Fill ``out`` and ``keep`` of :func:`scene_columns`; returns how many are kept."""
    laser, row, angle_rad, u_px, sigma_u_px = stripes
    x_out, y_out, z_out, range_out, sigma_out = out
    least, most, radius = limits
    index = np.empty(_BLOCK, np.int64)
    # u, v; ideal x, y; scene x, y, z; angle, deviation of the centre, range, deviation of the range.
    pixels, rays = np.empty((2, _BLOCK), np.float64), np.empty((2, _BLOCK), np.float64)
    xyz, rest = np.empty((3, _BLOCK), np.float64), np.empty((4, _BLOCK), np.float64)
    along, across = pixels[1 if horizontal else 0], pixels[0 if horizontal else 1]
    kept = 0
    for start in range(0, len(keep), _BLOCK):
        stop = min(start + _BLOCK, len(keep))
        for i in range(start, stop):
            keep[i] = False
        for k in range(len(numbers)):
            n = 0
            for i in range(start, stop):
                index[n] = i
                n += 1 if laser[i] == numbers[k] else 0
            for j in range(n):
                i = index[j]
                along[j], across[j] = u_px[i], row[i]
                rest[0, j], rest[1, j] = angle_rad[i], sigma_u_px[i]
            plane = (planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3])
            undistort_into(pixels[0, :n], pixels[1, :n], camera, rays[0, :n], rays[1, :n])
            scene_points_into(rays[0, :n], rays[1, :n], rest[0, :n], plane, axis, xyz, rest[2, :n])
            sigma_range_into(
                rays, pixels, rest[1, :n], horizontal, random, camera, plane, factors[k], rest[3, :n]
            )
            for j in range(n):
                i = index[j]
                x_out[i], y_out[i], z_out[i] = xyz[0, j], xyz[1, j], xyz[2, j]
                range_out[i], sigma_out[i] = rest[2, j], rest[3, j]
                far = xyz[0, j] * xyz[0, j] + xyz[1, j] * xyz[1, j] > radius * radius
                keep[i] = (rest[2, j] >= least) & (rest[2, j] <= most) & (not far)
                kept += 1 if keep[i] else 0
    return kept
