"""Acceptance limits of laser planes and axes, and in mm what their uncertainty means for a scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.quality import EstimationInput, Gate, LeftOut, Quality
from .axis_result import AxisFit
from .plane import PlaneFit
from .table_scale import TableScale

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PlaneLimits:
    """Limits of a plane's gates; lengths are shares of the median range of its stripes."""

    least_views: int = 5
    most_rms: float = 0.003
    most_sigma: float = 0.005
    least_spread: float = 0.02
    least_tilt_deg: float = 5.0
    least_agreeing: float = 0.4


@dataclass(frozen=True)
class AxisLimits:
    """Limits of an axis' gates."""

    least_frames: int = 5
    least_span_deg: float = 60.0
    most_rms_px: float = 1.0
    most_point_sigma_mm: float = 2.0
    most_direction_sigma_deg: float = 0.2
    most_wobble_deg: float = 0.3


def plane_quality(
    fit: PlaneFit,
    laser: int,
    limits: PlaneLimits,
    *,
    method: str,
    left_out: Sequence[LeftOut] = (),
    inputs: Sequence[EstimationInput] = (),
    intrinsics_known: bool = True,
) -> Quality:
    """Gates, what was left out, and notes of one laser's plane."""
    reach = float(np.median(np.linalg.norm(fit.points_mm, axis=1)))
    gates = (
        Gate.at_least("views", fit.used, limits.least_views),
        Gate.at_most("residual rms", fit.rms_mm, limits.most_rms * reach, "mm"),
        Gate.at_most("sigma at the stripes", worst_sigma_mm(fit), limits.most_sigma * reach, "mm"),
        Gate.at_least("spread of the stripes", fit.spread_mm[1], limits.least_spread * reach, "mm"),
        Gate.at_least("views that agree", fit.used / max(1, fit.offered), limits.least_agreeing),
        Gate.at_least("tilt between boards", fit.tilt_range_deg, limits.least_tilt_deg, "deg"),
    )
    words = ", ".join(f"{s:.2g} mm at {r / 1000:.3g} m" for r, s in range_sigmas_mm(fit))
    notes = [
        f"1 sigma of a range by this plane, the camera as given: {words} (the last beyond the stripes)"
    ]
    if fit.unexplained_mm > 0:
        notes.append(
            f"views scatter by {fit.unexplained_mm:.2g} mm (1 sigma) beyond corners and stripe: boards "
            "that are not flat, or a lens that its model does not fit; the covariance holds it"
        )
    if not intrinsics_known:
        notes.append("the camera's intrinsics have no covariance: they count as exact here")
    if fit.used < limits.least_agreeing * fit.offered:
        notes.append(
            f"{fit.offered} views show straight lines, {fit.used} agree on this plane: edges of a "
            "scene without a stripe do so by chance, and ranges by such a plane mean nothing"
        )
    if not gates[-1].passed:
        notes.append(
            f"all boards face the same way within {fit.tilt_range_deg:.1f} deg: an error that their "
            f"poses share is not seen; 1 % of the range would be {0.01 * reach:.1f} mm"
        )
    return Quality(
        part=f"plane/{laser}",
        method=method,
        gates=gates,
        left_out=tuple(left_out) + tuple(LeftOut(what=a, why=b) for a, b in fit.left_out),
        notes=tuple(notes),
        inputs=tuple(inputs),
    )


def axis_quality(
    fit: AxisFit,
    limits: AxisLimits,
    *,
    method: str,
    scale: TableScale | None = None,
    left_out: Sequence[LeftOut] = (),
    inputs: Sequence[EstimationInput] = (),
    notes: Sequence[str] = (),
) -> Quality:
    """Gates, what was left out, and notes of an axis."""
    # The camera counts as given: the plane, and so the scan, follow its errors as the axis does.
    # What matters is across the axis; along it the origin is a choice.
    across = np.eye(3) - np.outer(fit.direction, fit.direction)
    point = float(np.sqrt(np.linalg.eigvalsh(across @ fit.conditional[:3, :3] @ across)[-1]))
    direction = float(np.rad2deg(np.sqrt(max(0.0, np.linalg.eigvalsh(fit.conditional[3:, 3:])[-1]))))
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    gates = (
        Gate.at_least("frames", len(fit.frames), limits.least_frames),
        Gate.at_least("span of the angles", np.rad2deg(fit.span_rad), limits.least_span_deg, "deg"),
        Gate.at_most("rms", fit.rms_px, limits.most_rms_px, "px"),
        Gate.at_most("sigma across the axis", point, limits.most_point_sigma_mm, "mm"),
        Gate.at_most("sigma of the direction", direction, limits.most_direction_sigma_deg, "deg"),
        Gate.at_most("wobble", np.rad2deg(fit.wobble_rad), limits.most_wobble_deg, "deg"),
    )
    step = np.rad2deg(fit.step_sd_rad)
    said = [
        f"1 sigma of a radius by this axis, the camera as given: {point:.2g} mm; of a diameter twice",
        f"sigma of the point, with the camera's: {sigma[0]:.2g} {sigma[1]:.2g} {sigma[2]:.2g} mm",
        f"angles: true over nominal {fit.angle_scale:.5f}, steps scatter by {step:.2g} deg (1 sigma)",
    ]
    if np.isfinite(fit.eccentricity_rad):
        said.append(f"once a turn the angle is off by {np.rad2deg(fit.eccentricity_rad):.2g} deg")
    if fit.step_sd_rad > np.deg2rad(0.1):
        said.append(
            f"nominal angles hold to {step:.2g} deg only: at a radius of 100 mm that is "
            f"{100 * fit.step_sd_rad:.2g} mm along the turn; they were estimated, not used as they are"
        )
    if scale is not None:
        said.append(
            f"the laser finds the markers {scale.scale:.4f} times as large as stated "
            f"(1 sigma {np.sqrt(scale.own_variance):.4f}, {scale.frames} frames); the axis follows"
        )
    return Quality(
        part="axis",
        method=method,
        gates=gates,
        left_out=tuple(left_out) + tuple(LeftOut(what=a, why=b) for a, b in fit.left_out),
        notes=(*said, *notes),
        inputs=tuple(inputs),
    )


def worst_sigma_mm(fit: PlaneFit) -> float:
    """The largest 1 sigma of the plane's place, camera as given, at the corners of what was covered."""
    middle = fit.points_mm.mean(axis=0)
    axes = np.linalg.svd(fit.points_mm - middle, full_matrices=False)[2][:2]
    flat = (fit.points_mm - middle) @ axes.T
    low, high = np.percentile(flat, [2, 98], axis=0)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return float(fit.sigma_at_mm(middle + corners @ axes, camera_exact=True).max())


def range_sigmas_mm(fit: PlaneFit) -> list[tuple[float, float]]:
    """(range, its 1 sigma by the plane alone) at near and far end of the stripes, and at twice that.

    The camera counts as given.
    """
    reach = np.linalg.norm(fit.points_mm, axis=1)
    low, high = np.percentile(reach, [2, 98])
    middle = fit.points_mm.mean(axis=0)
    outward = middle - fit.normal * (fit.normal @ middle)
    outward = outward / np.linalg.norm(outward)
    foot = fit.normal * fit.distance_mm
    # Sideways the middle of the stripes, outward as far as the range wants.
    side = middle - foot - outward * ((middle - foot) @ outward)
    out = []
    for r in (low, high, 2.0 * high):
        square = r**2 - fit.distance_mm**2 - float(side @ side)
        point = foot + side + outward * np.sqrt(max(square, 0.0))
        ray = point / np.linalg.norm(point)
        out.append(
            (
                float(r),
                float(fit.sigma_at_mm(point[None], camera_exact=True)[0] / abs(fit.normal @ ray)),
            )
        )
    return out
