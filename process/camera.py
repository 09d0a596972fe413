"""The camera model: Caltech/OpenCV five coefficients and skew (Xiao et al. 2015, formulas 6-11).

Normalised coordinates (xn, yn) are X/Z and Y/Z in camera space; pixels have their centres at integers.
OpenCV's own functions leave skew out (0.26 px at a skew of 0.001), so these are used throughout.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Intrinsics

Floats = npt.NDArray[np.float64]

# Newton's steps to 1e-13 px are three for real lenses; the rest is for the far corners of strong ones.
_STEPS = 20
_CONVERGED = 1e-14


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
    u, v = np.broadcast_arrays(np.asarray(u_px, np.float64), np.asarray(v_px, np.float64))
    yd = (v - camera.cy_px) / camera.fy_px
    xd = (u - camera.cx_px) / camera.fx_px - camera.skew * yd
    if not any(camera.distortion):
        return xd.copy(), yd.copy()
    x, y = xd.copy(), yd.copy()
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            ex, ey = distort(x, y, camera)
            ex, ey = ex - xd, ey - yd
            xx, xy, yy = distortion_jacobian(x, y, camera)
            det = xx * yy - xy * xy
            dx, dy = (yy * ex - xy * ey) / det, (xx * ey - xy * ex) / det
            x, y = x - dx, y - dy
            step = np.abs(dx) + np.abs(dy)
            if not step.size or np.nanmax(step, initial=0.0) < _CONVERGED:
                break
        ex, ey = distort(x, y, camera)
        xx, xy, yy = distortion_jacobian(x, y, camera)
        # Beyond the fold the determinant is negative: a root there is another branch, not the ray.
        good = (np.abs(ex - xd) + np.abs(ey - yd) < 1e-12) & (xx * yy - xy * xy > 0) & (xx > 0)
    return np.where(good, x, np.nan), np.where(good, y, np.nan)


def ideal_camera(camera: Intrinsics) -> Intrinsics:
    """The camera that undistorted frames come from: no distortion, no skew, exact."""
    change: dict[str, Any] = {"skew": 0.0, "distortion": (0.0,) * 5}
    return camera.model_copy(update=change)
