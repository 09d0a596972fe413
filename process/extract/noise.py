"""Noise of a frame's pixels, from the frame itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel

#: About this many second differences are looked at: the estimate is then good to 4 %.
_SAMPLES = 1000
_BINS = 1024
#: E[|z| given |z| < q(2/3)] of a normal distribution.
_LOWER_MEAN = 0.4557
#: Rounding to whole DN adds this variance, in DN^2.
ROUNDING = 1.0 / 12.0


def noise_dn(frame: npt.NDArray[Any]) -> float:
    """Standard deviation of the noise of single pixels in DN, rounding included.

    From second differences along rows spread over the frame (H, W): they ignore any slope, and the mean
    of their lower two thirds ignores stripe and edges. Whole DN make a plain median jump; this mean is
    smooth. At least sqrt(1/12) DN for integer frames.
    """
    height, width = frame.shape
    integer = frame.dtype.kind != "f"
    least = math.sqrt(ROUNDING) if integer else 0.0
    if width < 3:
        return least
    rows = max(1, min(height, _SAMPLES * 3 // width))
    spread = float(_lower_mean(frame, rows, 1.0))
    # Bins of one DN are too few for loud 16 bit frames, and too coarse for quiet floating point ones.
    if spread > _BINS / 8 or (not integer and spread < 8.0):
        fine = max(spread, 1e-3 if not integer else 1.0) / 32.0
        spread = float(_lower_mean(frame, rows, fine))
        if not integer and spread < 8.0 * fine:
            spread = float(_lower_mean(frame, rows, max(spread, 1e-6) / 32.0))
    return float(
        max(math.sqrt((spread / _LOWER_MEAN) ** 2 / 6.0 + (ROUNDING if integer else 0.0)), least)
    )


@kernel
def _lower_mean(frame: npt.NDArray[Any], rows: int, bin_dn: float) -> float:
    """Mean of the lower two thirds of |second differences|, from a histogram of ``bin_dn`` steps."""
    height, width = frame.shape
    counts = np.zeros(_BINS, np.int64)
    total = 0
    for i in range(rows):
        r = (2 * i + 1) * height // (2 * rows)
        # Steps of three share no pixel, so that the samples are independent.
        for j in range(0, width - 2, 3):
            bend = float(frame[r, j]) - 2.0 * float(frame[r, j + 1]) + float(frame[r, j + 2])
            at = int(abs(bend) / bin_dn + 0.5)
            counts[min(at, _BINS - 1)] += 1
            total += 1
    wanted = max(1, 2 * total // 3)
    left, size = wanted, 0.0
    for k in range(_BINS):
        n = min(counts[k], left)
        size += n * k * bin_dn
        left -= n
        if left == 0:
            break
    return size / wanted
