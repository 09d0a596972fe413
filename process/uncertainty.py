"""First-order standard deviation of the range, from the stripe centre and the calibration.

The range of a point is a function of (u, v), the intrinsics and the laser plane; the turntable moves
the point but not its range. v is the row itself and exact for a vertical stripe. All derivatives are
analytic: with the ideal ray (x, y, 1), s^2 = 1 + x^2 + y^2 and q = n . ray the range is h s / q, and
through the lens the implicit function theorem leads from (x, y) back to pixels and parameters.

Two shares: *random*, from the stripe's centre, new in every point; *systematic*, from the calibration,
common to all points of all scans with it (docs/calibration.md). Total is the root of their squares.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Intrinsics, Joint, LaserPlane
from .camera import distortion_jacobian, numbers_of, undistort_points
from .deviation import sigma_range_into
from .triangulate import intersect, plane_numbers, range_of

Floats = npt.NDArray[np.float64]
Share = Literal["total", "random", "systematic"]


def sigma_range_mm(
    u_px: Floats,
    v_px: Floats,
    sigma_px: Floats,
    *,
    along_v: bool,
    camera: Intrinsics,
    plane: LaserPlane,
    joint: Joint | None = None,
    share: Share = "total",
) -> Floats:
    """Standard deviation of the range of stripe points (N,).

    ``sigma_px`` is that of the centre, along u (vertical stripe) or, with ``along_v``, along v. Parts
    without a covariance count as exact; NaN where ``sigma_px`` is NaN, unless only the ``systematic``
    share is asked for. ``joint``, if it knows camera and plane, stands for their own covariances.
    """
    pixels = np.array([u_px, v_px], np.float64)
    rays = np.array(undistort_points(pixels[0], pixels[1], camera))
    sigma = np.empty(pixels.shape[1], np.float64)
    numbers = numbers_of(camera), plane_numbers(plane)
    factor, random = factor_of(share, camera, plane, joint), share != "systematic"
    sigma_px = np.ascontiguousarray(sigma_px, np.float64)
    sigma_range_into(rays, pixels, sigma_px, along_v, random, *numbers, factor, sigma)
    return sigma


def factor_of(
    share: Share, camera: Intrinsics, plane: LaserPlane, joint: Joint | None = None
) -> Floats:
    """:func:`covariance_factor`, or (14, 0) where ``share`` leaves the calibration out."""
    return np.empty((14, 0)) if share == "random" else covariance_factor(camera, plane, joint)


def covariance_factor(camera: Intrinsics, plane: LaserPlane, joint: Joint | None = None) -> Floats:
    """A matrix F (14, r) with F F' the covariance of the intrinsics (10) and the plane (4).

    ``joint`` is used if it holds both parts; else each part's own, independent of the other.
    """
    covariance = np.zeros((14, 14))
    role = f"plane/{plane.laser}"
    if joint is not None and joint.numbers("intrinsics") and joint.numbers(role):
        covariance[:] = joint.block("intrinsics", role)
    else:
        if camera.covariance is not None:
            covariance[:10, :10] = camera.covariance
        if plane.covariance is not None:
            covariance[10:, 10:] = plane.covariance
    # In units of the single sigmas, so that a small eigenvalue is small for every number.
    scale = np.sqrt(np.diag(covariance))
    unit = np.where(scale > 0, scale, 1.0)
    values, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    known = values > 1e-15 * max(float(values[-1]), 1.0)
    return np.asarray(unit[:, None] * axes[:, known] * np.sqrt(values[known]), np.float64)


def range_slopes(
    u_px: Floats, v_px: Floats, *, along_v: bool, camera: Intrinsics, plane: LaserPlane
) -> tuple[Floats, Floats]:
    """Derivatives of the range: by the stripe's centre (N,), and by the 14 numbers (N, 14).

    The numbers are fx fy cx cy skew k1 k2 p1 p2 k3, then nx ny nz distance_mm of the plane.
    """
    x, y = undistort_points(u_px, v_px, camera)
    distance = range_of(intersect(x, y, plane))
    nx, ny, nz = plane.normal
    slopes = np.empty((len(x), 14))
    with np.errstate(all="ignore"):
        # d range / d (x, y) is distance * (ray / s^2 - n / q); then through the inverse Jacobian.
        q = nx * x + ny * y + nz
        s2 = 1.0 + x * x + y * y
        gx, gy = distance * (x / s2 - nx / q), distance * (y / s2 - ny / q)
        by_u, by_v = through_lens(gx, gy, x, y, u_px, v_px, camera, slopes[:, :10])
        over = distance / q
        slopes[:, 10], slopes[:, 11] = -over * x, -over * y
        slopes[:, 12], slopes[:, 13] = -over, distance / plane.distance_mm
    return (by_v if along_v else by_u), slopes


def through_lens(
    gx: Floats,
    gy: Floats,
    x: Floats,
    y: Floats,
    u_px: npt.ArrayLike,
    v_px: npt.ArrayLike,
    camera: Intrinsics,
    by_camera: Floats,
) -> tuple[Floats, Floats]:
    """From derivatives (gx, gy) by the ideal ray (x, y) of pixels (u, v) to those by u and v, returned.

    Those by fx fy cx cy skew k1 k2 p1 p2 k3 are written into ``by_camera`` (N, 10): the pixel stays, so
    the ray gives way.
    """
    xx, xy, yy = distortion_jacobian(x, y, camera)
    det = xx * yy - xy * xy
    by_xd, by_yd = (yy * gx - xy * gy) / det, (xx * gy - xy * gx) / det
    by_u = by_xd / camera.fx_px
    by_v = (by_yd - camera.skew * by_xd) / camera.fy_px
    yd = (np.asarray(v_px, np.float64) - camera.cy_px) / camera.fy_px
    # xd + skew yd, as far as fx goes.
    xs = (np.asarray(u_px, np.float64) - camera.cx_px) / camera.fx_px
    r2 = x * x + y * y
    radial = -(by_xd * x + by_yd * y) * r2
    by_camera[:, 0], by_camera[:, 1] = -by_u * xs, -by_v * yd
    by_camera[:, 2], by_camera[:, 3], by_camera[:, 4] = -by_u, -by_v, -by_xd * yd
    by_camera[:, 5], by_camera[:, 6], by_camera[:, 9] = radial, radial * r2, radial * r2 * r2
    by_camera[:, 7] = -(by_xd * 2.0 * x * y + by_yd * (r2 + 2.0 * y * y))
    by_camera[:, 8] = -(by_xd * (r2 + 2.0 * x * x) + by_yd * 2.0 * x * y)
    return by_u, by_v
