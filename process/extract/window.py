"""Moments of a row under a Gaussian window: one step to the centre, width and height of a stripe.

A Gaussian stripe times a Gaussian window is a Gaussian again, so that the mean r and variance v of
their product give the stripe's centre and width in closed form, whatever the window's own centre c and
width k (standard deviations, px): with q = v / k^2,

    u = c + r / (1 - q),    w = k sqrt(q / (1 - q)).

With k = w and c = u this is the matched filter of the stripe's derivative, hence as exact as a
least-squares fit: it reaches the Cramer-Rao bound. Tables hold the windows for steps of width and
phase.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from ..compiled import inlined, part

Singles = npt.NDArray[np.float32]

#: Samples of a window, and how many of them lie left of the centre's own pixel.
SAMPLES: Final = 32
LEFT: Final = 15
#: Steps of the window's centre in a pixel.
PHASES: Final = 16
#: Narrowest and widest window, and the ratio of neighbours. Narrower ones are so undersampled that the
#: closed form would move with the phase (0.0006 px at 1.0); wider ones do not fit 32 samples.
_NARROWEST, _WIDEST, _RATIO = 1.0, 5.2, 1.05
#: The background is the mean of this many samples on either side.
SIDE: Final = 8


class Tables(NamedTuple):
    """Windows ``g`` (width, phase, sample), sample places ``x`` (phase, sample), and more.

    ``k`` is its value, ``reach`` the first sample of the background, counted from the centre's pixel;
    ``nearest`` gives the index of the width nearest to n / 32 px.
    """

    g: Singles
    x: Singles
    k: npt.NDArray[np.float64]
    reach: npt.NDArray[np.int64]
    nearest: npt.NDArray[np.int64]


def _tables() -> Tables:
    steps = math.ceil(math.log(_WIDEST / _NARROWEST) / math.log(_RATIO)) + 1
    k = _NARROWEST * _RATIO ** np.arange(steps)
    phase = np.arange(PHASES + 1) / PHASES
    x = (np.arange(SAMPLES) - LEFT)[None, :] - phase[:, None]
    g = np.exp(-0.5 * (x[None] / k[:, None, None]) ** 2)
    # Far tails would be subnormal numbers, which processors multiply ten times slower.
    g[g < 1e-15] = 0.0
    grid = np.arange(int(32 * k[-1] * 1.2) + 1) / 32.0
    nearest = np.abs(np.log(np.maximum(grid, 0.1))[:, None] - np.log(k)[None, :]).argmin(axis=1)
    reach = np.ceil(3.6 * k).astype(np.int64) + 1
    widths = np.asarray(k, np.float64)
    return Tables(g.astype(np.float32), x.astype(np.float32), widths, reach, nearest)


#: Constants of the compiled kernels.
G, X, K, REACH, NEAREST = _tables()


@inlined
def sums_of(
    signal: npt.NDArray[Any], row: int, first: int, base: np.float32, g: Singles, x: Singles
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Sums of g v, g v x, g v x^2 and v^2 over a window, v being the samples above ``base``."""
    # Both indices unsigned, and no view of the row: that alone takes longer than the sums.
    s0 = s1 = s2 = s3 = np.float32(0.0)
    line, start = np.uintp(row), np.uintp(first)
    for j in range(SAMPLES):
        value = np.float32(signal[line, start + np.uintp(j)]) - base
        at = x[j]
        weighted = g[j] * value
        moved = weighted * at
        s0 += weighted
        s1 += moved
        s2 += moved * at
        s3 += value * value
    return s0, s1, s2, s3


@part
def lever_of(signal: npt.NDArray[Any], row: int, first: int, base: np.float32, x: Singles) -> float:
    """Sum of v x over a window: what a slope of the background adds to the sum of squares."""
    total = 0.0
    for j in range(SAMPLES):
        total += (float(signal[row, first + j]) - float(base)) * float(x[j])
    return total


@inlined
def mean_of(signal: npt.NDArray[Any], row: int, first: int) -> np.float32:
    """Mean of the ``SIDE`` samples from ``first`` on."""
    line, start = np.uintp(row), np.uintp(first)
    # Zero of the samples' own kind: whole numbers are added as such, which is four times as fast.
    total = 0 * signal[line, start]
    for j in range(SIDE):
        total += signal[line, start + np.uintp(j)]
    return np.float32(total) * np.float32(1.0 / SIDE)


@inlined
def top_of(signal: npt.NDArray[Any], row: int, first: int) -> float:
    """Brightest sample of a window."""
    line, start = np.uintp(row), np.uintp(first)
    top = signal[line, start]
    for j in range(SAMPLES):
        value = signal[line, start + np.uintp(j)]
        top = value if value > top else top
    return float(top)
