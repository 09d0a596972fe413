"""Noise of a frame's pixels, from the frame itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel, part

#: About this many second differences are looked at: the estimate is then good to 4 %.
_SAMPLES = 1000
_BINS = 1024
#: E[|z| given |z| < q(2/3)] of a normal distribution.
_LOWER_MEAN = 0.4557
#: Rounding to whole DN adds this variance, in DN^2.
ROUNDING = 1.0 / 12.0


@kernel
def noise_dn(frame: npt.NDArray[Any], whole: bool) -> float:
    """As :func:`noise_within`."""
    return noise_within(frame, whole)


@part
def noise_within(frame: npt.NDArray[Any], whole: bool) -> float:
    """Standard deviation of the noise of single pixels in DN, rounding included.

    From second differences along rows spread over the frame (H, W): they ignore any slope, and the mean
    of their lower two thirds ignores stripe and edges. Whole DN make a plain median jump; this mean is
    smooth. ``whole`` says that the frame holds integers: then at least sqrt(1/12) DN.
    """
    height, width = frame.shape
    rounding = ROUNDING if whole else 0.0
    if width < 3:
        return math.sqrt(rounding)
    rows = max(1, min(height, _SAMPLES * 3 // width))
    spread = _lower_mean(frame, rows, 1.0)
    # Bins of one DN are too few for loud 16 bit frames, and too coarse for quiet floating point ones.
    if spread > _BINS / 8 or (not whole and spread < 8.0):
        fine = max(spread, 1.0 if whole else 1e-3) / 32.0
        spread = _lower_mean(frame, rows, fine)
        if not whole and spread < 8.0 * fine:
            spread = _lower_mean(frame, rows, max(spread, 1e-6) / 32.0)
    return max(math.sqrt((spread / _LOWER_MEAN) ** 2 / 6.0 + rounding), math.sqrt(rounding))


@part
def _lower_mean(frame: npt.NDArray[Any], rows: int, bin_dn: float) -> float:
    """Mean of the lower two thirds of |second differences|, from a histogram of ``bin_dn`` steps."""
    height, width = frame.shape
    # Steps of three share no pixel, so that the samples are independent.
    n = width // 3
    counts, places = np.zeros(_BINS, np.int32), np.empty(n, np.int32)
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    per, last = 1.0 / bin_dn, _BINS - 1.0
    for i in range(rows):
        line = frame[(2 * i + 1) * height // (2 * rows)]
        for j in range(n):
            k = three * np.uintp(j)
            bend = float(line[k]) - 2.0 * float(line[k + one]) + float(line[k + two])
            bend = (bend if bend > 0.0 else -bend) * per + 0.5
            places[np.uintp(j)] = np.int32(bend if bend < last else last)
        for j in range(n):
            counts[np.uintp(places[np.uintp(j)])] += 1
    wanted = max(1, 2 * n * rows // 3)
    left, size = wanted, 0.0
    for step in range(_BINS):
        many = min(counts[step], left)
        size += many * step * bin_dn
        left -= many
        if left == 0:
            break
    return size / wanted
