"""First-order standard deviation of the range, from the stripe centre and the calibration.

The range of a point is a function of (u, v), the intrinsics and the laser plane; the turntable moves
the point but not its range. v is the row itself and exact for a vertical stripe. Derivatives are
central differences of the very functions that triangulate, with steps near the cube root of the
machine's precision, where their error is about 1e-10 of the value.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Intrinsics, LaserPlane
from .camera import undistort_points
from .triangulate import intersect, range_of

Floats = npt.NDArray[np.float64]


def sigma_range_mm(
    u_px: Floats,
    v_px: Floats,
    sigma_px: Floats,
    *,
    along_v: bool,
    camera: Intrinsics,
    plane: LaserPlane,
) -> Floats:
    """Standard deviation of the range of stripe points (N,).

    ``sigma_px`` is that of the centre, along u (vertical stripe) or, with ``along_v``, along v. Parts
    without a covariance count as exact; NaN where ``sigma_px`` is NaN.
    """
    if along_v:
        slope = _slope(lambda d: _range(u_px, v_px + d, camera, plane), 1e-4)
    else:
        slope = _slope(lambda d: _range(u_px + d, v_px, camera, plane), 1e-4)
    variance = (slope * sigma_px) ** 2
    if camera.covariance is not None:
        variance = variance + _quadratic(_by_camera(u_px, v_px, camera, plane), camera.covariance)
    if plane.covariance is not None:
        variance = variance + _quadratic(_by_plane(u_px, v_px, camera, plane), plane.covariance)
    return np.sqrt(variance)


def _range(u: Floats, v: Floats, camera: Intrinsics, plane: LaserPlane) -> Floats:
    return range_of(intersect(*undistort_points(u, v, camera), plane))


def _slope(function: Callable[[float], Floats], step: float) -> Floats:
    return (function(step) - function(-step)) / (2.0 * step)


def _quadratic(slopes: list[Floats], covariance: tuple[tuple[float, ...], ...]) -> Floats:
    jacobian = np.stack(slopes, axis=-1)
    return np.einsum("ni,ij,nj->n", jacobian, np.array(covariance, np.float64), jacobian)


def _by_camera(u: Floats, v: Floats, camera: Intrinsics, plane: LaserPlane) -> list[Floats]:
    values = [
        *(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew),
        *camera.distortion,
    ]

    def moved(i: int, d: float) -> Floats:
        p = list(values)
        p[i] += d
        other = camera.model_copy(
            update={
                **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px", "skew"), p[:5], strict=True)),
                "distortion": tuple(p[5:]),
            }
        )
        return _range(u, v, other, plane)

    steps = [1e-3] * 4 + [1e-6] * 6
    return [_slope(partial(moved, i), step) for i, step in enumerate(steps)]


def _by_plane(u: Floats, v: Floats, camera: Intrinsics, plane: LaserPlane) -> list[Floats]:
    x, y = undistort_points(u, v, camera)

    def moved(i: int, d: float) -> Floats:
        p = [*plane.normal, plane.distance_mm]
        p[i] += d
        # Not validated: a normal moved along one axis is off unit length on purpose.
        other = plane.model_copy(update={"normal": tuple(p[:3]), "distance_mm": p[3]})
        return range_of(intersect(x, y, other))

    return [_slope(partial(moved, i), 1e-6 if i < 3 else 1e-3) for i in range(4)]
