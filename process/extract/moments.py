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

from ..compiled import part
from .window import (
    LEFT,
    NEAREST,
    PHASES,
    REACH,
    SAMPLES,
    SIDE,
    G,
    K,
    Singles,
    X,
    lever_of,
    mean_of,
    sums_of,
)

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Lines of ``found``: centre, width, height, background, and the squares that no Gaussian explains.
CENTRE, WIDTH, HEIGHT, BASE, REST = range(5)
#: What a row is: still to be done, done, not to be done this way, clipped, or wider than the windows.
PENDING, DONE, FAILED, CLIPPED, WIDE = range(5)

#: A window fits when its centre is within this share of its width of the stripe's, and q within the
#: other of one half (widths within a tenth): the closed form then loses less than one in a hundred of
#: the information.
_CENTRED, _MATCHED = 0.25, 0.05
_PASSES = 6
#: So many rows are worked on together, whose numbers then stay in the fastest cache.
_BLOCK = 64
_PILOTS = 12
_ROOT_2_PI, _HALF_ROOT_PI = math.sqrt(2.0 * math.pi), 0.5 * math.sqrt(math.pi)
#: Sum of x^2 over a window's samples.
_LEVER = float(sum((j - LEFT) ** 2 for j in range(SAMPLES)))


@part
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
    work = np.empty((12, _BLOCK), np.float32)
    index = np.zeros(height, np.int64)
    rows = np.empty(height, np.int64)
    # A plain 0 would be a type of its own to the compiler, and what it is passed to compiled twice.
    typical: Any = np.int64(0)
    while K[typical] < 2.0:
        typical += 1
    # The pilot: the median width of a few rows.
    step = max(1, height // _PILOTS)
    n: Any = np.int64(0)
    for row in range(step // 2, height, step):
        if state[row] == PENDING:
            found[CENTRE, row] = peak[row]
            index[row] = typical
            rows[n] = row
            n += 1
    # Passes of the pilot, then those of all rows, in one loop: a second call is a second copy.
    for turn in range(2 * _PASSES + 1):
        if turn == _PASSES:
            typical = _typical(state[step // 2 :: step], found[WIDTH, step // 2 :: step], typical)
            n = np.int64(0)
            for row in range(height):
                if state[row] == PENDING:
                    index[row] = typical
                    rows[n] = row
                    n += 1
        if n > 0:
            window: Any = typical if turn == _PASSES else np.int64(-1)
            n = _pass(signal, rows, n, peak, window, state, found, index, (from_px, to_px), noise, work)
    for j in range(n):
        state[rows[j]] = FAILED
    return found


@part
def _typical(state: npt.NDArray[np.uint8], width: Floats, otherwise: int) -> int:
    """Index of the window of the median width of the rows that are done; ``otherwise`` if none is."""
    widths = np.empty(len(width), np.float64)
    n = 0
    for i in range(len(width)):
        if state[i] == DONE:
            widths[n] = width[i]
            n += 1
    return NEAREST[int(32.0 * np.sort(widths[:n])[n // 2] + 0.5)] if n > 0 else otherwise


@part
def _pass(
    signal: npt.NDArray[Any],
    rows: Ints,
    n: int,
    peak: Ints,
    window: int,
    state: npt.NDArray[np.uint8],
    found: Floats,
    index: Ints,
    span: tuple[int, int],
    noise: float,
    work: Singles,
) -> int:
    """One step of the first ``n`` of ``rows``, which then begins with those still pending: how many.

    About the peaks with the one ``window``; with -1, each row about its centre with its own.
    """
    pending: Any = np.int64(0)
    for start in range(0, n, _BLOCK):
        m = min(_BLOCK, n - start)
        some = rows[start : start + m]
        if window >= 0:
            _take_at_peaks(signal, some, m, peak, window, span[0], span[1], noise, work)
        else:
            _take(signal, some, m, found[CENTRE], index, span[0], span[1], noise, work)
        left = _solve(peak, some, m, state, found, index, work)
        for j in range(left):
            rows[pending + j] = some[j]
        pending += left
    return pending


@part
def _take(
    signal: npt.NDArray[Any],
    rows: Ints,
    n: int,
    centre: Floats,
    index: Ints,
    from_px: int,
    to_px: int,
    noise: float,
    work: Singles,
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
        left = mean_of(signal, row, middle - beside - SIDE)
        right = mean_of(signal, row, middle + beside + 1)
        base = np.float32(0.5) * (left + right)
        s0, s1, s2, s3 = sums_of(signal, row, middle - LEFT, base, G[i, phase], X[phase])
        if abs(right - left) > 1.5 * noise:
            # Three standard deviations: a sloping background, taken away from the sums.
            tilt = float(right - left) / (2.0 * beside + SIDE + 1.0)
            s1 -= np.float32(tilt * _ROOT_2_PI * K[i] * K[i] * K[i])
            s3 -= np.float32(tilt) * np.float32(
                2.0 * lever_of(signal, row, middle - LEFT, base, X[phase]) - tilt * _LEVER
            )
        work[0, j] = s0
        work[1, j] = s1
        work[2, j] = s2
        work[3, j] = s3
        work[4, j] = base
        work[5, j] = middle + phase / PHASES


@part
def _take_at_peaks(
    signal: npt.NDArray[Any],
    rows: Ints,
    n: int,
    peak: Ints,
    i: int,
    from_px: int,
    to_px: int,
    noise: float,
    work: Singles,
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
        left = mean_of(signal, row, middle - beside - SIDE)
        right = mean_of(signal, row, middle + beside + 1)
        base = np.float32(0.5) * (left + right)
        s0, s1, s2, s3 = sums_of(signal, row, middle - LEFT, base, window, place)
        if abs(right - left) > 1.5 * noise:
            tilt = float(right - left) / (2.0 * beside + SIDE + 1.0)
            s1 -= np.float32(tilt * lean)
            s3 -= np.float32(tilt) * np.float32(
                2.0 * lever_of(signal, row, middle - LEFT, base, place) - tilt * _LEVER
            )
        work[0, j] = s0
        work[1, j] = s1
        work[2, j] = s2
        work[3, j] = s3
        work[4, j] = base
        work[5, j] = middle


@part
def _solve(
    peak: Ints,
    rows: Ints,
    n: int,
    state: npt.NDArray[np.uint8],
    found: Floats,
    index: Ints,
    work: Singles,
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
            moved = float(shift[j]) * (1.0 - q)
            # A sum next to nothing gives a centre anywhere, or none.
            if q < 0.9 or i == last or not abs(moved) < LEFT:
                state[row] = FAILED
            else:
                index[row] = min(i + 12, last)
                found[CENTRE, row] = float(work[5, j]) + moved
                rows[pending] = row
                pending += 1
        else:
            centre = float(work[5, j]) + float(shift[j])
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


@part
def _arithmetic(
    sum0: Singles,
    sum1: Singles,
    sum2: Singles,
    sum3: Singles,
    own: Singles,
    shift: Singles,
    part: Singles,
    wide: Singles,
    tall: Singles,
    rest: Singles,
    n: int,
) -> None:
    """Shift, q, width, height and remainder of all rows from their sums: no branch, so vectorised."""
    one, root_2_pi, half_root_pi = np.float32(1.0), np.float32(_ROOT_2_PI), np.float32(_HALF_ROOT_PI)
    two, one_half = np.float32(2.0), np.float32(1.5)
    for row in range(n):
        k, s0, s1 = own[row], sum0[row], sum1[row]
        scale, square = one / s0, one / (k * k)
        mean = s1 * scale
        s2 = sum2[row] * square
        q = s2 * scale - mean * mean * square
        root = np.sqrt(q)
        part[row] = q
        shift[row] = mean / (one - q)
        wide[row] = k * root / np.sqrt(one - q)
        # The window's place differs from the stripe's by so little that it matters to no height.
        tall[row] = s0 / (root_2_pi * k * root)
        # What a height and a width explain: the window and the window times x^2 / k^2, whose Gram
        # matrix is k sqrt(pi) [[1, 1/2], [1/2, 3/4]]; and what a shift does, the window times x.
        even = (one_half * s0 * s0 - two * s0 * s2 + two * s2 * s2) / (two * half_root_pi * k)
        odd = s1 * s1 * square / (half_root_pi * k)
        rest[row] = abs(sum3[row] - even - odd)
