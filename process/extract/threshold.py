"""Threshold: the middle between the two places where the row crosses half of the stripe's height.

One of the common methods (Xiao et al. 2015, section 3.2.2), here with crossings between samples by
linear interpolation, and a threshold that follows each row's own background and height.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel
from .rows import (
    BASE,
    BEGIN,
    CENTRE,
    CUT_FIRST,
    END,
    HALF_FIRST,
    HALF_LAST,
    HEIGHT,
    LEFT,
    SIGMA,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

#: Variance of half the height, in variances of a sample: the brightest sample and the background,
#: which is a median of many.
_LEVEL = 0.26
#: A straight line between two samples misses a Gaussian flank by up to 0.04 / w px, to either side at
#: the two flanks: standard deviation over all places in a pixel, times w.
_PHASE = 0.015
#: What clipping adds to the deviation, in px: root mean square over simulated stripes of 1 to 6 px that
#: were clipped at a sixth to four fifths of their height.
_CLIPPED = 0.015


def threshold(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the midpoint of every stripe; arguments as in ``fused.fused``.

    A stripe that does not fall below half its height on both sides (at a border, or wider than the
    window) has none. The deviation is first-order noise of the four samples about the crossings and
    of the level, and the error of linear interpolation.
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _threshold(*rows, noise)
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _threshold(count: int, samples: Floats, marks: Ints, values: Floats, noise: float) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        low, high = mark[HALF_FIRST], mark[HALF_LAST]
        if low == mark[BEGIN] or high == mark[END] - 1:
            continue
        level = value[BASE] + 0.5 * value[HEIGHT]
        rise, fall = line[low] - line[low - 1], line[high] - line[high + 1]
        a, b = (line[low] - level) / rise, (line[high] - level) / fall
        value[CENTRE] = mark[LEFT] + 0.5 * (low - a + high + b)
        # A crossing a between two samples moves by (1 - a) / rise with the inner, a / rise with the
        # outer.
        variance = ((1.0 - a) ** 2 + a * a) / rise**2 + ((1.0 - b) ** 2 + b * b) / fall**2
        variance += _LEVEL * (1.0 / rise - 1.0 / fall) ** 2
        phase = _PHASE / max(value[WIDTH], 0.5)
        phase += _CLIPPED if mark[CUT_FIRST] >= 0 else 0.0
        value[SIGMA] = math.hypot(0.5 * noise * math.sqrt(variance), phase)
