"""Plain Gaussian fit: a parabola through the logarithms of the stripe's samples, each counting alike.

R. A. Caruana et al., "Fast algorithm for the resolution of spectra", Analytical Chemistry 58 (1986)
1162-1167. The logarithm makes the noise of faint samples large, and they count as much as bright
ones: two times the bound and more.
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
    LEFT,
    SIGMA,
    SUMMIT,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)
from .varied_boundary import log_parabola

#: What clipping adds to the deviation, in px: root mean square over simulated stripes of 1 to 6 px that
#: were clipped at a sixth to four fifths of their height.
_CLIPPED = 0.15


def gaussian(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the fitted centre of every stripe; arguments as in ``fused.fused``.

    Fitted are the samples about the peak that are more than base_dn above the local background, less
    this background. With fewer than three of them, or where the parabola does not open downwards with
    its vertex among them, there is no centre. Clipped samples count like the others, hence a clipped
    stripe looks wider than it is.
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _gaussian(*rows, noise, limits[2])
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _gaussian(
    count: int, samples: Floats, marks: Ints, values: Floats, noise: float, base_dn: float
) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        level = value[BASE] + base_dn
        first = last = mark[SUMMIT]
        while first > mark[BEGIN] and line[first - 1] > level:
            first -= 1
        while last < mark[END] - 1 and line[last + 1] > level:
            last += 1
        good, offset, sigma, width = log_parabola(
            line, first, last, level, value[BASE], mark[SUMMIT], noise
        )
        if good:
            value[CENTRE] = mark[LEFT] + mark[SUMMIT] + offset
            if mark[CUT_FIRST] >= 0:
                sigma = math.hypot(sigma, _CLIPPED)
            value[SIGMA], value[WIDTH] = sigma, width
