"""Grey centroid of the stripe above about a third of its height.

The threshold moves with each row's own background and height, so that a glow beside the stripe or a
sloping background does not pull the centre, and a clipped stripe is centred by its flanks. The centroid
as such: Xiao et al. 2015, section 3.2.2; above a threshold, Fisher and Naidu, "A comparison of
algorithms for subpixel peak detection" (1996), where it is the centre of mass.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel
from .rows import (
    BASE,
    CENTRE,
    CUT_FIRST,
    FIRST,
    HEIGHT,
    LAST,
    LEFT,
    RUN_LEVEL,
    SIGMA,
    SUMMIT,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

#: What clipping adds to the deviation, in px: root mean square over simulated stripes of 1 to 6 px that
#: were clipped at a sixth to four fifths of their height.
_CLIPPED = 0.03


def centroid(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the grey centroid of every stripe; arguments as in ``fused.fused``.

    xc = sum(w x) / sum(w) with w = sample - threshold over the stripe's run. First-order noise:
    var = s^2 sum((x - xc)^2) / sum(w)^2. The centre also moves with its place in the pixel, because
    whole samples enter and leave the run: 0.01 + 0.02 / w^2 px for a width of w px, as measured on
    noiseless Gaussian stripes of 1 to 6 px; it is added in quadrature.
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _centroid(*rows, noise)
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _centroid(count: int, samples: Floats, marks: Ints, values: Floats, noise: float) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        threshold = value[BASE] + RUN_LEVEL * value[HEIGHT]
        total = moment = 0.0
        for j in range(mark[FIRST], mark[LAST] + 1):
            weight = line[j] - threshold
            total += weight
            moment += weight * (j - mark[SUMMIT])
        offset = moment / total
        spread = 0.0
        for j in range(mark[FIRST], mark[LAST] + 1):
            spread += (j - mark[SUMMIT] - offset) ** 2
        value[CENTRE] = mark[LEFT] + mark[SUMMIT] + offset
        phase = 0.01 + 0.02 / max(value[WIDTH], 0.5) ** 2
        phase += _CLIPPED if mark[CUT_FIRST] >= 0 else 0.0
        value[SIGMA] = math.hypot(noise * math.sqrt(spread) / total, phase)
