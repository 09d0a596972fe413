"""Our own method: the bound at the speed of a median filter, and a robust fit where a row needs it.

Every row is tried with windowed moments (moments.py), which for a clean Gaussian stripe are as exact as
a least-squares fit. Clipped rows are fitted to their flanks (clipped.py), very wide ones to means of
neighbouring samples (wide.py). What a row's own remainder shows to be something else (hit by an
impulse, beside another stripe, at a border, skewed) is fitted sample by sample (fit.py). Raw frames are
wanted: a median filter before it only loses information.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import inlined, kernel, part
from .clipped import BAD, clipped_row
from .deviation import FREE, NARROW, add_phase_error, noise_at_stripe
from .extractor import LEAST, SQRT_2
from .fit import CERTAIN, NO_FIT, fit_row, second_near
from .moments import (
    BASE,
    CENTRE,
    CLIPPED,
    DONE,
    FAILED,
    HEIGHT,
    PENDING,
    REST,
    WIDE,
    WIDTH,
    windowed_moments,
)
from .noise import noise_within
from .search import peaks_within, second_try
from .wide import wide_row
from .width_check import width_is_odd
from .window import LEFT, SAMPLES, top_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_SATURATED, _WEAK, _SECOND = int(Flag.SATURATED), int(Flag.WEAK), int(Flag.SECOND)
#: Remainders beyond this many standard deviations of chi-square are looked at closely.
_ODD = 5.0
#: A fit whose deviation is so many times what the noise explains leaves much unexplained.
_POOR = 3.0
#: Narrower than this, in px, a hot pixel passes for a stripe.
_HOT = 0.55
#: Below this ratio of height to noise the centre is called weak.
_WEAK_BELOW = 8.0
#: The energy of a Gaussian of height and width 1: sqrt(pi).
_MATCHED = math.sqrt(math.pi)
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

    ``signal`` is the frame (H, W), less the laser-off frame if there is one, ``raw`` the frame itself
    (what is at or above ``clip_dn`` there is clipped); ``peaks`` are rough positions (-1: none) and
    whether there is another stripe; ``limits`` are from_px, to_px, base_dn, max_width_px.
    """
    peak, second = peaks
    from_px, to_px, base_dn, max_width_px = limits
    return int(
        _chosen(signal, raw, peak, second, from_px, to_px, base_dn, max_width_px, noise, clip_dn, out)
    )


def brightest(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """As :func:`fused`, of the brightest stripe of each row, which is searched here.

    ``noise`` is that of ``raw``, less than nothing if it is still to be estimated.
    """
    from_px, to_px, base_dn, max_width_px = limits
    return int(
        _brightest(
            signal,
            raw,
            from_px,
            to_px,
            base_dn,
            max_width_px,
            noise,
            signal is not raw,
            raw.dtype.kind != "f",
            clip_dn,
            out,
        )
    )


@kernel
def _brightest(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    from_px: int,
    to_px: int,
    base_dn: float,
    max_width_px: float,
    noise: float,
    subtracted: bool,
    whole: bool,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    if noise < 0.0:
        noise = noise_within(raw, whole)
    if subtracted:
        noise *= SQRT_2
    base_dn = max(base_dn, LEAST * noise)
    peak, second = peaks_within(signal, from_px, to_px, base_dn)
    return _points(
        signal, raw, peak, second, from_px, to_px, base_dn, max_width_px, noise, clip_dn, out
    )


@kernel
def _chosen(
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
    return _points(
        signal, raw, peak, second, from_px, to_px, base_dn, max_width_px, noise, clip_dn, out
    )


@inlined
def _points(
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
            clipped = _is_clipped(raw, row, peak[row], from_px, to_px, clip_dn)
            state[row] = CLIPPED if clipped else PENDING
    found = windowed_moments(signal, peak, state, from_px, to_px, noise)
    lever = np.empty(height, np.float64)
    for row in range(height):
        if peak[row] < 0 or state[row] == DONE:
            continue
        fit = BAD
        if state[row] == CLIPPED:
            fit = clipped_row(signal, raw, row, peak[row], from_px, to_px, clip_dn)
        else:
            fit = wide_row(signal, raw, row, peak[row], from_px, to_px, clip_dn)
        good, centre, width, amplitude, base, rest, lever[row] = fit
        found[CENTRE, row], found[WIDTH, row], found[HEIGHT, row] = centre, width, amplitude
        found[BASE, row], found[REST, row] = base, FREE * rest
        if not good:
            state[row] = FAILED
        elif state[row] == FAILED:
            state[row] = WIDE
    many = FREE * (1.0 + _ODD * math.sqrt(2.0 / FREE))
    common, loud, common_done, loud_done = noise_at_stripe(signal, found, state, noise)
    odd, odd_done = many * common * common, many * common_done * common_done
    unlike = many * noise * noise
    certain = (CERTAIN * noise) ** 2
    count: Any = np.int64(0)
    narrow = False
    for row in range(height):
        if peak[row] < 0:
            continue
        flags = _SECOND if second[row] else 0
        plain = state[row] != FAILED and _HOT <= found[WIDTH, row] <= max_width_px
        plain = plain and found[REST, row] <= (odd_done if state[row] == DONE else odd)
        if plain and state[row] == DONE and found[HEIGHT, row] + found[BASE, row] >= clip_dn:
            plain = not _on_clipped(raw, row, found[CENTRE, row], clip_dn)
        if plain:
            centre, width = found[CENTRE, row], found[WIDTH, row]
            amplitude, base = found[HEIGHT, row], found[BASE, row]
            if state[row] == DONE:
                sigma = _BOUND * loud_done * math.sqrt(width) / amplitude
            else:
                sigma = loud * lever[row]
                flags |= _SATURATED if state[row] == CLIPPED else 0
            if found[REST, row] > unlike and second_near(
                signal[row], centre, amplitude, base, noise, from_px, to_px
            ):
                flags |= _SECOND
        else:
            good, centre, sigma, width, amplitude, base, more = _fitted(
                signal,
                raw,
                row,
                peak[row],
                (from_px, to_px),
                (base_dn, max_width_px, loud_done, noise),
                clip_dn,
            )
            if not good:
                continue
            poor = sigma > _POOR * _BOUND * loud_done * math.sqrt(width) / amplitude
            if poor and width_is_odd(found, state, row, width, odd_done):
                continue
            flags |= more
        if amplitude <= base_dn or amplitude * amplitude * _MATCHED * width < certain:
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
        narrow |= width < NARROW
    if narrow:
        add_phase_error(out, count, state)
    return count


@inlined
def _fitted(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    span: tuple[int, int],
    limits: tuple[float, float, float, float],
    clip_dn: float,
) -> tuple[bool, float, float, float, float, float, int]:
    """As :func:`fit_row`; where nothing can be fitted, once more without single hot columns."""
    at, found = peak, NO_FIT
    for turn in range(2):
        found = fit_row(signal, raw, row, at, span, limits, clip_dn)
        if found[0] or turn == 1:
            break
        at = second_try(signal, row, span[0], span[1])
        if at < 0 or abs(at - peak) < 3:
            break
    return found


@inlined
def _is_clipped(
    raw: npt.NDArray[Any], row: int, peak: int, from_px: int, to_px: int, clip_dn: float
) -> bool:
    """Whether a sample of the window about ``peak`` is clipped."""
    # The peak is the brightest place or beside it: where even that is far below, nothing is clipped.
    if float(raw[np.uintp(row), np.uintp(peak)]) < 0.8 * clip_dn:
        return False
    if peak - LEFT < from_px or peak - LEFT + SAMPLES > to_px:
        return False
    return top_of(raw, row, peak - LEFT) >= clip_dn


@part
def _on_clipped(raw: npt.NDArray[Any], row: int, centre: float, clip_dn: float) -> bool:
    """Whether a sample at the centre is clipped: the moments may have moved to a pair of hot pixels."""
    at = int(centre)
    return float(raw[row, at]) >= clip_dn or float(raw[row, at + 1]) >= clip_dn
