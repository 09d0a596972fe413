"""Least-squares fit of one row, sample by sample: for rows that are clipped, struck, cut or very wide.

The model is a Gaussian on a straight background. Clipped samples say nothing and are left out: the
flanks give the centre. A median of three rows, along the stripe, only starts the fit and tells
outliers; the fit itself takes the row's own samples, so that nothing is smoothed across a depth edge.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import kernel
from .start import SIDE, background_of, goes_on, profile_of, start_of

Floats = npt.NDArray[np.float64]

_SATURATED, _EDGE, _SECOND, _GATED = (
    int(Flag.SATURATED),
    int(Flag.EDGE),
    int(Flag.SECOND),
    int(Flag.GATED),
)
_STEPS = 12
#: In so many steps the gate is set anew.
_SETTLING = 3
#: Samples farther off the model than this many standard deviations are left out.
_GATE = 4.5
#: In the first step, the samples' distance may be due to a centre and a width that are this far off, in
#: px.
_SLACK = 0.2
#: More than this share of outliers makes a second start worth its time.
_DOUBTFUL = 0.12
#: A sample that is off by this share of the height is unlike a Gaussian; so many, and this is no
#: stripe.
_UNLIKE, _MOST_UNLIKE = 0.15, 0.35
#: Share of the height that is there at the centre.
_FILLED = 0.75
#: What is seen of a stripe, over the noise of a matched filter: less is found in noise alone now and
#: then.
CERTAIN = 7.0
#: How far from the centre a second stripe is looked for, in px.
_NEAR = 24
#: Narrowest stripe that is one, as a standard deviation: less is a single pixel.
_NARROWEST = 0.3

_Row = tuple[bool, float, float, float, float, float, int]
_Model = tuple[float, float, float, float, float]


@kernel
def fit_row(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    span: tuple[int, int],
    limits: tuple[float, float, float, float],
    clip_dn: float,
) -> _Row:
    """(good, centre, its deviation, width, height, background, flags) of the stripe near ``peak``.

    ``span`` is the half-open range of columns that may be used, ``limits`` are base_dn, max_width_px,
    the noise under the stripe and that of the frame. ``good`` is False where no stripe can be
    fitted: too few samples, too faint, centre away from the peak or not better known than the
    stripe is wide.
    """
    from_px, to_px = span
    _, max_width_px, _, plain = limits
    reach = int(math.ceil(2.0 * max_width_px)) + SIDE
    best = _fit_within(signal, raw, row, peak, span, reach, limits, clip_dn)
    if best[0] and 3.5 * best[3] > reach:
        # So wide that no background was seen: once more, from afar.
        best = _fit_within(signal, raw, row, peak, span, 2 * reach, limits, clip_dn)
    good, centre, sigma, width, height, base, flags = best
    if not good:
        return best
    if centre - 2.5 * width < from_px or centre + 2.5 * width > to_px - 1:
        flags |= _EDGE
    if second_near(signal[row], centre, height, base, plain, from_px, to_px):
        flags |= _SECOND
    return True, centre, sigma, width, height, base, flags


@kernel
def _fit_within(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    span: tuple[int, int],
    reach: int,
    limits: tuple[float, float, float, float],
    clip_dn: float,
) -> _Row:
    """The fit to the samples up to ``reach`` from the peak; arguments as in :func:`fit_row`."""
    low, high = max(span[0], peak - reach), min(span[1], peak + reach + 1)
    samples, cut = np.empty(high - low, np.float64), np.empty(high - low, np.bool_)
    for j in range(high - low):
        samples[j] = float(signal[row, low + j])
        cut[j] = float(raw[row, low + j]) >= clip_dn
    along = goes_on(signal, row, low, high, peak)
    profile = profile_of(signal, row, low, high, along)
    best, cost, strange = _attempt(samples, cut, profile, low, peak, limits)
    if not best[0] or strange > _DOUBTFUL:
        # The rows beside it may show something else after all, or better: once more the other way.
        profile = profile_of(signal, row, low, high, not along)
        other, its_cost, _ = _attempt(samples, cut, profile, low, peak, limits)
        if other[0] and (not best[0] or its_cost < cost):
            best = other
    return best


@kernel
def _attempt(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    profile: Floats,
    low: int,
    peak: int,
    limits: tuple[float, float, float, float],
) -> tuple[_Row, float, float]:
    """The fit that ``profile`` starts; its mean square remainder, each up to a gate; share of outliers.

    ``low`` is the column of sample 0, ``limits`` are those of :func:`fit_row`.
    """
    base_dn, max_width_px, noise, plain = limits
    bad = ((False, 0.0, 0.0, 0.0, 0.0, 0.0, 0), np.inf, 1.0)
    high = low + len(samples)
    top = peak - low
    for j in range(max(0, top - 2), min(len(profile), top + 3)):
        if profile[j] > profile[top]:
            top = j
    ok, centre, width, height, base = start_of(profile, cut, low, top, max_width_px)
    if not ok or height < 0.5 * base_dn:
        return bad
    base, tilt = background_of(profile, centre - low, width, noise, height)
    half = 3.5 * width + 4.0
    first = max(low, int(math.floor(centre - half)))
    stop = min(high, int(math.ceil(centre + half)) + 1)
    rests = np.empty(stop - first, np.float64)
    begin = (centre - low, width, height, base, tilt)
    model, sigma, gate, flags = _descend(samples, cut, profile, first - low, begin, noise, rests)
    centre, width, height, base, tilt = model
    centre += low
    if flags < 0 or not _NARROWEST <= width <= max_width_px or not low - 0.5 <= centre <= high - 0.5:
        return bad
    if abs(centre - peak) > 2.5 + 1.5 * width and not flags & _SATURATED:
        return bad
    if height < base_dn or not sigma < max(0.2 * width, 0.5):
        return bad
    if not flags & _SATURATED and not _filled(samples, model, plain):
        return bad
    cost, outliers, seen = _judge(rests, first - low, model, noise, plain, gate)
    if not seen:
        return bad
    found = (True, centre, sigma, width, height, base + tilt * (centre - low), flags)
    return found, cost, outliers


@kernel
def _descend(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    profile: Floats,
    first: int,
    begin: _Model,
    noise: float,
    rests: Floats,
) -> tuple[_Model, float, float, int]:
    """Gauss-Newton steps to the end: the model, the centre's deviation, the gate, and flags or -1.

    A model is (centre, width, height, background, its slope), places counted from sample 0. ``rests``
    is filled with the distances of the samples from ``first`` on.
    """
    centre, width, height, base, tilt = begin
    stop = first + len(rests)
    sigma, gate, flags = 0.0, np.inf, 0
    # First the profile, in which hardly an outlier is left, then the samples themselves.
    for stage in range(2):
        for step in range(_STEPS):
            if stage == 1 and step < _SETTLING:
                _distances(samples, cut, first, (centre, width, height, base, tilt), rests)
                gate = _GATE * max(noise, _scatter(rests))
            height, moved, width, sigma, flags = _improve(
                samples if stage == 1 else profile,
                cut,
                (first, stop),
                (centre, width, height, base, tilt),
                noise,
                gate,
                _SLACK if step == 0 else 0.0,
            )
            centre += moved
            if flags < 0 or width < _NARROWEST or not -0.5 <= centre <= len(samples) - 0.5:
                return begin, 0.0, gate, -1
            if abs(moved) < 0.02 * sigma + 1e-4 and step >= stage:
                break
    model = (centre, width, height, base, tilt)
    _distances(samples, cut, first, model, rests)
    return model, sigma, gate, flags


@kernel
def _filled(samples: Floats, model: _Model, noise: float) -> bool:
    """Whether the centre is bright: of two stripes taken together it lies where neither is."""
    centre, _, height, base, tilt = model
    middle, summit = round(centre), -np.inf
    for j in range(max(0, middle - 1), min(len(samples), middle + 2)):
        summit = max(summit, samples[j] - base - tilt * j)
    return summit >= _FILLED * height - 2.0 * noise


@kernel
def _judge(
    rests: Floats, first: int, model: _Model, noise: float, plain: float, gate: float
) -> tuple[float, float, bool]:
    """Mean square distance, each up to a gate; share of outliers; whether a stripe is seen at all."""
    centre, width, height, _, _ = model
    cost, energy, n, unlike, outliers = 0.0, 0.0, 0, 0, 0
    for j in range(len(rests)):
        rest = rests[j]
        if rest >= 0.0:
            cost += min(rest * rest, _GATE * _GATE * noise * noise)
            n += 1
            unlike += rest > _UNLIKE * height + 3.0 * noise
            if rest > gate:
                outliers += 1
            else:
                t = (first + j - centre) / width
                energy += (height * math.exp(-0.5 * t * t)) ** 2
    seen = n > 0 and unlike <= _MOST_UNLIKE * n and energy >= (CERTAIN * plain) ** 2
    return cost / max(n, 1), outliers / max(n, 1), seen


@kernel
def second_near(
    line: npt.NDArray[Any],
    centre: float,
    height: float,
    base: float,
    noise: float,
    from_px: int,
    to_px: int,
) -> bool:
    """Whether a second stripe stands so near to the first that the search takes it for a part of it.

    Outwards from the centre the samples fall, and must not rise again. They are taken in pairs: the
    lesser of the two to rise, the greater to fall, so that single hot or dark pixels do nothing.
    """
    rise, level = max(0.25 * height, 5.0 * noise), base + 0.4 * height
    for side in (-1, 1):
        at = int(round(centre)) - side
        valley = np.inf
        for _ in range(_NEAR):
            at += side
            if not from_px + 1 <= at < to_px - 1:
                break
            one, other = float(line[at]), float(line[at + side])
            valley = min(valley, max(one, other))
            lesser = min(one, other)
            if lesser - valley > rise and lesser > level:
                return True
    return False


@kernel
def _distances(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    first: int,
    model: tuple[float, float, float, float, float],
    rests: Floats,
) -> None:
    """Fill ``rests`` with the distances from the model, from sample ``first`` on; -1 for clipped."""
    centre, width, height, base, tilt = model
    for i in range(len(rests)):
        j = first + i
        t = (j - centre) / width
        rest = abs(samples[j] - base - tilt * j - height * math.exp(-0.5 * t * t))
        rests[i] = -1.0 if cut[j] else rest


@kernel
def _scatter(rests: Floats) -> float:
    """Robust deviation: 1.48 times the median of the distances that are not negative."""
    ordered = np.sort(rests)
    n, start = len(rests), 0
    while start < n and ordered[start] < 0.0:
        start += 1
    if n - start < 3:
        return np.inf
    return 1.4826 * ordered[start + (n - start) // 2]


@kernel
def _improve(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    span: tuple[int, int],
    start: tuple[float, float, float, float, float],
    noise: float,
    gate: float,
    slack: float,
) -> tuple[float, float, float, float, int]:
    """One Gauss-Newton step: (height, shift of the centre, width, deviation of the centre, flags or
    -1).

    Unknowns are height, centre and width; ``start`` is (centre, width, height, background at sample 0,
    its slope), whose background stands. Samples farther off than ``gate``, and than ``slack`` px of
    centre or width explain, are left out, and clipped ones.
    """
    first, stop = span
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
    near = max(3.0 * width, 1.5)
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
        if abs(rest) > gate + slack * (abs(slope1) + slope2):
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
