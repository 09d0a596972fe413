"""Our own method: the bound at the speed of a median filter, and a robust fit where a row needs it.

Every row is tried with windowed moments (moments.py), which for a clean Gaussian stripe are as exact as
a least-squares fit. What their own remainder shows to be something else (clipped, hit by an impulse,
beside another stripe, at a border, very wide) is fitted sample by sample (fit.py). Raw frames are wanted:
a median filter before it only loses information.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import inlined, kernel
from .clipped import clipped_row
from .fit import fit_row
from .moments import (
    BASE,
    CENTRE,
    CLIPPED,
    DONE,
    FAILED,
    HEIGHT,
    PENDING,
    REST,
    WIDTH,
    windowed_moments,
)
from .window import LEFT, SAMPLES, top_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_SATURATED, _WEAK, _SECOND = int(Flag.SATURATED), int(Flag.WEAK), int(Flag.SECOND)
#: Degrees of freedom of the remainder: samples less centre, width and height.
_FREE = SAMPLES - 3
#: Remainders beyond this many standard deviations of chi-square are looked at closely.
_ODD = 5.5
#: Below this ratio of height to noise the centre is called weak.
_WEAK_BELOW = 8.0
#: sigma_u = 1.062 sqrt(w) s / A, the Cramer-Rao bound of a sampled Gaussian.
_BOUND = math.sqrt(2.0 / math.sqrt(math.pi))


def fused(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` (H, STRIPE_DTYPE) with the stripe points of a frame; returns how many there are.

    ``signal`` is the frame (H, W), less the laser-off frame if there is one, ``raw`` the frame itself (what is
    at or above ``clip_dn`` there is clipped); ``peaks`` are rough positions (-1: none) and whether there is
    another stripe; ``limits`` are from_px, to_px, base_dn, max_width_px.
    """
    return int(_fused(signal, raw, *peaks, *limits, noise, clip_dn, out))


@kernel
def _fused(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peak: Ints,
    second: npt.NDArray[np.bool_],
    from_px: int,
    to_px: int,
    base_dn: float,
    max_width_px: float,
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    height = len(peak)
    state = np.full(height, FAILED, np.uint8)
    for row in range(height):
        if peak[row] >= 0:
            clipped = _is_clipped(raw[row], peak[row], from_px, to_px, clip_dn)
            state[row] = CLIPPED if clipped else PENDING
    found = windowed_moments(signal, peak, state, from_px, to_px, noise)
    at_stripe = _noise_at_stripe(found[REST], state, noise)
    odd = _FREE * at_stripe**2 * (1.0 + _ODD * math.sqrt(2.0 / _FREE))
    count = 0
    for row in range(height):
        if peak[row] < 0:
            continue
        flags = _SECOND if second[row] else 0
        good = False
        if state[row] == CLIPPED:
            good, centre, sigma, width, amplitude, base = clipped_row(
                signal[row], raw[row], peak[row], from_px, to_px, at_stripe, clip_dn
            )
            flags |= _SATURATED
        if good:
            pass
        elif state[row] == DONE and found[REST, row] <= odd:
            centre, width = found[CENTRE, row], found[WIDTH, row]
            amplitude, base = found[HEIGHT, row], found[BASE, row]
            sigma = _BOUND * at_stripe * math.sqrt(width) / amplitude
        else:
            good, centre, sigma, width, amplitude, base, more = fit_row(
                signal, raw, row, peak[row], (from_px, to_px), base_dn, max_width_px, at_stripe, clip_dn
            )
            flags |= more
            if not good:
                continue
        if amplitude <= base_dn:
            continue
        if amplitude < _WEAK_BELOW * noise:
            flags |= _WEAK
        point = out[count]
        point.row = row
        point.u_px = centre
        point.sigma_u_px = sigma
        point.amplitude_dn = amplitude
        point.width_px = width
        point.background_dn = base
        point.flags = flags
        count += 1
    return count


@inlined
def _is_clipped(raw: npt.NDArray[Any], peak: int, from_px: int, to_px: int, clip_dn: float) -> bool:
    """Whether a sample of the window about ``peak`` is clipped."""
    # The peak is the brightest place or beside it: where even that is far below, nothing is clipped.
    if float(raw[peak]) < 0.8 * clip_dn:
        return False
    if peak - LEFT < from_px or peak - LEFT + SAMPLES > to_px:
        return False
    return top_of(raw, peak - LEFT) >= clip_dn


@kernel
def _noise_at_stripe(rest: Floats, state: npt.NDArray[np.uint8], noise: float) -> float:
    """Noise under the stripe from the rows' median remainder, where it is clearly above the frame's.

    Shot noise, speckle and a profile that is not Gaussian all show there, and belong into the deviation.
    """
    # Some sixty rows tell it as well as all of them.
    step = max(1, len(rest) // 60)
    some = np.empty(len(rest) // step + 1, np.float64)
    n = 0
    for row in range(0, len(rest), step):
        if state[row] == DONE:
            some[n] = rest[row]
            n += 1
    if n < 8:
        return noise
    # The median of chi-square lies below its mean by this factor.
    variance = np.sort(some[:n])[n // 2] / (_FREE * (1.0 - 2.0 / (9.0 * _FREE)) ** 3)
    doubt = 1.0 + 3.0 * 1.25 * math.sqrt(2.0 / _FREE / n)
    return math.sqrt(variance) if variance > noise * noise * doubt else noise
