"""Extreme value: the brightest pixel of the row.

The first of the common methods that Xiao et al. 2015 name in section 3.2.2.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel, part
from .rows import (
    CENTRE,
    CUT_FIRST,
    CUT_LAST,
    FIRST,
    HEIGHT,
    LAST,
    LEFT,
    SIGMA,
    SUMMIT,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

#: See wander_px: up to here one sample stands out, and the pixel is all that is uncertain.
_ONE_SAMPLE = 0.15
#: Variance of a place that is known to the pixel.
_PIXEL = 1.0 / 12.0


def argmax(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the brightest pixel of every stripe; arguments as in ``fused.fused``.

    Of several that are equally bright, and of clipped ones, the middle is taken, so that a clipped
    stripe is not pulled to one side. The deviation is that of a uniform error of one pixel and of the
    wandering of the brightest sample along the flat top.
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _argmax(*rows, noise)
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _argmax(count: int, samples: Floats, marks: Ints, values: Floats, noise: float) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        first, last = mark[CUT_FIRST], mark[CUT_LAST]
        if first < 0:
            top = line[mark[SUMMIT]]
            first = last = mark[SUMMIT]
            for j in range(mark[FIRST], mark[LAST] + 1):
                if line[j] == top:
                    first, last = min(first, j), max(last, j)
        value[CENTRE] = mark[LEFT] + 0.5 * (first + last)
        wander = 0.0
        if mark[CUT_FIRST] < 0:
            wander = wander_px(value[WIDTH], value[HEIGHT], noise, _ONE_SAMPLE)
        value[SIGMA] = math.sqrt(_PIXEL + wander * wander)


@part
def wander_px(width: float, height: float, noise: float, least: float) -> float:
    """Standard deviation of the brightest sample's place about the true summit, less the pixel's own.

    Near its summit a Gaussian stripe is lower by A x^2 / (2 w^2): samples within x = w sqrt(2 s / A)
    differ by less than the noise, and any of them may be the brightest: 0.55 x on simulated stripes,
    and nothing while x^2 is below ``least`` px^2.
    """
    return 0.55 * math.sqrt(max(2.0 * width * width * noise / height - least, 0.0))
