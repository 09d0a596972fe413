"""Clipped stripes, from their flanks: a fit without the clipped samples, on the windows' tables.

With a window g about (c, k) a Gaussian stripe is g (a0 + a1 x + a2 x^2) to first order: its centre is
c + k^2 a1 / a0 and 1 / w^2 = 1 / k^2 - 2 a2 / a0. The equations hold for any set of samples; two
rounds, the first from a closed form of the four samples beside the plateau, end within rounding.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ..compiled import part
from .window import LEFT, NEAREST, PHASES, REACH, SAMPLES, SIDE, G, K, Singles, X, mean_of

Fit = tuple[bool, float, float, float, float, float, float]

#: What is returned where there is no fit.
BAD: Final = (False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

_ROUNDS = 4
#: Most clipped samples, and least flank, that fit a window.
_LONGEST, _LEAST_USED = 20, 6
#: Share of the remainder that one sample may hold: of an impulse it is half and more, of a profile that
#: is no Gaussian a quarter. Where few samples are left to judge by, this many times their own share.
_SHARE, _OWN_SHARES = 0.35, 4.0


@part
def clipped_row(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    from_px: int,
    to_px: int,
    clip_dn: float,
) -> Fit:
    """(good, centre, width, height, background, remainder, lever) of the clipped stripe at ``peak``.

    The remainder is the mean square of what the fit leaves, in DN^2; the centre's deviation is lever
    times the noise.
    """
    first = last = peak
    if float(raw[row, peak]) < clip_dn:
        # The peak was that of three rows: the plateau may begin beside it.
        first = last = (
            peak + 1 if peak + 1 < to_px and float(raw[row, peak + 1]) >= clip_dn else peak - 1
        )
        if first < from_px or float(raw[row, first]) < clip_dn:
            return BAD
    while first > from_px and float(raw[row, first - 1]) >= clip_dn:
        first -= 1
    while last < to_px - 1 and float(raw[row, last + 1]) >= clip_dn:
        last += 1
    if last - first >= _LONGEST or first - 3 < from_px or last + 3 >= to_px:
        return BAD
    middle = (first + last) // 2
    far = len(K) - 1
    margin = max(REACH[far] + SIDE, SAMPLES)
    if middle - margin < from_px or middle + margin >= to_px:
        return BAD
    far_left = float(mean_of(signal, row, middle - margin))
    base = 0.5 * (far_left + float(mean_of(signal, row, middle + margin - SIDE + 1)))
    left, left2 = float(signal[row, first - 1]) - base, float(signal[row, first - 2]) - base
    right, right2 = float(signal[row, last + 1]) - base, float(signal[row, last + 2]) - base
    if not (left > left2 > 0.0 and right > right2 > 0.0):
        return BAD
    # ln(a / b) = (xb^2 - xa^2) / (2 w^2) for two samples of a flank; the mean of both flanks' 1 / w^2.
    half = 0.5 * (last - first) + 1.0
    curve = (math.log(left / left2) + math.log(right / right2)) / (2.0 * half + 1.0)
    if not curve > 1.0 / (K[far] * K[far]):
        return BAD
    width = 1.0 / math.sqrt(curve)
    centre = 0.5 * (first + last) - math.log(left / right) / (2.0 * half * curve)
    return masked_fit(signal, raw, row, centre, width, 2.0 + half, from_px, to_px, clip_dn)


@part
def masked_fit(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    centre: float,
    width: float,
    leash: float,
    from_px: int,
    to_px: int,
    clip_dn: float,
) -> Fit:
    """The fit without clipped samples from a start near it; it may move by ``leash`` px.

    The result is that of :func:`clipped_row`; where it is not good, its width is the last one tried.
    """
    begun, far = centre, len(K) - 1
    for _ in range(_ROUNDS):
        if not 0.3 < width <= K[far] or abs(centre - begun) > leash:
            return False, 0.0, width, 0.0, 0.0, 0.0, 0.0
        i = NEAREST[int(32.0 * width + 0.5)]
        pixel = int(math.floor(centre))
        phase = int((centre - pixel) * PHASES + 0.5)
        own = K[i]
        beside = REACH[i]
        margin = max(beside + SIDE, LEFT + 1)
        if pixel - margin < from_px or pixel + margin >= to_px:
            return BAD
        beyond = float(mean_of(signal, row, pixel - beside - SIDE))
        base = 0.5 * (beyond + float(mean_of(signal, row, pixel + beside + 1)))
        n0, n1, n2, n3, n4, b0, b1, b2, rest, used = _flank_sums(
            signal, raw, row, pixel - LEFT, np.float32(base), clip_dn, G[i, phase], X[phase]
        )
        if used < _LEAST_USED:
            return BAD
        # The equations [[n0 n1 n2] [n1 n2 n3] [n2 n3 n4]] a = b, by cofactors.
        c00, c01, c02 = n2 * n4 - n3 * n3, n2 * n3 - n1 * n4, n1 * n3 - n2 * n2
        c11, c12, c22 = n0 * n4 - n2 * n2, n1 * n2 - n0 * n3, n0 * n2 - n1 * n1
        det = n0 * c00 + n1 * c01 + n2 * c02
        if not det > 0.0:
            return BAD
        a0 = (c00 * b0 + c01 * b1 + c02 * b2) / det
        a1 = (c01 * b0 + c11 * b1 + c12 * b2) / det
        a2 = (c02 * b0 + c12 * b1 + c22 * b2) / det
        square = own * own
        if not a0 > 0.0:
            return BAD
        shift = square * a1 / a0
        curve = 1.0 / square - 2.0 * a2 / a0
        if not curve > 0.0:
            return False, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0
        if abs(shift) > own:
            return BAD
        centre = pixel + phase / PHASES + shift
        narrower = 1.0 / math.sqrt(curve)
        settled = abs(shift) < 0.08 * own and abs(narrower - own) < 0.06 * own
        width = narrower
        if settled:
            rest -= a0 * b0 + a1 * b1 + a2 * b2
            lever = square / a0 * math.sqrt(c11 / det)
            return True, centre, width, a0, base, rest / (used - 3.0), lever
    return BAD


@part
def stands_out(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    centre: float,
    width: float,
    base: float,
    clip_dn: float,
) -> bool:
    """Whether a single sample holds much of what the Gaussian about ``centre`` does not explain."""
    i = NEAREST[min(int(32.0 * width + 0.5), len(NEAREST) - 1)]
    pixel = int(math.floor(centre))
    first = pixel - LEFT
    if first < 0 or first + SAMPLES > signal.shape[1]:
        return True
    phase = int((centre - pixel) * PHASES + 0.5)
    g, x = G[i, phase], X[phase]
    n0, n1, n2, n3, n4, b0, b1, b2, _, used = _flank_sums(
        signal, raw, row, first, np.float32(base), clip_dn, g, x
    )
    c00, c01, c02 = n2 * n4 - n3 * n3, n2 * n3 - n1 * n4, n1 * n3 - n2 * n2
    c11, c12, c22 = n0 * n4 - n2 * n2, n1 * n2 - n0 * n3, n0 * n2 - n1 * n1
    det = n0 * c00 + n1 * c01 + n2 * c02
    if used < _LEAST_USED or not det > 0.0:
        return True
    a0 = np.float32((c00 * b0 + c01 * b1 + c02 * b2) / det)
    a1 = np.float32((c01 * b0 + c11 * b1 + c12 * b2) / det)
    a2 = np.float32((c02 * b0 + c12 * b1 + c22 * b2) / det)
    line, start = np.uintp(row), np.uintp(first)
    level, below = np.float32(clip_dn), np.float32(base)
    one, none = np.float32(1.0), np.float32(0.0)
    total = worst = none
    for j in range(SAMPLES):
        at = start + np.uintp(j)
        counts = one if np.float32(raw[line, at]) < level else none
        place = x[j]
        rest = (np.float32(signal[line, at]) - below - g[j] * (a0 + place * (a1 + place * a2))) * counts
        square = rest * rest
        total += square
        worst = square if square > worst else worst
    return float(worst) > max(_SHARE, _OWN_SHARES / used) * float(total)


@part
def _flank_sums(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    first: int,
    base: np.float32,
    clip_dn: float,
    g: Singles,
    x: Singles,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Normal equations of a0, a1, a2 over samples that are not clipped; sum of squares; how many."""
    n0 = n1 = n2 = n3 = n4 = b0 = b1 = b2 = rest = used = np.float32(0.0)
    line, start = np.uintp(row), np.uintp(first)
    level = np.float32(clip_dn)
    one, none = np.float32(1.0), np.float32(0.0)
    for j in range(SAMPLES):
        at = start + np.uintp(j)
        counts = one if np.float32(raw[line, at]) < level else none
        value = (np.float32(signal[line, at]) - base) * counts
        weight = g[j] * counts
        place = x[j]
        square = weight * weight
        n0 += square
        square *= place
        n1 += square
        square *= place
        n2 += square
        square *= place
        n3 += square
        n4 += square * place
        product = weight * value
        b0 += product
        product *= place
        b1 += product
        b2 += product * place
        rest += value * value
        used += counts
    return (
        float(n0), float(n1), float(n2), float(n3), float(n4),
        float(b0), float(b1), float(b2), float(rest), float(used),
    )  # fmt: skip
