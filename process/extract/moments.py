"""Stripe centres of all rows by windowed moments: passes over the frame, each row by itself.

A pass takes the sums of every pending row (memory) and then solves all rows at once (arithmetic), so
that neither waits for the other. A pilot of a few rows finds the width to begin with; the first pass
starts at the rough peaks, the second at what it found, and that is the end for nearly every row.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel
from .window import (
    LEFT,
    NEAREST,
    PHASES,
    REACH,
    SAMPLES,
    SIDE,
    G,
    K,
    X,
    lever_of,
    mean_of,
    sums_of,
)

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Lines of ``found``: centre, width, height, background, and the squares that no Gaussian explains.
CENTRE, WIDTH, HEIGHT, BASE, REST = range(5)
#: What a row is: still to be done, done, not to be done this way, or clipped.
PENDING, DONE, FAILED, CLIPPED = range(4)

#: A window fits when its centre is within this share of its width of the stripe's, and q within the
#: other of one half (widths within a tenth): the closed form then loses less than one in a hundred of
#: the information.
_CENTRED, _MATCHED = 0.25, 0.05
_PASSES = 6
_PILOTS = 12
_ROOT_2_PI, _HALF_ROOT_PI = math.sqrt(2.0 * math.pi), 0.5 * math.sqrt(math.pi)
#: Sum of x^2 over a window's samples.
_LEVER = float(sum((j - LEFT) ** 2 for j in range(SAMPLES)))


@kernel
def windowed_moments(
    signal: npt.NDArray[Any],
    peak: Ints,
    state: npt.NDArray[np.uint8],
    from_px: int,
    to_px: int,
    noise: float,
) -> Floats:
    """Solve the rows whose ``state`` (H,) is PENDING: (5, H), as the constants above name its lines.

    ``peak`` is (H,). Afterwards no row is PENDING.
    """
    height = len(peak)
    found = np.zeros((5, height), np.float64)
    work = np.empty((12, height), np.float64)
    index = np.zeros(height, np.int64)
    rows = np.empty(height, np.int64)
    typical = 0
    while K[typical] < 2.0:
        typical += 1
    # The pilot: the median width of a few rows.
    step = max(1, height // _PILOTS)
    n = 0
    for row in range(step // 2, height, step):
        if state[row] == PENDING:
            found[CENTRE, row] = peak[row]
            index[row] = typical
            rows[n] = row
            n += 1
    for _ in range(_PASSES):
        if n > 0:
            _take(signal, rows, n, found[CENTRE], index, from_px, to_px, noise, work)
            n = _solve(peak, rows, n, state, found, index, work)
    widths = np.empty(height // step + 1, np.float64)
    n = 0
    for row in range(step // 2, height, step):
        if state[row] == DONE:
            widths[n] = found[WIDTH, row]
            n += 1
    if n > 0:
        typical = NEAREST[int(32.0 * np.sort(widths[:n])[n // 2] + 0.5)]
    n = 0
    for row in range(height):
        if state[row] == PENDING:
            index[row] = typical
            rows[n] = row
            n += 1
    _take_at_peaks(signal, rows, n, peak, typical, from_px, to_px, noise, work)
    n = _solve(peak, rows, n, state, found, index, work)
    for _ in range(_PASSES):
        if n > 0:
            _take(signal, rows, n, found[CENTRE], index, from_px, to_px, noise, work)
            n = _solve(peak, rows, n, state, found, index, work)
    for j in range(n):
        state[rows[j]] = FAILED
    return found


@kernel
def _take(
    signal: npt.NDArray[Any],
    rows: Ints,
    n: int,
    centre: Floats,
    index: Ints,
    from_px: int,
    to_px: int,
    noise: float,
    work: Floats,
) -> None:
    """The sums of the first ``n`` of ``rows`` about their present centres; none near a border."""
    for j in range(n):
        row = rows[j]
        i = index[row]
        middle = int(math.floor(centre[row]))
        phase = int((centre[row] - middle) * PHASES + 0.5)
        beside = REACH[i]
        margin = max(beside + SIDE, LEFT + 1)
        if middle - margin < from_px or middle + margin >= to_px:
            work[0, j] = 0.0
            continue
        line = signal[row]
        left, right = mean_of(line, middle - beside - SIDE), mean_of(line, middle + beside + 1)
        base = 0.5 * (left + right)
        s0, s1, s2, s3 = sums_of(line, middle - LEFT, np.float32(base), G[i, phase], X[phase])
        if abs(right - left) > 1.5 * noise:
            # Three standard deviations: a sloping background, taken away from the sums.
            tilt = (right - left) / (2.0 * beside + SIDE + 1.0)
            s1 -= tilt * _ROOT_2_PI * K[i] * K[i] * K[i]
            s3 -= tilt * (2.0 * lever_of(line, middle - LEFT, base, X[phase]) - tilt * _LEVER)
        work[0, j] = s0
        work[1, j] = s1
        work[2, j] = s2
        work[3, j] = s3
        work[4, j] = base
        work[5, j] = middle + phase / PHASES


@kernel
def _take_at_peaks(
    signal: npt.NDArray[Any],
    rows: Ints,
    n: int,
    peak: Ints,
    i: int,
    from_px: int,
    to_px: int,
    noise: float,
    work: Floats,
) -> None:
    """As :func:`_take` about the peaks and with one window: the pass that every row takes."""
    window, place, beside = G[i, 0], X[0], REACH[i]
    margin = max(beside + SIDE, LEFT + 1)
    lean = _ROOT_2_PI * K[i] * K[i] * K[i]
    for j in range(n):
        row = rows[j]
        middle = peak[row]
        if middle - margin < from_px or middle + margin >= to_px:
            work[0, j] = 0.0
            continue
        line = signal[row]
        left, right = mean_of(line, middle - beside - SIDE), mean_of(line, middle + beside + 1)
        base = 0.5 * (left + right)
        s0, s1, s2, s3 = sums_of(line, middle - LEFT, np.float32(base), window, place)
        if abs(right - left) > 1.5 * noise:
            tilt = (right - left) / (2.0 * beside + SIDE + 1.0)
            s1 -= tilt * lean
            s3 -= tilt * (2.0 * lever_of(line, middle - LEFT, base, place) - tilt * _LEVER)
        work[0, j] = s0
        work[1, j] = s1
        work[2, j] = s2
        work[3, j] = s3
        work[4, j] = base
        work[5, j] = middle


@kernel
def _solve(
    peak: Ints,
    rows: Ints,
    n: int,
    state: npt.NDArray[np.uint8],
    found: Floats,
    index: Ints,
    work: Floats,
) -> int:
    """Centres and widths from the sums; ``rows`` then begins with those still pending: how many."""
    last = len(K) - 1
    widest = 1.05 * K[last]
    own, shift, part, wide, tall, rest = work[6], work[7], work[8], work[9], work[10], work[11]
    for j in range(n):
        own[j] = K[index[rows[j]]]
    _arithmetic(work[0], work[1], work[2], work[3], own, shift, part, wide, tall, rest, n)
    pending = 0
    for j in range(n):
        row = rows[j]
        i, q = index[row], part[j]
        if not work[0, j] > 0.0:
            state[row] = FAILED
        elif not 0.02 < q < 0.9:
            # Far wider than the window: its width says little, but that it must grow.
            if q < 0.9 or i == last:
                state[row] = FAILED
            else:
                index[row] = min(i + 12, last)
                found[CENTRE, row] = work[5, j] + shift[j] * (1.0 - q)
                rows[pending] = row
                pending += 1
        else:
            centre = work[5, j] + shift[j]
            found[CENTRE, row] = centre
            # The window of the stripe's own width goes with q = 1 / 2; one step of the table moves that
            # by 0.024.
            near = abs(shift[j]) <= _CENTRED * own[j]
            if near and (abs(q - 0.5) <= _MATCHED or (i == 0 and q < 0.5)):
                found[WIDTH, row] = wide[j]
                found[HEIGHT, row] = tall[j]
                found[BASE, row] = work[4, j]
                found[REST, row] = rest[j]
                state[row] = DONE
            elif wide[j] > widest or abs(centre - peak[row]) > 3.0 + 2.0 * own[j]:
                state[row] = FAILED
            else:
                index[row] = NEAREST[int(32.0 * wide[j] + 0.5)]
                rows[pending] = row
                pending += 1
    return pending


@kernel
def _arithmetic(
    sum0: Floats,
    sum1: Floats,
    sum2: Floats,
    sum3: Floats,
    own: Floats,
    shift: Floats,
    part: Floats,
    wide: Floats,
    tall: Floats,
    rest: Floats,
    n: int,
) -> None:
    """Shift, q, width, height and remainder of all rows from their sums: no branch, so vectorised."""
    for row in range(n):
        k, s0, s1 = own[row], sum0[row], sum1[row]
        scale, square = 1.0 / s0, 1.0 / (k * k)
        mean = s1 * scale
        s2 = sum2[row] * square
        q = s2 * scale - mean * mean * square
        root = np.sqrt(q)
        part[row] = q
        shift[row] = mean / (1.0 - q)
        wide[row] = k * root / np.sqrt(1.0 - q)
        # The window's place differs from the stripe's by so little that it matters to no height.
        tall[row] = s0 / (_ROOT_2_PI * k * root)
        # What a height and a width explain: the window and the window times x^2 / k^2, whose Gram
        # matrix is k sqrt(pi) [[1, 1/2], [1/2, 3/4]]; and what a shift does, the window times x.
        even = (1.5 * s0 * s0 - 2.0 * s0 * s2 + 2.0 * s2 * s2) / (2.0 * _HALF_ROOT_PI * k)
        odd = s1 * s1 * square / (_HALF_ROOT_PI * k)
        rest[row] = abs(sum3[row] - even - odd)
