"""The camera model: Caltech/OpenCV five coefficients and skew (Xiao et al. 2015, formulas 6-11).

Normalised coordinates (xn, yn) are X/Z and Y/Z in camera space; pixels have their centres at integers.
OpenCV's own functions leave skew out (0.26 px at a skew of 0.001), so these are used throughout.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Intrinsics
from .compiled import exact_kernel

Floats = npt.NDArray[np.float64]

# Newton's steps to 1e-13 px are three for real lenses; the rest is for the far corners of strong ones.
_STEPS = 20
_CONVERGED, _LAST_STEP = 1e-14, 1e-7
#: Near the fold of the model the steps say little: there, all is looked at point by point.
_FLAT = 0.05


def distort(xn: npt.ArrayLike, yn: npt.ArrayLike, camera: Intrinsics) -> tuple[Floats, Floats]:
    """Ideal to distorted normalised coordinates (formulas 7 and 8), any shape."""
    x, y = np.asarray(xn, np.float64), np.asarray(yn, np.float64)
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return xd, yd


def pixels(xd: npt.ArrayLike, yd: npt.ArrayLike, camera: Intrinsics) -> tuple[Floats, Floats]:
    """Distorted normalised coordinates to (u_px, v_px), skew included (formula 9)."""
    x, y = np.asarray(xd, np.float64), np.asarray(yd, np.float64)
    return camera.fx_px * (x + camera.skew * y) + camera.cx_px, camera.fy_px * y + camera.cy_px


def project(points_camera_mm: npt.ArrayLike, camera: Intrinsics) -> tuple[Floats, Floats]:
    """Points (..., 3) in camera space to (u_px, v_px); NaN for points not in front of the camera."""
    p = np.asarray(points_camera_mm, np.float64)
    depth = np.where(p[..., 2] > 0, p[..., 2], np.nan)
    return pixels(*distort(p[..., 0] / depth, p[..., 1] / depth, camera), camera)


def distortion_jacobian(x: Floats, y: Floats, camera: Intrinsics) -> tuple[Floats, Floats, Floats]:
    """d(xd)/dx, d(xd)/dy = d(yd)/dx, d(yd)/dy of :func:`distort`; the mixed terms are equal."""
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, xy, yy


def undistort_points(
    u_px: npt.ArrayLike, v_px: npt.ArrayLike, camera: Intrinsics
) -> tuple[Floats, Floats]:
    """Pixels to ideal normalised coordinates (xn, yn), to 1e-13 px.

    Newton's method with the analytic Jacobian. NaN where the model folds back on itself, so that no
    single ray belongs to the pixel.
    """
    u, v = np.asarray(u_px, np.float64), np.asarray(v_px, np.float64)
    if u.shape != v.shape:
        u, v = np.broadcast_arrays(u, v)
    shape = u.shape
    x, y = np.empty(u.size, np.float64), np.empty(u.size, np.float64)
    undistort_into(
        np.ascontiguousarray(u).ravel(), np.ascontiguousarray(v).ravel(), numbers_of(camera), x, y
    )
    return x.reshape(shape), y.reshape(shape)


def numbers_of(camera: Intrinsics) -> tuple[float, ...]:
    """fx, fy, cx, cy, skew, k1, k2, p1, p2, k3, as the kernels take them."""
    focal = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    return (*(float(n) for n in focal), float(camera.skew), *(float(n) for n in camera.distortion))


@exact_kernel
def undistort_into(u: Floats, v: Floats, camera: tuple[float, ...], x: Floats, y: Floats) -> None:
    """As :func:`undistort_points`, into ``x`` and ``y``; ``camera`` as :func:`numbers_of` gives it."""
    fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = camera
    n = len(u)
    bad = 0
    # Three steps for all, without a branch, so that it is vectorised; what needs more comes after.
    for i in range(n):
        yd = (v[i] - cy) / fy
        xd = (u[i] - cx) / fx - skew * yd
        da, db, det, xx = _newton(xd, yd, xd, yd, k1, k2, p1, p2, k3)
        a, b = xd - da, yd - db
        da, db, det, xx = _newton(a, b, xd, yd, k1, k2, p1, p2, k3)
        a, b = a - da, b - db
        da, db, det, xx = _newton(a, b, xd, yd, k1, k2, p1, p2, k3)
        # Steps shrink as their squares: after one this small nothing is left. NaN compares as bad.
        good = (abs(da) + abs(db) < _LAST_STEP) & (det > _FLAT) & (xx > _FLAT)
        bad += 0 if good else 1
        x[i] = a - da if good else np.nan
        y[i] = b - db
    if bad == 0:
        return
    for i in range(n):
        # Only what needs it: a point must not depend on its neighbours.
        if not np.isnan(x[i]):
            continue
        yd = (v[i] - cy) / fy
        xd = (u[i] - cx) / fx - skew * yd
        a, b = xd, yd
        steps = 0
        da, db, det, xx = _newton(a, b, xd, yd, k1, k2, p1, p2, k3)
        while abs(da) + abs(db) > _CONVERGED and steps < _STEPS:
            a -= da
            b -= db
            da, db, det, xx = _newton(a, b, xd, yd, k1, k2, p1, p2, k3)
            steps += 1
        # Beyond the fold the determinant is negative: a root there is another branch, not the ray.
        good = abs(da) + abs(db) < 1e-12 and det > 0.0 and xx > 0.0
        x[i] = a - da if good else np.nan
        y[i] = b - db if good else np.nan


@exact_kernel
def _newton(
    x: float,
    y: float,
    xd: float,
    yd: float,
    k1: float,
    k2: float,
    p1: float,
    p2: float,
    k3: float,
) -> tuple[float, float, float, float]:
    """Newton's step towards the ideal point of (xd, yd), the Jacobian's determinant and first entry."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
    ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
    xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    det = xx * yy - xy * xy
    scale = 1.0 / det
    return (yy * ex - xy * ey) * scale, (xx * ey - xy * ex) * scale, det, xx


def ideal_camera(camera: Intrinsics) -> Intrinsics:
    """The camera that undistorted frames come from: no distortion, no skew, exact."""
    change: dict[str, Any] = {"skew": 0.0, "distortion": (0.0,) * 5}
    return camera.model_copy(update=change)
