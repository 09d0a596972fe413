"""The turntable's axis from a board or markers seen at several angles: joint fit, covariance, sign.

One model serves both kinds of head: seen from the camera, everything that is watched turns about the
axis. On a turning table (``fixed`` head) that is the angle itself; when the head turns, the world seems
to turn the other way. Which way the controller counts is read off the data, never assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Head, Intrinsics
from ...schemas.errors import CalibrationError
from .axis_adjust import Adjusted, Prior, Sightings, Turning, adjust
from .axis_result import AxisFit, result_of
from .axis_start import first_turning
from .pose import rotation_of

Floats = npt.NDArray[np.float64]

LEAST_ANGLES = 3
#: Distinct angles differ by this much at least.
_DISTINCT_RAD = np.deg2rad(0.5)
#: A sighting (one body in one frame) is left out when its rms is this many times the usual.
_WRONG = 5.0


def fit_axis(
    sightings: Sightings,
    names: Sequence[str],
    nominal_rad: npt.ArrayLike,
    camera: Intrinsics,
    *,
    head: Head,
    angle_sd_rad: float = float(np.deg2rad(0.5)),
    seed: int = 0,
) -> AxisFit:
    """The axis from points of rigid bodies, seen in frames ``names`` at ``nominal_rad`` angles.

    ``angle_sd_rad`` is how well the nominal angles are known: they are estimated with it as a prior,
    together with one scale for all; 0 takes them as exact.

    Raises
    ------
    CalibrationError
        Fewer than three different angles, nothing turned, one axis does not explain what was seen, the
        nominal angles do not fit, or they leave the sign of the turn open.
    """
    nominal = np.asarray(nominal_rad, np.float64)
    left: list[tuple[str, str]] = []
    sightings, kept, bodies = _compact(sightings)
    for k in sorted(set(range(len(names))) - set(kept)):
        left.append((names[k], "no board and no markers were found"))
    used = [names[k] for k in kept]
    nominal = nominal[kept]
    _check_angles(nominal, len(names))
    rough = first_turning(sightings, camera, frames=len(kept), bodies=bodies, seed=seed)
    rough = _upright(rough)
    sense = _sense(rough.phi_rad, nominal)
    turning = replace(rough, phi_rad=_unwrapped(rough.phi_rad, sense * nominal))
    prior = Prior(sense * nominal, angle_sd_rad)
    fitted = adjust(turning, sightings, camera, prior)
    wrong = _wrong(fitted, sightings)
    if wrong:
        drop = np.zeros(len(sightings.frame), np.bool_)
        for frame, body, ratio in wrong:
            drop |= (sightings.frame == frame) & (sightings.body == body)
            left.append(
                (used[frame], f"a marker or the board is {ratio:.0f} times as far off as usual")
            )
        sightings, again, _ = _compact(sightings.select(~drop), bodies_stay=True)
        used, nominal = [used[k] for k in again], nominal[again]
        _check_angles(nominal, len(names))
        state = fitted.turning
        first = state.phi_rad[again[0]]
        state = _from_frame(state, first, state.phi_rad[again] - first)
        prior = Prior(sense * nominal, angle_sd_rad)
        fitted = adjust(state, sightings, camera, prior)
    return result_of(fitted, sightings, used, nominal, sense, head, camera, prior, left)


def _compact(s: Sightings, *, bodies_stay: bool = False) -> tuple[Sightings, list[int], int]:
    """Frames (and bodies) renumbered without gaps; the old numbers of the frames; how many bodies."""
    kept, frame = np.unique(s.frame, return_inverse=True)
    if bodies_stay:
        names, body = np.arange(int(s.body.max()) + 1), s.body
    else:
        names, body = np.unique(s.body, return_inverse=True)
    return replace(s, frame=frame, body=body), [int(k) for k in kept], len(names)


def _from_frame(state: Turning, first: float, phi: Floats) -> Turning:
    """The same turning, counted from another frame."""
    back = rotation_of(state.direction * first)
    return replace(
        state,
        rotations=back @ state.rotations,
        translations_mm=(state.translations_mm - state.point_mm) @ back.T + state.point_mm,
        phi_rad=phi,
    )


def _check_angles(nominal: Floats, given: int) -> None:
    different = (
        np.unique(np.rint(np.mod(nominal, 2 * np.pi) / _DISTINCT_RAD)).size if len(nominal) else 0
    )
    if different < LEAST_ANGLES:
        raise CalibrationError(
            f"board or markers are seen at {different} different angles (of {given} frames); "
            f"{LEAST_ANGLES} at least are needed: two angles fit some axis exactly, and nothing would "
            "say that it is tens of mm off",
            hint="take frames at more angles, a whole turn if the table can",
        )


def _upright(state: Turning) -> Turning:
    """Direction chosen "up": against the camera's Y, or towards a camera that looks along the axis."""
    d = state.direction
    up = -d[1] if abs(d[1]) > 0.3 else -d[2]
    if up >= 0:
        return state
    return replace(state, direction=-d, phi_rad=-state.phi_rad)


def _sense(phi: Floats, nominal: Floats) -> int:
    """+1 if what is watched turns right-handed about the direction as nominal angles grow, else -1."""
    fit = {sign: abs(np.mean(np.exp(1j * (phi - sign * nominal)))) for sign in (1, -1)}
    sign = max(fit, key=lambda k: fit[k])
    if fit[sign] < 0.9:
        raise CalibrationError(
            f"the given angles do not fit what turned (agreement {fit[sign]:.2f}, 1 is perfect)",
            hint="is the step right, are the frames in order, did nothing but the table move?",
        )
    if fit[sign] - fit[-sign] < 0.02:
        raise CalibrationError(
            "the angles leave open which way the table turns",
            hint="take frames at angles that are no mirror images of one another: 0, 30, 60 deg",
        )
    return sign


def _unwrapped(phi: Floats, expected: Floats) -> Floats:
    offset = np.angle(np.mean(np.exp(1j * (phi - expected))))
    rest = np.angle(np.exp(1j * (phi - expected - offset)))
    out = expected + rest
    return out - out[0]


def _wrong(fitted: Adjusted, s: Sightings) -> list[tuple[int, int, float]]:
    size = (fitted.residual_px**2).sum(axis=1)
    pairs = sorted(set(zip(s.frame.tolist(), s.body.tolist(), strict=True)))
    each = {p: float(np.sqrt(size[(s.frame == p[0]) & (s.body == p[1])].mean())) for p in pairs}
    usual = max(float(np.median(list(each.values()))), 0.02)
    return [(f, m, r / usual) for (f, m), r in each.items() if r > _WRONG * usual]
