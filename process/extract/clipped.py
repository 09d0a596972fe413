"""Clipped stripes, from their flanks: a fit without the clipped samples, on the windows' tables.

With a window g about (c, k) a Gaussian stripe is g (a0 + a1 x + a2 x^2) to first order: its centre is
c + k^2 a1 / a0 and 1 / w^2 = 1 / k^2 - 2 a2 / a0. The equations hold for any set of samples; two
rounds, the first from a closed form of the four samples beside the plateau, end within rounding.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel
from .window import LEFT, NEAREST, PHASES, REACH, SAMPLES, SIDE, G, K, Singles, X, mean_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_ROUNDS = 4
#: Most clipped samples, and least flank, that fit a window.
_LONGEST, _LEAST_USED = 16, 6
#: Remainder, as a multiple of the noise's variance, from which the fit is not believed.
_ODD = 2.5


@kernel
def clipped_row(
    line: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peak: int,
    from_px: int,
    to_px: int,
    noise: float,
    clip_dn: float,
) -> tuple[bool, float, float, float, float, float]:
    """(good, centre, its deviation, width, height, background) of the clipped stripe at ``peak``."""
    bad = (False, 0.0, 0.0, 0.0, 0.0, 0.0)
    first = last = peak
    if float(raw[peak]) < clip_dn:
        # The peak was that of three rows: the plateau may begin beside it.
        first = last = peak + 1 if peak + 1 < to_px and float(raw[peak + 1]) >= clip_dn else peak - 1
        if first < from_px or float(raw[first]) < clip_dn:
            return bad
    while first > from_px and float(raw[first - 1]) >= clip_dn:
        first -= 1
    while last < to_px - 1 and float(raw[last + 1]) >= clip_dn:
        last += 1
    if last - first >= _LONGEST or first - 3 < from_px or last + 3 >= to_px:
        return bad
    middle = (first + last) // 2
    far = len(K) - 1
    margin = max(REACH[far] + SIDE, SAMPLES)
    if middle - margin < from_px or middle + margin >= to_px:
        return bad
    base = 0.5 * (mean_of(line, middle - margin) + mean_of(line, middle + margin - SIDE + 1))
    left, left2 = float(line[first - 1]) - base, float(line[first - 2]) - base
    right, right2 = float(line[last + 1]) - base, float(line[last + 2]) - base
    if not (left > left2 > 0.0 and right > right2 > 0.0):
        return bad
    # ln(a / b) = (xb^2 - xa^2) / (2 w^2) for two samples of a flank; the mean of both flanks' 1 / w^2.
    half = 0.5 * (last - first) + 1.0
    curve = (math.log(left / left2) + math.log(right / right2)) / (2.0 * half + 1.0)
    if not curve > 1.0 / (K[far] * K[far]):
        return bad
    width = 1.0 / math.sqrt(curve)
    centre = 0.5 * (first + last) - math.log(left / right) / (2.0 * half * curve)
    height, sigma = 0.0, 0.0
    for _ in range(_ROUNDS):
        if not 0.3 < width <= K[far] or abs(centre - middle) > 2.0 + half:
            return bad
        i = NEAREST[int(32.0 * width + 0.5)]
        pixel = int(math.floor(centre))
        phase = int((centre - pixel) * PHASES + 0.5)
        own = K[i]
        beside = REACH[i]
        base = 0.5 * (mean_of(line, pixel - beside - SIDE) + mean_of(line, pixel + beside + 1))
        n0, n1, n2, n3, n4, b0, b1, b2, rest, used = _flank_sums(
            line, raw, pixel - LEFT, np.float32(base), clip_dn, G[i, phase], X[phase]
        )
        if used < _LEAST_USED:
            return bad
        # The equations [[n0 n1 n2] [n1 n2 n3] [n2 n3 n4]] a = b, by cofactors.
        c00, c01, c02 = n2 * n4 - n3 * n3, n2 * n3 - n1 * n4, n1 * n3 - n2 * n2
        c11, c12, c22 = n0 * n4 - n2 * n2, n1 * n2 - n0 * n3, n0 * n2 - n1 * n1
        det = n0 * c00 + n1 * c01 + n2 * c02
        if not det > 0.0:
            return bad
        a0 = (c00 * b0 + c01 * b1 + c02 * b2) / det
        a1 = (c01 * b0 + c11 * b1 + c12 * b2) / det
        a2 = (c02 * b0 + c12 * b1 + c22 * b2) / det
        square = own * own
        if not a0 > 0.0:
            return bad
        shift = square * a1 / a0
        curve = 1.0 / square - 2.0 * a2 / a0
        if not curve > 0.0 or abs(shift) > own:
            return bad
        centre = pixel + phase / PHASES + shift
        narrower = 1.0 / math.sqrt(curve)
        height = a0
        sigma = noise * square / a0 * math.sqrt(c11 / det)
        rest -= a0 * b0 + a1 * b1 + a2 * b2
        settled = abs(shift) < 0.08 * own and abs(narrower - own) < 0.06 * own
        width = narrower
        if settled:
            free = used - 3
            limit = noise * noise * (free + _ODD * math.sqrt(2.0 * free) + 6.0)
            return rest <= limit, centre, sigma, width, height, base
    return bad


@kernel
def _flank_sums(
    line: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    first: int,
    base: np.float32,
    clip_dn: float,
    g: Singles,
    x: Singles,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Normal equations of a0, a1, a2 over samples that are not clipped; sum of squares; how many."""
    n0 = n1 = n2 = n3 = n4 = b0 = b1 = b2 = rest = used = np.float32(0.0)
    start = np.uintp(first)
    level = np.float32(clip_dn)
    one, none = np.float32(1.0), np.float32(0.0)
    for j in range(SAMPLES):
        at = start + np.uintp(j)
        counts = one if np.float32(raw[at]) < level else none
        value = (np.float32(line[at]) - base) * counts
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
