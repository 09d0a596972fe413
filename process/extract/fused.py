"""Our own method: the bound at the speed of a median filter, and a robust fit where a row needs it.

Every row is tried with windowed moments (moments.py), which for a clean Gaussian stripe are as exact as
a least-squares fit. What their own remainder shows to be something else (clipped, hit by an impulse,
beside another stripe, at a border, very wide) is fitted sample by sample (fit.py). Raw frames are
wanted: a median filter before it only loses information.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import inlined, kernel
from .clipped import clipped_row
from .fit import CERTAIN, fit_row, second_near
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
from .search import second_try
from .window import LEFT, SAMPLES, top_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_SATURATED, _WEAK, _SECOND = int(Flag.SATURATED), int(Flag.WEAK), int(Flag.SECOND)
#: Degrees of freedom of the remainder: samples less centre, width and height.
_FREE = SAMPLES - 3
#: Remainders beyond this many standard deviations of chi-square are looked at closely.
_ODD = 5.0
#: Narrower than the first, in px, a hot pixel passes for a stripe; than the second, moments move with
#: the phase by more than a hundredth of the usual deviation.
_HOT, _NARROW = 0.55, 1.0
#: Below this ratio of height to noise the centre is called weak.
_WEAK_BELOW = 8.0
#: Which of the ordered remainders tells the noise, and how far below the mean that is for a normal one.
_QUANTILE, _QUANTILE_SIGMAS = 0.2, 0.8416
#: Share of the weighted remainder that the fit itself takes away, times the width: see
#: _variance_at_flanks.
_TAKEN = 0.673
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
        _fused(signal, raw, peak, second, from_px, to_px, base_dn, max_width_px, noise, clip_dn, out)
    )


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
    many = _FREE * (1.0 + _ODD * math.sqrt(2.0 / _FREE))
    common, loud = _noise_at_stripe(signal, found, state, noise)
    odd, unlike = many * common * common, many * noise * noise
    count, narrow = 0, False
    for row in range(height):
        if peak[row] < 0:
            continue
        flags = _SECOND if second[row] else 0
        good = False
        if state[row] == CLIPPED:
            good, centre, sigma, width, amplitude, base = clipped_row(
                signal[row], raw[row], peak[row], from_px, to_px, loud, clip_dn
            )
            flags |= _SATURATED
        plain = state[row] == DONE and found[REST, row] <= odd and found[WIDTH, row] >= _HOT
        if plain and found[HEIGHT, row] + found[BASE, row] >= clip_dn:
            plain = not _on_clipped(raw[row], found[CENTRE, row], clip_dn)
        if good:
            pass
        elif plain:
            centre, width = found[CENTRE, row], found[WIDTH, row]
            amplitude, base = found[HEIGHT, row], found[BASE, row]
            sigma = _BOUND * loud * math.sqrt(width) / amplitude
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
                (base_dn, max_width_px, loud, noise),
                clip_dn,
            )
            if not good:
                continue
            flags |= more
        if amplitude <= base_dn or amplitude * math.sqrt(_MATCHED * width) < CERTAIN * noise:
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
        narrow |= width < _NARROW
    if narrow:
        _add_phase_error(out, count, state)
    return count


@kernel
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
    found = fit_row(signal, raw, row, peak, span, limits, clip_dn)
    if not found[0]:
        other = second_try(signal, row, span[0], span[1])
        if other >= 0 and abs(other - peak) >= 3:
            found = fit_row(signal, raw, row, other, span, limits, clip_dn)
    return found


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
def _on_clipped(raw: npt.NDArray[Any], centre: float, clip_dn: float) -> bool:
    """Whether a sample at the centre is clipped: the moments may have moved to a pair of hot pixels."""
    at = int(centre)
    return float(raw[at]) >= clip_dn or float(raw[at + 1]) >= clip_dn


@kernel
def _noise_at_stripe(
    signal: npt.NDArray[Any], found: Floats, state: npt.NDArray[np.uint8], noise: float
) -> tuple[float, float]:
    """Noise of the samples about the stripe, and noise as the centre feels it: from the rows'
    remainders.

    Shot noise, speckle and a profile that is not Gaussian all show there, and belong into the
    deviation. Both are ``noise`` unless the remainders are clearly above it.
    """
    # Some sixty rows tell it as well as all of them.
    rest = found[REST]
    step = max(1, len(rest) // 60)
    some = np.empty(len(rest) // step + 1, np.float64)
    n = 0
    for row in range(0, len(rest), step):
        if state[row] == DONE:
            some[n] = rest[row]
            n += 1
    if n < 8:
        return noise, noise
    # A low quantile, since impulses hit many rows; chi-square's lies below its mean by the cube.
    spread = math.sqrt(2.0 / (9.0 * _FREE))
    low = (1.0 - spread * spread - _QUANTILE_SIGMAS * spread) ** 3
    variance = np.sort(some[:n])[int(_QUANTILE * n)] / (_FREE * low)
    doubt = 1.0 + 3.0 * 1.4 * math.sqrt(2.0 / _FREE / n)
    if variance <= noise * noise * doubt:
        return noise, noise
    total, n = 0.0, 0
    for row in range(step // 2, len(rest), 2 * step):
        if state[row] == DONE and rest[row] < 2.0 * _FREE * variance:
            model = (found[CENTRE, row], found[WIDTH, row], found[HEIGHT, row], found[BASE, row])
            total += _variance_at_flanks(signal[row], model)
            n += 1
    flanks = total / n if n > 0 else variance
    return math.sqrt(variance), max(noise, math.sqrt(flanks))


@kernel
def _variance_at_flanks(line: npt.NDArray[Any], model: tuple[float, float, float, float]) -> float:
    """Variance of the samples, weighted as they move the centre, with its squared slope."""
    centre, width, height, base = model
    first = max(0, int(centre - 3.0 * width))
    stop = min(len(line), int(centre + 3.0 * width) + 2)
    # The model is near, not exact: what height, centre and width still explain is taken away first.
    g0 = g2 = g4 = r0 = r1 = r2 = 0.0
    for j in range(first, stop):
        t = (j - centre) / width
        value = math.exp(-0.5 * t * t)
        rest = float(line[j]) - base - height * value
        g0 += value * value
        g2 += (t * value) ** 2
        g4 += (t * t * value) ** 2
        r0 += value * rest
        r1 += t * value * rest
        r2 += t * t * value * rest
    det = g0 * g4 - g2 * g2
    taller, moved, wider = (g4 * r0 - g2 * r2) / det, r1 / g2, (g0 * r2 - g2 * r0) / det
    total = 0.0
    for j in range(first, stop):
        t = (j - centre) / width
        value = math.exp(-0.5 * t * t)
        rest = float(line[j]) - base - value * (height + taller + t * (moved + t * wider))
        total += (t * value * rest) ** 2
    # Of the weighted remainder this fit has taken a part.
    return total / (g2 * max(1.0 - _TAKEN / width, 0.3))


@kernel
def _add_phase_error(out: npt.NDArray[Any], count: int, state: npt.NDArray[np.uint8]) -> None:
    """Widen the deviations of the narrow stripes among the first ``count`` points."""
    for i in range(count):
        point = out[i]
        if point.width_px < _NARROW and state[point.row] == DONE:
            point.sigma_u_px = math.hypot(point.sigma_u_px, _phase_error(point.width_px))


@kernel
def _phase_error(width: float) -> float:
    """Deviation of the moments' centre over the places in a pixel, for the narrowest window, k = 1.

    Window times stripe has the variance v = w^2 / (w^2 + 1) and is sampled at whole pixels: by
    Poisson's sum formula its mean moves by 4 pi v exp(-2 pi^2 v) sin(2 pi u), and the centre by 1 / (1
    - v) of that.
    """
    v = width * width / (width * width + 1.0)
    return 4.0 * math.pi * v * math.exp(-2.0 * math.pi**2 * v) / (1.0 - v) / math.sqrt(2.0)
