"""Parabola through the three samples about the peak.

R. B. Fisher and D. K. Naidu, "A comparison of algorithms for subpixel peak detection" (1996): with
the samples l, c, r the vertex lies (l - r) / (2 (l - 2 c + r)) beside the middle one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel
from .argmax import wander_px
from .rows import (
    BEGIN,
    CENTRE,
    CUT_FIRST,
    CUT_LAST,
    END,
    HEIGHT,
    LEFT,
    SIGMA,
    SUMMIT,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

#: See wander_px: up to here the three samples' own noise says it all.
_THREE_SAMPLES = 0.5
#: Deviation of the middle of a plateau, whose ends are known to the pixel.
_PLATEAU = math.sqrt(1.0 / 12.0)
#: A Gaussian is no parabola: what that moves the vertex, as a standard deviation over all places in
#: a pixel, times w^2.
_PHASE = 0.035


def parabola(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the vertex of every stripe; arguments as in ``fused.fused``.

    Of a plateau (clipped, or three and more equal samples) the middle is taken: a parabola through
    its ends and the samples beside it misses by half a pixel. A stripe whose brightest sample lies at
    the border has no centre. The deviation is first-order noise of the three samples, the wandering
    of the brightest sample on a wide stripe, and the parabola's own error.
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _parabola(*rows, noise)
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _parabola(count: int, samples: Floats, marks: Ints, values: Floats, noise: float) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        top = line[mark[SUMMIT]]
        first = last = mark[SUMMIT]
        clipped = mark[CUT_FIRST] >= 0
        if clipped:
            first, last = mark[CUT_FIRST], mark[CUT_LAST]
        else:
            while first > mark[BEGIN] and line[first - 1] == top:
                first -= 1
            while last < mark[END] - 1 and line[last + 1] == top:
                last += 1
            if last - first < 2:
                last = first
        if first == mark[BEGIN] or last == mark[END] - 1:
            continue
        if clipped or last > first:
            value[CENTRE] = mark[LEFT] + 0.5 * (first + last)
            value[SIGMA] = _PLATEAU
            continue
        left, right = line[first - 1], line[first + 1]
        bend = left - 2.0 * top + right
        if not bend < 0.0:
            continue
        part = 0.5 * (left - right) / bend
        value[CENTRE] = mark[LEFT] + first + part
        # By l: (1 - 2 p) / (2 bend), by r: (-1 - 2 p) / (2 bend), by c: 4 p / (2 bend).
        wander = wander_px(value[WIDTH], value[HEIGHT], noise, _THREE_SAMPLES)
        variance = (0.5 * noise / bend) ** 2 * (2.0 + 24.0 * part * part)
        phase = _PHASE / max(value[WIDTH], 0.5) ** 2
        value[SIGMA] = math.sqrt(variance + wander * wander + phase * phase)
