"""Which stripe of a row, where there are several: reflections, a second laser, the wall behind an edge.

First the candidates of every row are found (candidates.py), then one of them is chosen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.errors import UsageError
from ..compiled import kernel, part
from .candidates import MOST, candidates

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: A row is ambiguous when another candidate is at least this bright, relative to the chosen one.
_SECOND = 0.5
#: Continuity: a break costs as much as this many of the brightest rows are worth. A step of so many px,
#: or more, costs the same, and a shorter one less, by its square. Paths go on over up to this many rows
#: less one.
_BREAK, _STEP_PX, _GAP = 8.0, 16.0, 12
#: What a candidate is worth at no brightness; at the usual one it is worth 1. Continuity counts more.
_FAINT = 0.5


def choose_peaks(
    signal: npt.NDArray[Any],
    from_px: int,
    to_px: int,
    base_dn: float,
    choice: str,
    expected_px: float | Floats | None = None,
) -> tuple[Ints, Bools]:
    """Rough position (H,) of the chosen stripe of each row, -1 for none; and whether it was ambiguous.

    Parameters
    ----------
    signal
        (H, W), grey values in DN, with the stripe across the rows.
    from_px, to_px
        Columns that are looked at, half-open.
    base_dn
        What is not higher above its surroundings is no candidate.
    choice
        ``first``: the one of least u. ``nearest``: the one nearest to ``expected_px``.
        ``continuous``: those on the path along the rows that is brightest for the fewest jumps; it
        may break and leave rows out.
    expected_px
        For ``nearest``: one position, or (H,), NaN where no stripe is expected.

    Raises
    ------
    UsageError
        There is no such choice, or ``expected_px`` does not fit the frame.
    """
    height = signal.shape[0]
    if choice == "nearest":
        expected = _expected(expected_px, height)
    elif choice not in ("first", "continuous"):
        raise UsageError(f"choice is {choice!r}, expected first, nearest or continuous")
    count, place, tall = candidates(signal, from_px, to_px, base_dn)
    if choice == "nearest":
        chosen = _nearest(count, place, expected)
    elif choice == "first":
        chosen = np.where(count > 0, 0, -1)
    else:
        chosen = _continuous(count, place, tall)
    return _chosen(count, place, tall, chosen)


def _expected(expected_px: float | Floats | None, height: int) -> Floats:
    if expected_px is None:
        raise UsageError('choice = "nearest" needs expected_px')
    given = np.asarray(expected_px, np.float64)
    if given.shape not in ((), (height,)):
        raise UsageError(
            f"expected_px has shape {given.shape}, expected one number or ({height},)",
            hint="one for each row of a vertical stripe, or each column of a horizontal one",
        )
    if np.isinf(given).any() or (given.ndim == 0 and np.isnan(given)):
        raise UsageError("expected_px holds what is no number")
    return np.ascontiguousarray(np.broadcast_to(given, (height,)))


@kernel
def _nearest(count: Ints, place: Ints, expected: Floats) -> Ints:
    out = np.full(len(count), -1, np.int64)
    for row in range(len(count)):
        best = np.inf
        for i in range(count[row]):
            distance = abs(place[row, i] - expected[row])
            if distance < best:
                best, out[row] = distance, i
    return out


@kernel
def _continuous(count: Ints, place: Ints, tall: Floats) -> Ints:
    """The best path by dynamic programming: brightness of its candidates, less the cost of its jumps.

    A candidate is reached from those of the last rows, at a cost that grows with the distance in px,
    or from the best path so far, wherever it ended, at the cost of a break.
    """
    height = len(count)
    usual = _usual(count, tall)
    score, back = np.zeros((height, MOST)), np.full((height, MOST), -1, np.int64)
    best, best_at = 0.0, -1
    for row in range(height):
        for i in range(count[row]):
            # The start of a path, anywhere, costs what a break does.
            value, origin = best - _BREAK, best_at
            for before in range(max(0, row - _GAP), row):
                for j in range(count[before]):
                    # Not less for being spread over a gap: leaving rows out must not pay.
                    step = (place[row, i] - place[before, j]) / _STEP_PX
                    reached = score[before, j] - _BREAK * min(step * step, 1.0)
                    if reached > value:
                        value, origin = reached, before * MOST + j
            bright = min(tall[row, i] / usual, 1.0)
            score[row, i], back[row, i] = value + _FAINT + (1.0 - _FAINT) * bright, origin
        for i in range(count[row]):
            if score[row, i] > best or best_at < 0:
                best, best_at = score[row, i], row * MOST + i
    out = np.full(height, -1, np.int64)
    while best_at >= 0:
        row, i = best_at // MOST, best_at % MOST
        out[row] = i
        best_at = back[row, i]
    return out


@part
def _usual(count: Ints, tall: Floats) -> float:
    """Median over the rows of the brightest candidate's height."""
    tops = np.empty(len(count), np.float64)
    n = 0
    for row in range(len(count)):
        if count[row] > 0:
            tops[n] = np.max(tall[row, : count[row]])
            n += 1
    return np.sort(tops[:n])[n // 2] if n > 0 else 1.0


@kernel
def _chosen(count: Ints, place: Ints, tall: Floats, chosen: Ints) -> tuple[Ints, Bools]:
    peak, second = np.full(len(count), -1, np.int64), np.zeros(len(count), np.bool_)
    for row in range(len(count)):
        mine = chosen[row]
        if mine < 0:
            continue
        peak[row] = place[row, mine]
        for i in range(count[row]):
            second[row] |= i != mine and tall[row, i] >= _SECOND * tall[row, mine]
    return peak, second
