"""Acceptance limits of a joint adjustment, and what it means in mm at the ranges people measure at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...schemas.calibration import Calibration
from ...schemas.quality import Gate, LeftOut, Quality
from ..uncertainty import range_slopes, sigma_range_mm
from .difference import RANGES_MM, stripe_pixels
from .refine import Refined

#: Where pulls are told in mm, and of how many boards.
_AT_MM, _NAMED = 1000.0, 3


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
    if s.stripe > limits.most_stripe:
        stated = float(np.median(fit.data.stripes.sigma_px))
        found = s.stripe * stated
        at_1m = 1e3 * found / float(fit.state.camera[0])
        told.append(
            f"stripes scatter by {found:.2g} px ({at_1m:.2g} mm at 1 m), and state {stated:.2g} px: a "
            "surface that is not straight under them, or a lens that the model does not fit; where "
            "boards bend, one part after the other is safer"
        )
    if fit.birge > 1.0:
        told.append(
            f"boards and walls pull against each other {fit.birge:.2g} times as hard as their noise "
            f"says: all sigmas were enlarged by it{_worst_pulls(fit, calibration)}; boards that bend, "
            "or images with another focus, do so: refine with one set of images, or leave those out"
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


def _worst_pulls(fit: Refined, calibration: Calibration) -> str:
    """The boards without which ranges at 1 m would move most, and by how many mm."""
    moves: dict[str, float] = {}
    camera = calibration.intrinsics_or_fail()
    for plane in calibration.lasers:
        role = f"plane/{plane.laser}"
        u, v = stripe_pixels(calibration, plane.laser, _AT_MM)
        if role not in fit.order or not len(u):
            continue
        _, slopes = range_slopes(u, v, along_v=False, camera=camera, plane=plane)
        at = 10 + 4 * [r for r in fit.order if r.startswith("plane/")].index(role)
        follow = slopes @ fit.slopes[[*range(10), *range(at, at + 4)]]
        for number, step in zip(fit.pulls.cluster, fit.pulls.without, strict=True):
            if 0 <= number < len(fit.data.board_names):
                name = fit.data.board_names[number]
                rms = float(np.sqrt(np.mean((follow @ step) ** 2)))
                moves[name] = max(moves.get(name, 0.0), rms)
    worst = sorted(moves, key=lambda n: -moves[n])[:_NAMED]
    if not worst:
        return ""
    words = ", ".join(f"{name} {moves[name]:.2g} mm" for name in worst)
    return f" (ranges at {_AT_MM / 1000:g} m would move most without {words})"


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
