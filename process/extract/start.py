"""Where a fit starts: a row without its impulses, and centre, width, height and background from it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel

Floats = npt.NDArray[np.float64]

#: Samples of the background on either side.
SIDE = 9
_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


@kernel
def goes_on(signal: npt.NDArray[Any], row: int, low: int, high: int, peak: int) -> bool:
    """Whether the stripe goes on in the rows above and below, so that their median shows it as well."""
    height = signal.shape[0]
    if not 0 < row < height - 1:
        return False
    above, here, below = signal[row - 1], signal[row], signal[row + 1]
    tallest, median_tallest = -np.inf, -np.inf
    for j in range(max(low, peak - 2), min(high, peak + 3)):
        a, b, c = float(above[j]), float(here[j]), float(below[j])
        median_tallest = max(median_tallest, max(min(a, b), min(max(a, b), c)))
        left, right = float(here[max(j - 1, low)]), float(here[min(j + 1, high - 1)])
        tallest = max(tallest, max(min(left, b), min(max(left, b), right)))
    floor = np.inf
    for j in range(low, high):
        floor = min(floor, float(here[j]))
    if median_tallest - floor <= 0.8 * (tallest - floor):
        return False
    # Rows on a line have the middle one as their median, but for an impulse or two.
    off = 0
    for j in range(max(low, peak - 4), min(high, peak + 5)):
        a, b, c = float(above[j]), float(here[j]), float(below[j])
        off += abs(max(min(a, b), min(max(a, b), c)) - b) > 0.2 * (tallest - floor)
    return off <= 2


@kernel
def profile_of(
    signal: npt.NDArray[Any],
    row: int,
    low: int,
    high: int,
    along: bool,
) -> Floats:
    """The row's samples of columns [low, high), less single bright and dark ones.

    Where the stripe goes ``along``, each the median with those above and below.
    """
    out = np.empty(high - low, np.float64)
    here = signal[row]
    floor = np.inf
    for j in range(low, high):
        floor = min(floor, float(here[j]))
    above, below = signal[max(row - 1, 0)], signal[min(row + 1, signal.shape[0] - 1)]
    for j in range(low, high):
        b = float(here[j])
        a, c = float(here[max(j - 1, low)]), float(here[min(j + 1, high - 1)])
        # A median along the row would flatten a narrow peak: only what sticks out is cut. Bright ones
        # are left to the median along the stripe, where there is one.
        dark = b < floor + 0.5 * (min(a, c) - floor)
        if dark or (not along and b > 2.0 * max(a, c) - floor):
            b = max(min(a, b), min(max(a, b), c))
        if along:
            a, c = float(above[j]), float(below[j])
            b = max(min(a, b), min(max(a, b), c))
        out[j - low] = b
    return out


@kernel
def start_of(
    profile: Floats, cut: npt.NDArray[np.bool_], low: int, top: int, max_width_px: float
) -> tuple[bool, float, float, float, float]:
    """(ok, centre, width, height, background) from where the profile crosses two of its own levels."""
    n = len(profile)
    base = np.inf
    for j in range(n):
        base = min(base, profile[j])
    height = profile[top] - base
    if not height > 0.0:
        return False, 0.0, 0.0, 0.0, 0.0
    left, right = _crossings(profile, top, base + 0.5 * height)
    # The darkest sample lies below the background by its noise: once more, from the sides of the
    # stripe.
    wide = max(right - left, 2.0)
    total, m = 0.0, 0
    for j in range(n):
        d = abs(j - 0.5 * (left + right))
        if 1.6 * wide <= d <= 1.6 * wide + SIDE:
            total += profile[j]
            m += 1
    if m >= 3:
        base = min(total / m, profile[top] - 0.5 * height)
        height = profile[top] - base
        left, right = _crossings(profile, top, base + 0.5 * height)
    centre, width = 0.5 * (left + right), max((right - left) / _FWHM, 0.5)
    first, last = top, top
    if cut[top]:
        while first > 0 and cut[first - 1]:
            first -= 1
        while last < n - 1 and cut[last + 1]:
            last += 1
        # Two samples of a flank give the width, ln(a / b) = (xb^2 - xa^2) / (2 w^2); both flanks, the
        # mean.
        total, m = 0.0, 0
        for side in (-1, 1):
            at = (first if side < 0 else last) + side
            if not 0 <= at < n or not 0 <= at + side < n:
                continue
            a, b = profile[at] - base, profile[at + side] - base
            xa, xb = at - centre, at + side - centre
            if a > b > 0.05 * height and abs(xb) > abs(xa):
                total += (xb * xb - xa * xa) / (2.0 * math.log(a / b))
                m += 1
        if m > 0:
            width = math.sqrt(total / m)
        half = 0.5 * (last - first + 1)
        height *= math.exp(min(0.5 * (half / width) ** 2, 5.0))
    if width > 1.5 * max_width_px:
        return False, 0.0, 0.0, 0.0, 0.0
    return True, low + centre, width, height, base


@kernel
def _crossings(profile: Floats, top: int, level: float) -> tuple[float, float]:
    """Where the profile falls below ``level`` left and right of ``top``, between samples."""
    n = len(profile)
    j = top
    while j > 0 and profile[j - 1] > level:
        j -= 1
    left = float(j)
    if j > 0:
        left -= (profile[j] - level) / max(profile[j] - profile[j - 1], 1e-9)
    i = top
    while i < n - 1 and profile[i + 1] > level:
        i += 1
    right = float(i)
    if i < n - 1:
        right += (profile[i] - level) / max(profile[i] - profile[i + 1], 1e-9)
    return left, right


@kernel
def background_of(
    profile: Floats, centre: float, width: float, noise: float, height: float
) -> tuple[float, float]:
    """Background at the profile's first sample, and its slope: from the medians of either side."""
    n = len(profile)
    beside = int(math.ceil(3.4 * width)) + 1
    middle = int(round(centre))
    left = profile[max(0, middle - beside - SIDE + 1) : max(0, middle - beside + 1)]
    right = profile[min(n, middle + beside) : min(n, middle + beside + SIDE)]
    if len(left) < 3 and len(right) < 3:
        return np.min(profile), 0.0
    if len(left) < 3:
        return np.median(right), 0.0
    if len(right) < 3:
        return np.median(left), 0.0
    a, b = np.median(left), np.median(right)
    if abs(b - a) < 1.8 * noise:
        return 0.5 * (a + b), 0.0
    if abs(b - a) > 0.3 * height:
        # Something else stands on one side: another stripe, or a bright surface.
        return min(a, b), 0.0
    tilt = (b - a) / (2.0 * beside + SIDE - 1.0)
    return 0.5 * (a + b) - tilt * centre, tilt
