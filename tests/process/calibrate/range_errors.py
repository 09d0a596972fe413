"""What a calibration does to ranges: errors and sigmas at the stripe's pixels, at stated ranges."""

from __future__ import annotations

import numpy as np

from turnscan.process.calibrate.difference import stripe_pixels
from turnscan.process.calibrate.plane import PlaneFit
from turnscan.process.camera import undistort_points
from turnscan.process.triangulate import intersect, range_of
from turnscan.process.uncertainty import range_slopes, sigma_range_mm
from turnscan.schemas.calibration import Calibration


def range_errors(estimate: Calibration, true: Calibration, range_mm: float) -> np.ndarray:
    """Range by ``estimate`` minus the true one (N,) mm, for exact pixels of the true stripe."""
    u, v = stripe_pixels(true, 0, range_mm)
    ranges = [
        range_of(intersect(*undistort_points(u, v, c.intrinsics_or_fail()), c.plane_or_fail(0)))
        for c in (estimate, true)
    ]
    return np.asarray(ranges[0] - ranges[1])


def pixels_at(estimate: Calibration, range_mm: float, *, middle: bool) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the stripe at a range: over the whole image, or the one nearest the middle row."""
    u, v = stripe_pixels(estimate, 0, range_mm)
    if not middle:
        return u, v
    at = [int(np.abs(v - estimate.intrinsics_or_fail().cy_px).argmin())]
    return u[at], v[at]


def systematic_mm(estimate: Calibration, range_mm: float, *, middle: bool = False) -> float:
    """Systematic 1 sigma of a range as the document states it, rms over the stripe, mm."""
    u, v = pixels_at(estimate, range_mm, middle=middle)
    sigma = sigma_range_mm(
        u,
        v,
        np.zeros_like(u),
        along_v=False,
        camera=estimate.intrinsics_or_fail(),
        plane=estimate.plane_or_fail(0),
        joint=estimate.joint,
        share="systematic",
    )
    return float(np.sqrt(np.mean(sigma**2)))


def sequential_mm(
    estimate: Calibration, fit: PlaneFit, range_mm: float, *, middle: bool = False
) -> float:
    """The same for a plane that follows the camera it was estimated with, cross terms included."""
    camera, plane = estimate.intrinsics_or_fail(), estimate.plane_or_fail(0)
    u, v = pixels_at(estimate, range_mm, middle=middle)
    _, slopes = range_slopes(u, v, along_v=False, camera=camera, plane=plane)
    by_camera = slopes[:, :10] + slopes[:, 10:] @ fit.by_intrinsics
    variance = ((by_camera @ np.array(camera.covariance)) * by_camera).sum(axis=1)
    variance = variance + ((slopes[:, 10:] @ fit.conditional) * slopes[:, 10:]).sum(axis=1)
    return float(np.sqrt(np.mean(variance)))
