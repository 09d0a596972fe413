"""Acceptance limits of a joint adjustment, and what it means in mm at the ranges people measure at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...schemas.calibration import Calibration
from ...schemas.quality import Gate, LeftOut, Quality
from ..uncertainty import sigma_range_mm
from .difference import RANGES_MM, stripe_pixels
from .refine import Refined


@dataclass(frozen=True)
class RefineLimits:
    """Limits of the gates. ``most_stripe`` is over the stripes' stated sigmas."""

    most_rms_px: float = 0.5
    most_stripe: float = 5.0
    most_condition: float = 1e6
    most_birge: float = 5.0
    most_reference_sigmas: float = 3.0


def refine_quality(
    fit: Refined, calibration: Calibration, limits: RefineLimits, left_out: tuple[LeftOut, ...] = ()
) -> Quality:
    """Gates and notes of the joint adjustment; ``calibration`` is what it made."""
    s = fit.solution.sigmas
    gates = [
        Gate.at_most("corner noise", s.corner_px, limits.most_rms_px, "px"),
        Gate.at_most("stripe noise over stated", s.stripe, limits.most_stripe),
        Gate.at_most("condition", fit.solution.condition, limits.most_condition),
        Gate.at_most("contradiction of the views", fit.birge, limits.most_birge),
    ]
    if fit.data.turned is not None:
        gates.append(Gate.at_most("corner noise on the table", s.turned_px, limits.most_rms_px, "px"))
    if fit.references:
        worst = max(abs(r.sigmas) for r in fit.references)
        gates.append(Gate.at_most("worst reference", worst, limits.most_reference_sigmas, "sigma"))
    told = []
    for plane in calibration.lasers:
        words = ", ".join(
            f"{sigma:.2g} mm at {at / 1000:g} m"
            for at, sigma in systematic_mm(calibration, plane.laser)
        )
        told.append(
            f"laser {plane.laser}: systematic 1 sigma of a range: {words or 'not in the image'}"
        )
    for r in fit.references:
        told.append(
            f"{r.name}: stated {r.stated_mm:.2f} mm (sd {r.sd_mm:g}), adjusted {r.found_mm:.2f} mm, "
            f"the others say {r.off_mm:+.2f} mm ({r.sigmas:+.1f} sigma)"
        )
    if s.bend_mm > 0.02:
        told.append(
            f"the surfaces under the stripes are off their boards' planes by {s.bend_mm:.2g} mm (1 "
            f"sigma; turned, at the ends, by {s.twist_mm:.2g} mm): boards that are not flat; the "
            "covariance holds it"
        )
    if s.memory > 2.0:
        told.append(f"{s.memory:.0f} neighbouring rows of a stripe err together; they count as one")
    if fit.birge > 1.0:
        told.append(
            f"boards and walls pull against each other {fit.birge:.2g} times as hard as their noise "
            "says: all sigmas were enlarged by it"
        )
    if fit.start.turntable is not None and not fit.layout.axis:
        told.append("the axis was kept as it was: no observations of a turning table were given")
    kept = [p.laser for p in fit.start.lasers if f"plane/{p.laser}" not in fit.order]
    if kept:
        told.append(f"planes of lasers {kept} were kept as they were: no stripes of them were given")
    boards = len(fit.data.board_names)
    walls = len(fit.references)
    held = f"; held: {', '.join(fit.fixed)}" if fit.fixed else ""
    return Quality(
        part="joint",
        method=f"one adjustment of {boards} boards, {len(fit.data.stripes.on)} stripe points, "
        f"{walls} references{held}",
        gates=tuple(gates),
        left_out=left_out,
        notes=tuple(told),
    )


def systematic_mm(calibration: Calibration, laser: int) -> list[tuple[float, float]]:
    """(range, systematic 1 sigma of it) in mm, rms over the stripe, where it is in the image."""
    camera, plane = calibration.intrinsics_or_fail(), calibration.plane_or_fail(laser)
    out = []
    for at in RANGES_MM:
        u, v = stripe_pixels(calibration, laser, at)
        if not len(u):
            continue
        sigma = sigma_range_mm(
            u,
            v,
            np.zeros_like(u),
            along_v=False,
            camera=camera,
            plane=plane,
            joint=calibration.joint,
            share="systematic",
        )
        out.append((float(at), float(np.sqrt(np.mean(sigma**2)))))
    return out
