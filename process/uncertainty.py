"""First-order standard deviation of the range, from the stripe centre and the calibration.

The range of a point is a function of (u, v), the intrinsics and the laser plane; the turntable moves
the point but not its range. v is the row itself and exact for a vertical stripe. All derivatives are
analytic: with the ideal ray (x, y, 1), s^2 = 1 + x^2 + y^2 and q = n . ray the range is h s / q, and
through the lens the implicit function theorem leads from (x, y) back to pixels and parameters.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Intrinsics, LaserPlane
from .camera import distortion_jacobian, undistort_points
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
    x, y = undistort_points(u_px, v_px, camera)
    distance = range_of(intersect(x, y, plane))
    nx, ny, nz = plane.normal
    with np.errstate(all="ignore"):
        # d range / d (x, y) is distance * (ray / s^2 - n / q); then through the inverse Jacobian.
        q = nx * x + ny * y + nz
        s2 = 1.0 + x * x + y * y
        gx, gy = distance * (x / s2 - nx / q), distance * (y / s2 - ny / q)
        xx, xy, yy = distortion_jacobian(x, y, camera)
        det = xx * yy - xy * xy
        by_xd, by_yd = (yy * gx - xy * gy) / det, (xx * gy - xy * gx) / det
        by_u = by_xd / camera.fx_px
        by_v = (by_yd - camera.skew * by_xd) / camera.fy_px
        variance = ((by_v if along_v else by_u) * sigma_px) ** 2
        if camera.covariance is not None:
            yd = (np.asarray(v_px, np.float64) - camera.cy_px) / camera.fy_px
            xd = (np.asarray(u_px, np.float64) - camera.cx_px) / camera.fx_px
            slopes = [-by_u * xd, -by_v * yd, -by_u, -by_v, -by_xd * yd]
            slopes += _by_distortion(x, y, by_xd, by_yd)
            variance = variance + _quadratic(slopes, camera.covariance)
        if plane.covariance is not None:
            slopes = [-distance * x / q, -distance * y / q, -distance / q, distance / plane.distance_mm]
            variance = variance + _quadratic(slopes, plane.covariance)
    return np.sqrt(variance)


def _by_distortion(x: Floats, y: Floats, by_xd: Floats, by_yd: Floats) -> list[Floats]:
    """Slopes of the range by k1 k2 p1 p2 k3: the distorted point stays, so the ideal one gives way."""
    r2 = x * x + y * y
    radial = -(by_xd * x + by_yd * y) * r2
    return [
        radial,
        radial * r2,
        -(by_xd * 2.0 * x * y + by_yd * (r2 + 2.0 * y * y)),
        -(by_xd * (r2 + 2.0 * x * x) + by_yd * 2.0 * x * y),
        radial * r2 * r2,
    ]


def _quadratic(slopes: list[Floats], covariance: tuple[tuple[float, ...], ...]) -> Floats:
    jacobian = np.stack(slopes, axis=-1)
    return np.einsum("ni,ij,nj->n", jacobian, np.array(covariance, np.float64), jacobian)
