"""Stripes too wide for the windows: the means of 2, 4 or 8 neighbouring samples, which the windows fit.

Of a Gaussian several samples wide the means of neighbours are a Gaussian again, and say no less.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import part
from .clipped import BAD, Fit, masked_fit, stands_out
from .window import SIDE, K

Singles = npt.NDArray[np.float32]

_MOST_POOLED = 8
#: Pooled samples on either side of the peak: enough for the widest window and the background beside it.
_BESIDE = 36
#: Narrower than this, in pooled samples, a stripe is none of those that are meant here.
_NARROW = 1.5
#: Width at half height of a Gaussian, in standard deviations.
_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


@part
def wide_row(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    from_px: int,
    to_px: int,
    clip_dn: float,
) -> Fit:
    """As :func:`turnscan.process.extract.clipped.clipped_row`, of a wide stripe that is not clipped.

    Not good as well where one of the samples stands out from the fit.
    """
    # One row of a frame of its own, as the fit takes them.
    n = 2 * _BESIDE + 1
    samples, tops = np.empty((1, n), np.float32), np.empty((1, n), np.float32)
    pool = 2
    while pool <= _MOST_POOLED:
        left = peak - pool // 2 - _BESIDE * pool
        if left < from_px or left + n * pool > to_px:
            return BAD
        _pool(signal, raw, row, left, pool, samples, tops)
        good, centre, width, height, base, rest, lever = _fit(samples, tops, clip_dn)
        if good:
            if width < _NARROW or stands_out(samples, tops, 0, centre, width, base, clip_dn):
                return BAD
            # The mean of neighbours is a wider and lower Gaussian than what it is taken of.
            own = math.sqrt(width * width - (1.0 - 1.0 / (pool * pool)) / 12.0)
            centre = left + 0.5 * (pool - 1) + pool * centre
            return (
                True, centre, pool * own, height * width / own, base, pool * rest,
                lever * math.sqrt(pool),
            )  # fmt: skip
        if not width > K[-1]:
            return BAD
        pool *= 2
    return BAD


@part
def _pool(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    left: int,
    pool: int,
    samples: Singles,
    tops: Singles,
) -> None:
    """Means of ``pool`` samples each, from column ``left`` on, and the brightest of the raw ones."""
    share, line = np.float32(1.0 / pool), np.uintp(row)
    for i in range(samples.shape[1]):
        start = np.uintp(left + i * pool)
        total, top = np.float32(0.0), np.float32(raw[line, start])
        for j in range(pool):
            total += np.float32(signal[line, start + np.uintp(j)])
            value = np.float32(raw[line, start + np.uintp(j)])
            top = value if value > top else top
        samples[0, i], tops[0, i] = total * share, top


@part
def _fit(samples: Singles, tops: Singles, clip_dn: float) -> Fit:
    """The fit to pooled samples about their middle one; if not good, its width is a guess."""
    n = samples.shape[1]
    left = right = 0.0
    for j in range(SIDE):
        left += float(samples[0, j]) / SIDE
        right += float(samples[0, n - 1 - j]) / SIDE
    base = 0.5 * (left + right)
    level = base + 0.5 * (float(samples[0, _BESIDE]) - base)
    first = last = _BESIDE
    while first > 0 and samples[0, first - 1] > level:
        first -= 1
    while last < n - 1 and samples[0, last + 1] > level:
        last += 1
    width = (last - first + 1.0) / _FWHM
    none = (False, 0.0, width, 0.0, 0.0, 0.0, 0.0)
    if not _NARROW < width <= K[-1]:
        return none
    for j in range(first, last + 1):
        if tops[0, j] >= clip_dn:
            # A mean that holds a part of a plateau's edge is lost, and with it what tells most.
            return BAD
    return masked_fit(samples, tops, 0, 0.5 * (first + last), width, 2.0 * width, 0, n, clip_dn)
