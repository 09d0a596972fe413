"""Gauss-Newton steps of one row's Gaussian: first to its cleaned profile, then to its own samples."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import part

Floats = npt.NDArray[np.float64]

_SATURATED, _GATED = int(Flag.SATURATED), int(Flag.GATED)
#: Steps at most, of the profile and then of the samples.
_STEPS = 12
#: In so many steps the gate is set anew.
_SETTLING = 3
#: Samples farther off the model than this many standard deviations are left out.
GATE = 4.5
#: In the first step, the samples' distance may be due to a centre and a width that are this far off, in
#: px.
_SLACK = 0.2
#: A sample that is off by this share of the height is unlike a Gaussian; so many, and this is no
#: stripe.
_UNLIKE, _MOST_UNLIKE = 0.15, 0.35
#: Narrowest stripe that is one, as a standard deviation: less is a single pixel.
NARROWEST = 0.3
#: Halvings of the interval in which the median distance lies: known to a sixtieth.
_HALVINGS = 6

#: Centre, width, height, background and its slope; places are counted from sample 0.
Model = tuple[float, float, float, float, float]


@part
def descend(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    profile: Floats,
    first: int,
    begin: Model,
    noise: float,
    rests: Floats,
) -> tuple[Model, float, float, int]:
    """Steps to the end: the model, the centre's deviation, the gate, and flags, or -1 for no stripe.

    ``rests`` is filled with the distances of the samples from ``first`` on.
    """
    centre, width, height, base, tilt = begin
    stop = first + len(rests)
    sigma, gate, flags = 0.0, np.inf, 0
    # First the profile, in which hardly an outlier is left, then the samples themselves.
    for stage in range(2):
        for step in range(_STEPS):
            if stage == 1 and step < _SETTLING:
                _distances(samples, cut, first, (centre, width, height, base, tilt), rests)
                gate = GATE * max(noise, _scatter(rests, noise))
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
            if flags < 0 or width < NARROWEST or not -0.5 <= centre <= len(samples) - 0.5:
                return begin, 0.0, gate, -1
            if step >= stage and abs(moved) < 0.02 * sigma + 1e-4:
                break
        if stage == 0:
            _distances(profile, cut, first, (centre, width, height, base, tilt), rests)
            if is_unlike(rests, height, noise):
                return begin, 0.0, gate, -1
    model = (centre, width, height, base, tilt)
    _distances(samples, cut, first, model, rests)
    return model, sigma, gate, flags


@part
def is_unlike(rests: Floats, height: float, noise: float) -> bool:
    """Whether many of the distances, those of clipped samples (-1) aside, are large for a Gaussian."""
    n, unlike, limit = 0, 0, _UNLIKE * height + 3.0 * noise
    for j in range(len(rests)):
        n += rests[j] >= 0.0
        unlike += rests[j] > limit
    return n == 0 or unlike > _MOST_UNLIKE * n


@part
def _distances(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    first: int,
    model: Model,
    rests: Floats,
) -> None:
    """Fill ``rests`` with the distances from the model, from sample ``first`` on; -1 for clipped."""
    centre, width, height, base, tilt = model
    value, ratio, change = _series(first - centre, width)
    value *= height
    for i in range(len(rests)):
        j = first + i
        rest = abs(samples[j] - base - tilt * j - value)
        value *= ratio
        ratio *= change
        rests[i] = -1.0 if cut[j] else rest


@part
def _series(x: float, width: float) -> tuple[float, float, float]:
    """exp(-(x / width)^2 / 2), the ratio of the next value, at x + 1, to it, and that ratio's own."""
    inverse = 1.0 / width
    t = x * inverse
    return (
        math.exp(-0.5 * t * t),
        math.exp(-inverse * (t + 0.5 * inverse)),
        math.exp(-inverse * inverse),
    )


@part
def _scatter(rests: Floats, noise: float) -> float:
    """Robust deviation: 1.48 times the median of the distances that are not negative; to 2 %."""
    n = 0
    for j in range(len(rests)):
        n += rests[j] >= 0.0
    if n < 3:
        return np.inf
    rank = len(rests) - n + n // 2
    low, high = 0.0, max(noise, 1e-12)
    while high < np.inf and _below(rests, high) <= rank:
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _below(rests, middle) > rank:
            high = middle
        else:
            low = middle
    return 1.4826 * high


@part
def _below(rests: Floats, level: float) -> int:
    """How many are not above ``level``."""
    total = 0
    for j in range(len(rests)):
        total += 1 if rests[np.uintp(j)] <= level else 0
    return total


@part
def _improve(
    samples: Floats,
    cut: npt.NDArray[np.bool_],
    span: tuple[int, int],
    start: Model,
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
    value, ratio, change = _series(first - centre, width)
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
