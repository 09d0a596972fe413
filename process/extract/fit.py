"""Least-squares fit of one row, sample by sample: for rows that are clipped, struck, cut or very wide.

The model is a Gaussian on a straight background. Clipped samples say nothing and are left out: the flanks
give the centre. A median of three rows, along the stripe, only starts the fit and tells outliers; the
fit itself takes the row's own samples, so that nothing is smoothed across a depth edge.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import kernel

Floats = npt.NDArray[np.float64]

_SATURATED, _EDGE, _GATED = int(Flag.SATURATED), int(Flag.EDGE), int(Flag.GATED)
#: Samples of the background on either side.
_SIDE = 9
_STEPS = 12
#: Samples farther off the model than this many standard deviations are left out.
_GATE = 4.5
_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))
#: Narrowest stripe that is one, as a standard deviation: less is a single pixel.
_NARROWEST = 0.3

_Row = tuple[bool, float, float, float, float, float, int]


@kernel
def fit_row(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    span: tuple[int, int],
    base_dn: float,
    max_width_px: float,
    noise: float,
    clip_dn: float,
) -> _Row:
    """(good, centre, its deviation, width, height, background, flags) of the stripe near ``peak``.

    ``span`` is the half-open range of columns that may be used. ``good`` is False where no stripe can be
    fitted: too few samples, too faint, centre away from the peak or not better known than the
    stripe is wide.
    """
    from_px, to_px = span
    bad = (False, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    reach = int(math.ceil(2.0 * max_width_px)) + _SIDE
    low, high = max(from_px, peak - reach), min(to_px, peak + reach + 1)
    profile = _profile(signal, row, low, high, peak)
    samples, cut = np.empty(high - low, np.float64), np.empty(high - low, np.bool_)
    for j in range(high - low):
        samples[j] = float(signal[row, low + j])
        cut[j] = float(raw[row, low + j]) >= clip_dn
    top = peak - low
    for j in range(max(0, top - 2), min(len(profile), top + 3)):
        if profile[j] > profile[top]:
            top = j
    ok, centre, width, height, base = _start(profile, cut, low, top, max_width_px)
    if not ok or height < 0.5 * base_dn:
        return bad
    base, tilt = _background(profile, centre - low, width, noise, height)
    half = 3.5 * width + 4.0
    first = max(low, int(math.floor(centre - half)))
    stop = min(high, int(math.ceil(centre + half)) + 1)
    rests = np.empty(stop - first, np.float64)
    sigma, flags = 0.0, 0
    # First the profile, in which hardly an outlier is left, then the samples themselves.
    for stage in range(2):
        for step in range(_STEPS):
            gate = np.inf
            if stage == 1:
                model = (centre - low, width, height, base, tilt)
                gate = _GATE * max(noise, _scatter(samples, cut, first - low, model, rests))
            height, moved, width, sigma, flags = _improve(
                samples if stage == 1 else profile,
                cut,
                first - low,
                stop - low,
                (centre - low, width, height, base, tilt),
                noise,
                gate,
            )
            if flags < 0 or not (_NARROWEST <= width <= max_width_px):
                return bad
            centre += moved
            if not low - 0.5 <= centre <= high - 0.5:
                return bad
            if abs(moved) < 0.01 * sigma + 1e-4 and step >= stage:
                break
    if abs(centre - peak) > 2.5 + 1.5 * width and not flags & _SATURATED:
        return bad
    if height < base_dn or not sigma < max(0.5 * width, 0.5):
        return bad
    if centre - 2.5 * width < from_px or centre + 2.5 * width > to_px - 1:
        flags |= _EDGE
    return True, centre, sigma, width, height, base + tilt * (centre - low), flags


@kernel
def _scatter(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    first: int,
    model: tuple[float, float, float, float, float],
    rests: Floats,
) -> float:
    """Robust deviation of the samples from the model: 1.48 times their median distance."""
    centre, width, height, base, tilt = model
    n = 0
    for j in range(first, first + len(rests)):
        if not cut[j]:
            t = (j - centre) / width
            rests[n] = abs(samples[j] - base - tilt * j - height * math.exp(-0.5 * t * t))
            n += 1
    if n < 3:
        return np.inf
    return 1.4826 * np.sort(rests[:n])[n // 2]


@kernel
def _profile(signal: npt.NDArray[Any], row: int, low: int, high: int, peak: int) -> Floats:
    """The row's samples of columns [low, high), each the median of three rows where the stripe goes on.

    Where it does not (it ends, jumps, or is steep) the samples themselves, less single bright ones.
    """
    height = signal.shape[0]
    out = np.empty(high - low, np.float64)
    above, here, below = signal[max(row - 1, 0)], signal[row], signal[min(row + 1, height - 1)]
    tallest, median_tallest = -np.inf, -np.inf
    for j in range(max(low, peak - 2), min(high, peak + 3)):
        a, b, c = float(above[j]), float(here[j]), float(below[j])
        median_tallest = max(median_tallest, max(min(a, b), min(max(a, b), c)))
        left, right = float(here[max(j - 1, low)]), float(here[min(j + 1, high - 1)])
        tallest = max(tallest, max(min(left, b), min(max(left, b), right)))
    floor = np.inf
    for j in range(low, high):
        floor = min(floor, float(here[j]))
    along = 0 < row < height - 1 and median_tallest - floor > 0.8 * (tallest - floor)
    for j in range(low, high):
        b = float(here[j])
        if along:
            a, c = float(above[j]), float(below[j])
        else:
            a, c = float(here[max(j - 1, low)]), float(here[min(j + 1, high - 1)])
            # A median along the row would flatten a narrow peak: only what sticks out is cut.
            if b <= 2.0 * max(a, c) - floor:
                out[j - low] = b
                continue
        out[j - low] = max(min(a, b), min(max(a, b), c))
    return out


@kernel
def _start(
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
    # The darkest sample lies below the background by its noise: once more, from the sides of the stripe.
    wide = max(right - left, 2.0)
    total, m = 0.0, 0
    for j in range(n):
        d = abs(j - 0.5 * (left + right))
        if 1.6 * wide <= d <= 1.6 * wide + _SIDE:
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
        # Two samples of a flank give the width, ln(a / b) = (xb^2 - xa^2) / (2 w^2); both flanks, the mean.
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
def _background(
    profile: Floats, centre: float, width: float, noise: float, height: float
) -> tuple[float, float]:
    """Background at the profile's first sample, and its slope: from the medians of either side."""
    n = len(profile)
    beside = int(math.ceil(3.4 * width)) + 1
    middle = int(round(centre))
    left = profile[max(0, middle - beside - _SIDE + 1) : max(0, middle - beside + 1)]
    right = profile[min(n, middle + beside) : min(n, middle + beside + _SIDE)]
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
    tilt = (b - a) / (2.0 * beside + _SIDE - 1.0)
    return 0.5 * (a + b) - tilt * centre, tilt


@kernel
def _improve(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    first: int,
    stop: int,
    start: tuple[float, float, float, float, float],
    noise: float,
    gate: float,
) -> tuple[float, float, float, float, int]:
    """One Gauss-Newton step: (height, shift of the centre, width, deviation of the centre, flags or -1).

    Unknowns are height, centre and width; ``start`` is (centre, width, height, background at sample 0,
    its slope), whose background stands. Samples farther off than ``gate`` and clipped ones are left out.
    """
    centre, width, height, base, tilt = start
    flags = 0
    n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = squares = 0.0
    used, lefts, rights = 0, 0, 0
    inverse = 1.0 / width
    # exp(-t^2 / 2) at equal steps by two products a sample.
    t = (first - centre) * inverse
    value = math.exp(-0.5 * t * t)
    ratio = math.exp(-inverse * (t + 0.5 * inverse))
    change = math.exp(-inverse * inverse)
    near = 3.0 * width
    for j in range(first, stop):
        x = j - centre
        model = height * value
        rest = samples[j] - base - tilt * j - model
        t = x * inverse
        slope0, slope1, slope2 = value, model * t * inverse, model * t * t * inverse
        value *= ratio
        ratio *= change
        if cut[j]:
            if abs(x) < near:
                flags |= _SATURATED
            continue
        if abs(rest) > gate:
            if abs(x) < near:
                flags |= _GATED
            continue
        used += 1
        if abs(t) < 3.5:
            if x < 0.0:
                lefts += 1
            else:
                rights += 1
        squares += rest * rest
        n00 += slope0 * slope0
        n01 += slope0 * slope1
        n02 += slope0 * slope2
        n11 += slope1 * slope1
        n12 += slope1 * slope2
        n22 += slope2 * slope2
        b0 += slope0 * rest
        b1 += slope1 * rest
        b2 += slope2 * rest
    if used < 5 or lefts + rights < 4:
        return 0.0, 0.0, 0.0, 0.0, -1
    # A narrow stripe has few samples: a weak belief in the present width keeps the equations regular.
    n22 += 1e-6 * n22 + 1e-12
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    det = n00 * c00 + n01 * c01 + n02 * c02
    if not det > 0.0:
        return 0.0, 0.0, 0.0, 0.0, -1
    c11, c12 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12
    c22 = n00 * n11 - n01 * n01
    d0 = (c00 * b0 + c01 * b1 + c02 * b2) / det
    d1 = (c01 * b0 + c11 * b1 + c12 * b2) / det
    d2 = (c02 * b0 + c12 * b1 + c22 * b2) / det
    sigma = max(noise, math.sqrt(squares / max(used - 3, 1))) * math.sqrt(c11 / det)
    shift = min(max(d1, -width), width)
    wider = min(max(width + d2, 0.6 * width), 1.6 * width)
    taller = min(max(height + d0, 0.4 * height), 2.5 * height)
    return taller, shift, wider, sigma, flags
