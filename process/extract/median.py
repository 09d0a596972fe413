"""Median of a stretch of samples, by bisection of its value."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ..compiled import part

Floats = npt.NDArray[np.float64]


@part
def middle_of(
    line: Floats,
    begin: int,
    end: int,
    guess: float,
    step: float,
    whole: bool,
) -> float:
    """Median of ``line[begin:end]``. ``guess`` and ``step`` (DN, > 0) only say where to begin looking.

    By bisection of the value: counting what lies below needs no branches, a tenth of the time of
    sorting.
    """
    n = end - begin
    upper = _ranked(line, begin, n, n // 2, guess, step, whole)
    return upper if n % 2 else 0.5 * (upper + _ranked(line, begin, n, n // 2 - 1, upper, step, whole))


@part
def _ranked(
    line: Floats,
    begin: int,
    n: int,
    rank: int,
    guess: float,
    step: float,
    whole: bool,
) -> float:
    """The sample with ``rank`` smaller ones, of n from ``begin`` on."""
    step = max(math.ceil(2.0 * step), 1.0) if whole else max(2.0 * step, 1e-6)
    guess = math.floor(guess) if whole else guess
    low, high = guess - step, guess + step
    stride = step
    while _below(line, begin, n, low) > rank:
        high, low, stride = low, low - stride, 2.0 * stride
    stride = step
    while _below(line, begin, n, high) <= rank:
        low, high, stride = high, high + stride, 2.0 * stride
    if whole:
        while high - low > 1.0:
            middle = float(math.floor(0.5 * (low + high)))
            if _below(line, begin, n, middle) > rank:
                high = middle
            else:
                low = middle
        return high
    for _ in range(60):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        under = _below(line, begin, n, middle)
        if under > rank:
            high = middle
        else:
            low = middle
        if under == rank:
            break
    # Nothing but the sample itself, or others equal to it, is left just above ``low``.
    found = np.inf
    for j in range(begin, begin + n):
        found = line[j] if low < line[j] < found else found
    return found


@part
def _below(line: Floats, begin: int, n: int, level: float) -> int:
    """How many of n samples are not above ``level``."""
    total = 0
    start = np.uintp(begin)
    for j in range(n):
        total += 1 if line[start + np.uintp(j)] <= level else 0
    return total
