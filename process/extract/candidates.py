"""Candidates of every row: what rises above its surroundings on both sides, hence may be the stripe.

They are looked for in the median of each pixel and its four neighbours, which hot pixels do not
reach, and which narrow, steep and ending stripes all pass.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel, part

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Most candidates of a row; of more, the brightest.
MOST = 16
#: Share of its height that a stripe must fall on both sides before another may begin.
_DIP = 0.4
#: Samples of the background on either side.
_SIDE = 8
#: Samples that are passed over together while nothing rises.
_CHUNK = 32


@kernel
def candidates(
    signal: npt.NDArray[Any], from_px: int, to_px: int, base_dn: float
) -> tuple[Ints, Ints, Floats]:
    """How many candidates each row has (H,), their places (H, 16), ordered by u, and their heights."""
    height = signal.shape[0]
    count = np.zeros(height, np.int64)
    place, tall = np.zeros((height, MOST), np.int64), np.zeros((height, MOST), np.float64)
    profile = np.empty(to_px - from_px, signal.dtype)
    for row in range(height):
        _cross_median(signal, row, from_px, profile)
        n = len(profile)
        # Rise from a valley, summit, fall: a candidate when both are high enough.
        valley = top = float(profile[0])
        summit, end, rising = 0, 0, False
        j = -1
        while j < n - 1:
            j += 1
            if not rising and j % _CHUNK == 0 and j + _CHUNK <= n:
                low, high = _range_of(profile, j)
                if high - min(low, valley) <= 0.5 * base_dn:
                    valley = min(low, valley)
                    j += _CHUNK - 1
                    continue
            value = float(profile[j])
            if not rising:
                valley = value if value < valley else valley
                if value - valley > 0.5 * base_dn:
                    rising, top, summit, end = True, value, j, j
                continue
            if value > top:
                top, summit, end = value, j, j
            elif value == top and end == j - 1:
                end = j
            fallen = top - value > max(0.5 * base_dn, _DIP * (top - valley))
            if fallen or j == n - 1:
                at = (summit + end) // 2
                high = _height(signal[row], profile, at, from_px, base_dn)
                if high > base_dn:
                    _keep(count, place[row], tall[row], row, from_px + at, high)
                rising, valley = False, value
    return count, place, tall


@part
def _range_of(profile: npt.NDArray[Any], first: int) -> tuple[float, float]:
    """Darkest and brightest of the samples of one chunk."""
    start = np.uintp(first)
    low = high = profile[start]
    for j in range(_CHUNK):
        value = profile[start + np.uintp(j)]
        low = value if value < low else low
        high = value if value > high else high
    return float(low), float(high)


@part
def _cross_median(signal: npt.NDArray[Any], row: int, from_px: int, profile: npt.NDArray[Any]) -> None:
    """Median of each pixel and its four neighbours; at a border the pixel stands in for the missing."""
    last = signal.shape[0] - 1
    # At the first and last row the only vertical neighbour counts twice, or a stripe would have none.
    up, here = signal[row - 1 if row > 0 else min(1, last)], signal[row]
    down = signal[row + 1 if row < last else max(last - 1, 0)]
    n = len(profile)
    one = np.uintp(1)
    for j in range(1, n - 1):
        k = np.uintp(from_px + j)
        profile[np.uintp(j)] = _median_of(here[k], up[k], down[k], here[k - one], here[k + one])
    for end in (0, n - 1):
        at = from_px + end
        left, right = here[max(at - 1, from_px)], here[min(at + 1, from_px + n - 1)]
        profile[end] = _median_of(here[at], up[at], down[at], left, right)


@part
def _median_of(middle: Any, up: Any, down: Any, left: Any, right: Any) -> Any:
    """Median of five: the greater of two pairs' lesser, the lesser of their greater, and the fifth."""
    a, b = up if up < down else down, down if up < down else up
    c, d = left if left < right else right, right if left < right else left
    low, high = a if a > c else c, b if b < d else d
    low, high = low if low < high else high, high if low < high else low
    middle = middle if middle > low else low
    return middle if middle < high else high


@part
def _height(
    line: npt.NDArray[Any], profile: npt.NDArray[Any], at: int, from_px: int, base_dn: float
) -> float:
    """Height of the stripe at ``at`` of the profile above the darker of its two sides."""
    n = len(profile)
    top = float(profile[at])
    least = np.inf
    for j in range(max(0, at - 4 * _SIDE), min(n, at + 4 * _SIDE + 1)):
        least = min(least, float(profile[j]))
    level = least + 0.3 * (top - least)
    low = high = at
    while low > 0 and float(profile[low - 1]) > level:
        low -= 1
    while high < n - 1 and float(profile[high + 1]) > level:
        high += 1
    beside = np.inf
    for first in (low - 2 - _SIDE, high + 3):
        if first >= 0 and first + _SIDE <= n:
            total = 0.0
            for j in range(first, first + _SIDE):
                total += float(profile[j])
            beside = min(beside, total / _SIDE)
    if math.isinf(beside):
        beside = least
    best = float(line[from_px + at])
    # The median of a narrow or steep stripe is lower than the stripe, and may lie beside its summit.
    for j in range(max(0, at - 1), min(n, at + 2)):
        if float(profile[j]) - beside > 0.5 * base_dn:
            best = max(best, float(line[from_px + j]))
    return best - beside


@part
def _keep(count: Ints, place: Ints, tall: Floats, row: int, at: int, high: float) -> None:
    """Add a candidate to its row; if the row is full, in place of the faintest."""
    n = count[row]
    if n == MOST:
        least = np.argmin(tall)
        if tall[least] >= high:
            return
        for i in range(least, MOST - 1):
            place[i], tall[i] = place[i + 1], tall[i + 1]
        n -= 1
    place[n], tall[n] = at, high
    count[row] = n + 1
