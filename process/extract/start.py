"""Where a fit starts: a row without its impulses, and centre, width, height and background from it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ..compiled import inlined, part

Floats = npt.NDArray[np.float64]

#: Samples of the background on either side.
SIDE = 9
_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


@part
def goes_on(above: Floats, here: Floats, below: Floats, top: int) -> bool:
    """Whether the stripe at ``top`` goes on in the rows above and below: their median shows it."""
    n = len(here)
    tallest, median_tallest = -np.inf, -np.inf
    for j in range(max(0, top - 2), min(n, top + 3)):
        b = here[j]
        median_tallest = max(median_tallest, _middle(above[j], b, below[j]))
        tallest = max(tallest, _middle(here[max(j - 1, 0)], b, here[min(j + 1, n - 1)]))
    floor = least_of(here)
    if median_tallest - floor <= 0.8 * (tallest - floor):
        return False
    # Rows on a line have the middle one as their median, but for an impulse or two.
    off = 0
    for j in range(max(0, top - 4), min(n, top + 5)):
        off += abs(_middle(above[j], here[j], below[j]) - here[j]) > 0.2 * (tallest - floor)
    return off <= 2


@inlined
def _middle(a: float, b: float, c: float) -> float:
    """Median of three."""
    low, high = a if a < b else b, b if a < b else a
    high = high if high < c else c
    return low if low > high else high


@part
def least_of(line: Floats) -> float:
    """The darkest sample."""
    least = line[np.uintp(0)]
    for j in range(len(line)):
        value = line[np.uintp(j)]
        least = value if value < least else least
    return least


@part
def profile_of(above: Floats, here: Floats, below: Floats, along: bool, out: Floats) -> None:
    """Fill ``out`` with the row's samples, less single bright and dark ones.

    Where the stripe goes ``along``, each is the median with those above and below.
    """
    last, one = len(here) - 1, np.uintp(1)
    floor = least_of(here)
    # A median along the row would flatten a narrow peak: only what sticks out is cut. Bright ones are
    # left to the median along the stripe, where there is one.
    out[0], out[last] = here[0], here[last]
    for i in range(1, last):
        j = np.uintp(i)
        a, b, c = here[j - one], here[j], here[j + one]
        low, high = a if a < c else c, c if a < c else a
        inside = b if b > low else low
        inside = inside if inside < high else high
        bright = not along and b > 2.0 * high - floor
        out[j] = inside if b < floor + 0.5 * (low - floor) or bright else b
    if along:
        for i in range(last + 1):
            j = np.uintp(i)
            out[j] = _middle(above[j], out[j], below[j])


@part
def start_of(
    profile: Floats, cut: npt.NDArray[np.bool_], top: int, max_width: float
) -> tuple[bool, float, float, float, float]:
    """(ok, centre, width, height, background) from where the profile crosses two of its own levels."""
    n = len(profile)
    base = least_of(profile)
    height = profile[top] - base
    if not height > 0.0:
        return False, 0.0, 0.0, 0.0, 0.0
    left, right = _crossings(profile, top, base + 0.5 * height)
    # The darkest sample lies below the background by its noise: once more, from the sides of the
    # stripe.
    wide = max(right - left, 2.0)
    middle, total, m = 0.5 * (left + right), 0.0, 0
    for j in range(max(0, math.ceil(middle - 1.6 * wide - SIDE)), int(middle - 1.6 * wide) + 1):
        total += profile[j]
        m += 1
    for j in range(math.ceil(middle + 1.6 * wide), min(n, int(middle + 1.6 * wide + SIDE) + 1)):
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
    if width > 1.5 * max_width:
        return False, 0.0, 0.0, 0.0, 0.0
    return True, centre, width, height, base


@part
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


@part
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
        return least_of(profile), 0.0
    if len(left) < 3:
        return _median(right), 0.0
    if len(right) < 3:
        return _median(left), 0.0
    a, b = _median(left), _median(right)
    if abs(b - a) < 1.8 * noise:
        return 0.5 * (a + b), 0.0
    if abs(b - a) > 0.3 * height:
        # Something else stands on one side: another stripe, or a bright surface.
        return min(a, b), 0.0
    tilt = (b - a) / (2.0 * beside + SIDE - 1.0)
    return 0.5 * (a + b) - tilt * centre, tilt


@part
def _median(few: Floats) -> float:
    """Median of up to ``SIDE`` samples: each by how many lie below it."""
    n = len(few)
    low = high = 0.0
    for i in range(n):
        value, below = few[i], 0
        for j in range(n):
            below += few[j] < value or (few[j] == value and j < i)
        low = value if below == (n - 1) // 2 else low
        high = value if below == n // 2 else high
    return 0.5 * (low + high)
