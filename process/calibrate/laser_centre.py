"""Where the light leaves a laser, or a camera sees from: behind its front face, by two triangles.

Xiao et al. 2015, section 3.1.1: a line laser square to a wall draws a line of length s from one place
and t from another, straight behind it. The triangles are similar: with a and b the distances of the
front face from the wall and x that of the centre behind the face,

    s / (a + x) = t / (b + x)    so    x = (s b - t a) / (t - s).

For a camera s and t are the widths of wall that fill its picture. With r = t / s the uncertainty is

    sigma_x^2 = [(b - a) / (s (r - 1)^2)]^2 (r^2 sigma_s^2 + sigma_t^2)
                + (r^2 sigma_a^2 + sigma_b^2) / (r - 1)^2

so that an error of the rangefinder counts sqrt(r^2 + 1) / (r - 1) fold: the larger t over s, the
better. More than two places are fitted by a line through (distance, length), whose zero is at -x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...schemas.errors import CalibrationError


@dataclass(frozen=True)
class Reading:
    """One place: front face to wall, and length of the line (or width of the picture) on the wall."""

    distance_mm: float
    length_mm: float


@dataclass(frozen=True)
class Centre:
    """``behind_mm``: how far the centre lies behind the front face (negative: before it).

    ``gain`` is sigma_x over the rangefinder's own sigma, as far as that alone goes. ``residuals_mm``
    are those of the lengths (zero for two readings); ``opening_rad`` is the angle that the line spans.
    ``reduced_chi2`` is the scatter of the readings over what their sigmas predict; NaN for two.
    """

    behind_mm: float
    sigma_mm: float
    ratio: float
    gain: float
    opening_rad: float
    residuals_mm: tuple[float, ...]
    reduced_chi2: float


def gain_at(ratio: float) -> float:
    """How many times an error of the distance counts at t / s = ``ratio``: sqrt(r^2 + 1) / (r - 1)."""
    return float(np.hypot(ratio, 1.0) / (ratio - 1.0))


def centre_behind_face(
    readings: Sequence[Reading], *, sigma_distance_mm: float, sigma_length_mm: float
) -> Centre:
    """The centre from two readings (closed form) or more (weighted least squares in both coordinates).

    Raises
    ------
    CalibrationError
        Fewer than two readings, something not positive, equal distances, lengths that do not grow with
        the distance, or readings that contradict each other.
    """
    if len(readings) < 2:
        raise CalibrationError(
            f"{len(readings)} reading given, two at least are needed",
            hint="measure the line on the wall from two distances, such as 500:230 and 2000:865",
        )
    a = np.array([r.distance_mm for r in readings])
    s = np.array([r.length_mm for r in readings])
    if not (np.isfinite(a).all() and np.isfinite(s).all() and (a > 0).all() and (s > 0).all()):
        raise CalibrationError("distances and lengths must be positive numbers of mm")
    if not (
        sigma_distance_mm >= 0 and sigma_length_mm >= 0 and sigma_distance_mm + sigma_length_mm > 0
    ):
        raise CalibrationError("the uncertainties must not be negative, and not both zero")
    order = np.argsort(a)
    a, s = a[order], s[order]
    if len(np.unique(a)) < 2:
        raise CalibrationError(
            f"all readings are from {a[0]:g} mm; the triangles must differ",
            hint="move the laser straight back, at least twice as far",
        )
    slope, x, sigma, chi2 = _line(a, s, sigma_distance_mm, sigma_length_mm)
    if slope <= 0:
        raise CalibrationError(
            f"the line is not longer farther away: {s[0]:g} mm at {a[0]:g}, {s[-1]:g} at {a[-1]:g}",
            hint="each reading is DISTANCE:LENGTH, both in mm",
        )
    if x < -0.5 * a[0]:
        raise CalibrationError(
            f"the centre would lie {-x:.0f} mm before the front face, more than half way to the wall",
            hint="each reading is DISTANCE:LENGTH, both in mm; is the laser square to the wall?",
        )
    ratio = float(s[-1] / s[0])
    residual = s - slope * (a + x)
    limit = 4.0 * float(np.hypot(sigma_length_mm, slope * sigma_distance_mm))
    worst = int(np.abs(residual).argmax())
    if len(a) > 2 and abs(residual[worst]) > limit:
        raise CalibrationError(
            f"the readings contradict each other: {s[worst]:g} mm at {a[worst]:g} mm is "
            f"{residual[worst]:+.2f} mm off the line through the others, 4 sigma is {limit:.2f} mm",
            hint="measure that one again, or state larger uncertainties",
        )
    return Centre(
        behind_mm=float(x),
        sigma_mm=float(sigma),
        ratio=ratio,
        gain=gain_at(ratio),
        opening_rad=float(2.0 * np.arctan(slope / 2.0)),
        residuals_mm=tuple(float(r) for r in residual[np.argsort(order)]),
        reduced_chi2=chi2,
    )


def _line(
    a: np.ndarray, s: np.ndarray, sigma_a: float, sigma_s: float
) -> tuple[float, float, float, float]:
    """Slope and zero of ``s = slope (a + x)``, sigma of x, and chi-square per degree of freedom."""
    slope = float(np.polyfit(a, s, 1)[0])
    covariance = np.eye(2)
    value = np.zeros(2)
    for _ in range(20):
        # Errors of the distance count as errors of the length times the slope.
        variance = sigma_s**2 + (slope * sigma_a) ** 2
        design = np.stack([a, np.ones_like(a)], axis=1)
        covariance = variance * np.linalg.inv(design.T @ design)
        value = np.linalg.lstsq(design, s, rcond=None)[0]
        if abs(value[0] - slope) < 1e-14 * abs(slope) + 1e-18:
            break
        slope = float(value[0])
    x = float(value[1] / value[0])
    lever = np.array([-x / value[0], 1.0 / value[0]])
    sigma = float(np.sqrt(lever @ covariance @ lever))
    freedom = len(a) - 2
    rest = s - design @ value
    chi2 = float(rest @ rest / variance / freedom) if freedom else float("nan")
    return slope, x, sigma, chi2
