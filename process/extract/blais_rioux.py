"""Zero crossing of a finite-impulse derivative.

F. Blais and M. Rioux, "Real-time numerical peak detector", Signal Processing 11 (1986) 145-155: with
g(i) = f(i - m) + ... + f(i - 1) - f(i + 1) - ... - f(i + m) the peak lies where g crosses zero, by
linear interpolation between the two samples about it. m = 2 is their fourth order, m = 4 the eighth.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel, part
from .rows import (
    BEGIN,
    CENTRE,
    CUT_FIRST,
    END,
    LEFT,
    SIGMA,
    SUMMIT,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

#: From this width on, in px, the eighth order is the more exact one: in multiples of the bound 1.07
#: and 1.46 at w = 1, 1.27 and 1.04 at w = 2.
_WIDE = 1.3
#: The derivative is no straight line between two samples: standard deviation over all places in a
#: pixel, times w^1.5, as measured on noiseless Gaussian stripes.
_PHASE = 0.013
#: What clipping adds to the deviation, in px: root mean square over simulated stripes of 1 to 6 px that
#: were clipped at a sixth to four fifths of their height.
_CLIPPED = 0.05
#: Deviation of the middle of a plateau, whose ends are known to the pixel.
_PLATEAU = math.sqrt(1.0 / 12.0)


def blais_rioux(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the zero crossing of every stripe; arguments as in ``fused.fused``.

    The order follows the width of each row's stripe. A stripe that has no crossing in its run, or one
    too near the border for the filter, has no centre. The deviation is first-order noise of the
    filter's samples, and the error of linear interpolation.
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _blais_rioux(*rows, noise)
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _blais_rioux(count: int, samples: Floats, marks: Ints, values: Floats, noise: float) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        m = 4 if value[WIDTH] >= _WIDE else 2
        low, high = mark[BEGIN] + m, mark[END] - 1 - m
        a = b = mark[SUMMIT]
        if not low <= a <= high:
            continue
        # g is negative left of the summit and positive right of it; where it is zero it stays so on
        # plateaus.
        below = above = _slope(line, a, m)
        while below >= 0.0 and a > low:
            a -= 1
            before = _slope(line, a, m)
            if below > 0.0:
                b, above = a + 1, below
            below = before
        while above <= 0.0 and b < high:
            b += 1
            after = _slope(line, b, m)
            if above < 0.0:
                a, below = b - 1, above
            above = after
        if not (below < 0.0 < above):
            continue
        part = below / (below - above)
        value[CENTRE] = mark[LEFT] + a + part * (b - a)
        if b - a > 2:
            # g vanishes all along a plateau, and what it is beyond says little of the middle.
            value[CENTRE], value[SIGMA] = mark[LEFT] + 0.5 * (a + b), _PLATEAU
            continue
        # Neighbouring values of g share 2 (m - 1) samples of equal sign.
        gain = 2.0 * m * ((1.0 - part) ** 2 + part * part)
        if b - a == 1:
            gain += 4.0 * (m - 1) * part * (1.0 - part)
        spread = noise * math.sqrt(gain) * (b - a) / (above - below)
        phase = _PHASE / max(value[WIDTH], 1.0) ** 1.5
        phase += _CLIPPED if mark[CUT_FIRST] >= 0 else 0.0
        value[SIGMA] = math.hypot(spread, phase)


@part
def _slope(line: Floats, at: int, m: int) -> float:
    total = 0.0
    for k in range(1, m + 1):
        total += line[at - k] - line[at + k]
    return total
