"""The one look at every pixel: the best score of each block of columns, for each pair of rows.

The score of a place is the lesser of two rows, so that a hot pixel does not show. The rows below are
asked of the memory ahead of time: a frame comes from it as fast as it can, and all else waits for it.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ..compiled import part
from ..prefetch import prefetch

Counts = npt.NDArray[np.uint16]

#: Columns of one block.
BLOCK: Final = 64
#: A second stripe is reported when it is at least this bright, relative to the first.
SECOND: Final = 0.5
#: Up to this many blocks, the background is looked for in parts of this many columns instead.
_FEW, _PART = 4, 8
#: Rows ahead that are asked of the memory: more gain nothing.
_AHEAD = 6


@part
def ranked_blocks(
    signal: npt.NDArray[Any], from_px: int, to_px: int
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], Counts, Counts]:
    """Best scores (blocks, pairs) of columns [from_px, to_px) of ``signal`` (H, W), and of each pair:
    the least and the best of them, which block has it, and how many are bright.
    """
    best = _score_pairs(signal, from_px, to_px)
    lowest, highest, brightest, bright = _ranks(best)
    if len(best) <= _FEW:
        # The stripe may be in each of so few blocks, so that none shows the background.
        _darkest(signal, from_px, to_px, lowest)
    return best, lowest, highest, brightest, bright


@part
def _score_pairs(signal: npt.NDArray[Any], from_px: int, to_px: int) -> npt.NDArray[Any]:
    """Best of the lesser of two rows, in every block of every pair of rows: (blocks, pairs)."""
    height = signal.shape[0]
    blocks = (to_px - from_px + BLOCK - 1) // BLOCK
    out = np.empty((blocks, (height + 1) // 2), signal.dtype)
    for pair in range(out.shape[1]):
        # An odd last row goes with the one above it.
        row = min(2 * pair, max(height - 2, 0))
        here, under = signal[row], signal[min(row + 1, height - 1)]
        soon, then = min(row + _AHEAD, height - 1), min(row + _AHEAD + 1, height - 1)
        for b in range(blocks):
            # Unsigned indices and plain comparisons: a signed index could count from the end, and then
            # nothing is vectorised. A last block that is short overlaps the one before.
            first = np.uintp(max(min(from_px + b * BLOCK, to_px - BLOCK), from_px))
            prefetch(signal, soon, first)
            prefetch(signal, then, first)
            top = here[first]
            top = top if top < under[first] else under[first]
            if to_px - from_px >= BLOCK:
                for j in range(BLOCK):
                    one, other = here[first + np.uintp(j)], under[first + np.uintp(j)]
                    least = one if one < other else other
                    top = least if least > top else top
            else:
                for j in range(to_px - from_px):
                    least = min(here[first + np.uintp(j)], under[first + np.uintp(j)])
                    top = least if least > top else top
            out[b, pair] = top
    return out


@part
def _ranks(
    best: npt.NDArray[Any],
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], Counts, Counts]:
    """Of every pair of rows: least and best score of a block, which is best, how many are bright."""
    blocks, pairs = best.shape
    lowest, highest = best[0].copy(), best[0].copy()
    # One loop for each thing, with unsigned indices: only so they are vectorised.
    for b in range(1, blocks):
        for i in range(pairs):
            j = np.uintp(i)
            value = best[np.uintp(b), j]
            lowest[j] = value if value < lowest[j] else lowest[j]
            highest[j] = value if value > highest[j] else highest[j]
    level = np.empty(pairs, best.dtype)
    for i in range(pairs):
        j = np.uintp(i)
        low, high = float(lowest[j]), float(highest[j])
        level[j] = low + SECOND * (high - low)
    brightest, bright = np.zeros(pairs, np.uint16), np.zeros(pairs, np.uint16)
    for b in range(blocks - 1, -1, -1):
        number = np.uint16(b)
        for i in range(pairs):
            j = np.uintp(i)
            brightest[j] = number if best[np.uintp(b), j] == highest[j] else brightest[j]
    for b in range(blocks):
        for i in range(pairs):
            j = np.uintp(i)
            bright[j] += np.uint16(best[np.uintp(b), j] > level[j])
    return lowest, highest, brightest, bright


@part
def _darkest(signal: npt.NDArray[Any], from_px: int, to_px: int, lowest: npt.NDArray[Any]) -> None:
    """``lowest`` (pairs,): the best score of the darkest few columns, for every pair of rows."""
    height, width = signal.shape[0], to_px - from_px
    part = max(1, min(_PART, width // 4))
    for pair in range(len(lowest)):
        row = min(2 * pair, max(height - 2, 0))
        here, under = signal[row], signal[min(row + 1, height - 1)]
        for first in range(from_px, to_px - part + 1, part):
            top = min(here[first], under[first])
            for j in range(first + 1, first + part):
                top = max(top, min(here[j], under[j]))
            lowest[pair] = min(lowest[pair], top)
