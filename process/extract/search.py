"""Where the stripe is in each row: the first, coarse step of every method.

The score of a pixel is the least of itself and its two vertical neighbours: a hot pixel has dark ones,
a stripe does not. Where a stripe ends, jumps or runs steeply its own neighbours are dark as well; there
the least of two horizontal neighbours tells it from a hot pixel, and a stripe close by in a row above
or below confirms it. Frames are given with the stripe across the rows (vertical).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import inlined, kernel, part
from .blocks import BLOCK, SECOND, ranked_blocks

Ints = npt.NDArray[np.int64]

#: A vertical score is believed at once when it is at least this share of what the row above showed;
#: else, or where it is below the threshold, the row is searched for a steep stripe or an end as well.
_AGREES = 0.5
#: Half the width about the brightest place that belongs to the same stripe, in px.
_OWN = 16
#: What was seen beside a stripe holds for the next row as well, if it lies within so many px; so
#: many samples are looked at on either side, a block's and those by which it may have moved.
_DRIFT, _BESIDE = 2, 96
#: How often the next brightest place is tried when the brightest is a hot pixel.
_TRIES = 6


@kernel
def find_peaks(
    signal: npt.NDArray[Any], from_px: int, to_px: int, base_dn: float
) -> tuple[Ints, npt.NDArray[np.bool_]]:
    """As :func:`peaks_within`."""
    return peaks_within(signal, from_px, to_px, base_dn)


@part
def peaks_within(
    signal: npt.NDArray[Any], from_px: int, to_px: int, base_dn: float
) -> tuple[Ints, npt.NDArray[np.bool_]]:
    """The brightest stripe of each row: its rough position (H,), -1 for none; and whether there is a
    second.

    ``signal`` is (H, W); columns [from_px, to_px) are looked at; what is not half of ``base_dn`` above
    the darkest block of its row is no stripe.
    """
    height = signal.shape[0]
    peak = np.full(height, -1, np.int64)
    second = np.zeros(height, np.bool_)
    best, lowest, highest, brightest, bright = ranked_blocks(signal, from_px, to_px)
    before_dn, before = 0.0, -1
    seen_row, seen_at, seen_level, seen = -1, 0, 0.0, False
    for row in range(height):
        pair = row >> 1
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        # The floor is the best score of the darkest block, so a little noise above the background.
        floor, top = float(lowest[pair]), float(highest[pair])
        found = -1
        if top - floor >= max(base_dn, _AGREES * before_dn) and height > 1:
            first = from_px + int(brightest[pair]) * BLOCK
            found = _position(signal, above, row, below, first, to_px, top, floor, before)
        if found < 0:
            found, top = _search_row(signal, above, row, below, from_px, to_px, floor, 0.5 * base_dn)
        if found < 0:
            before_dn, before = 0.0, -1
            continue
        peak[row] = before = found
        before_dn = max(float(signal[row, found]), top) - floor
        level = floor + SECOND * (top - floor)
        own = 0
        near_first = (max(found - _OWN, from_px) - from_px) // BLOCK
        near_last = (min(found + _OWN, to_px - 1) - from_px) // BLOCK
        for b in range(near_first, near_last + 1):
            own += best[b, pair] > level
        # A second stripe shows in both rows of a pair: what the first of them tells, the other need not
        # be asked.
        if row & 1 == 0 or seen_row != row - 1 or abs(found - seen_at) > _DRIFT or level < seen_level:
            seen = _bright_beside(signal, row, from_px, to_px, found, level)
            seen_row, seen_at, seen_level = row, found, level
        if bright[pair] > own or seen:
            second[row] = _elsewhere(signal, above, row, below, from_px, to_px, found, level)
    return peak, second


@inlined
def _position(
    signal: npt.NDArray[Any],
    above: int,
    row: int,
    below: int,
    first: int,
    to_px: int,
    top: float,
    floor: float,
    before: int,
) -> int:
    """Where, in the block from ``first`` on, the row's score is about ``top``; -1 if nowhere.

    A place beside the one of the row before serves as well when it is nearly as bright: the methods
    find the centre themselves. Of a plateau, as clipped stripes have, the middle.
    """
    up, here, down = np.uintp(above), np.uintp(row), np.uintp(below)
    last = min(first + BLOCK, to_px)
    close, least = floor + 0.5 * (top - floor), floor + 0.25 * (top - floor)
    if first < before < last - 1:
        score, at = -np.inf, before
        for place in range(before - 1, before + 2):
            k = np.uintp(place)
            value = float(min(min(signal[up, k], signal[here, k]), signal[down, k]))
            if value > score:
                score, at = value, place
        # A narrow stripe that slopes loses most of its height to the least of three rows, not of two.
        if (
            score >= least
            and float(min(signal[here, at], max(signal[up, at], signal[down, at]))) >= close
        ):
            return at
    score, at = -np.inf, first
    for place in range(first, last):
        k = np.uintp(place)
        value = float(min(min(signal[up, k], signal[here, k]), signal[down, k]))
        if value > score:
            score, at = value, place
    if score < least or float(min(signal[here, at], max(signal[up, at], signal[down, at]))) < close:
        return -1
    end = at
    while end + 1 < to_px:
        k = np.uintp(end + 1)
        if float(min(min(signal[up, k], signal[here, k]), signal[down, k])) < score:
            break
        end += 1
    return (at + end) // 2


@part
def _search_row(
    signal: npt.NDArray[Any],
    above: int,
    row: int,
    below: int,
    from_px: int,
    to_px: int,
    floor: float,
    least_dn: float,
) -> tuple[int, float]:
    """Position of the brightest stripe of one row, or -1, and its score: the whole row is looked at."""
    up, here, down = signal[above], signal[row], signal[below]
    top, pair = _best_score(signal, above, row, below, from_px, to_px), _best_pair(here, from_px, to_px)
    if max(top, pair) - floor < least_dn:
        return -1, floor
    alone = signal.shape[0] == 1
    if alone or top - floor < _AGREES * (pair - floor):
        at = _steep(signal, row, from_px, to_px, floor, floor if alone else top, least_dn)
        if at >= 0:
            return at, float(here[at])
    if alone or top - floor < least_dn:
        return -1, floor
    at = from_px
    while min(min(up[at], here[at]), down[at]) < top:
        at += 1
    end = at
    while end + 1 < to_px and min(min(up[end + 1], here[end + 1]), down[end + 1]) >= top:
        end += 1
    return (at + end) // 2, top


@part
def _bright_beside(
    signal: npt.NDArray[Any], row: int, from_px: int, to_px: int, peak: int, level: float
) -> bool:
    """Whether a sample beside the stripe, up to a block's length away, is above ``level``."""
    here = np.uintp(row)
    low, high = peak - _OWN + _DRIFT, peak + _OWN - _DRIFT
    if low - _BESIDE < from_px or high + _BESIDE >= to_px:
        for j in range(max(low - _BESIDE, from_px), min(high + _BESIDE + 1, to_px)):
            if (j < low or j > high) and signal[here, j] > level:
                return True
        return False
    left, right = np.uintp(low - _BESIDE), np.uintp(high + 1)
    top = signal[here, left]
    for i in range(_BESIDE):
        one, other = signal[here, left + np.uintp(i)], signal[here, right + np.uintp(i)]
        one = one if one > other else other
        top = one if one > top else top
    return float(top) > level


@part
def _elsewhere(
    signal: npt.NDArray[Any],
    above: int,
    row: int,
    below: int,
    from_px: int,
    to_px: int,
    peak: int,
    level: float,
) -> bool:
    """Whether a place that does not belong to the stripe about ``peak`` has a score above ``level``."""
    up, here, down = signal[above], signal[row], signal[below]
    low = high = peak
    while low > from_px and min(min(up[low - 1], here[low - 1]), down[low - 1]) > level:
        low -= 1
    while high < to_px - 1 and min(min(up[high + 1], here[high + 1]), down[high + 1]) > level:
        high += 1
    # The stripe reaches as far as its score stays above the level, and its skirt a little further.
    low, high = low - _OWN // 2, high + _OWN // 2
    low, high = max(low, from_px), min(high + 1, to_px)
    if low > from_px and _best_score(signal, above, row, below, from_px, low) > level:
        return True
    return high < to_px and _best_score(signal, above, row, below, high, to_px) > level


@part
def _best_score(
    signal: npt.NDArray[Any], above: int, row: int, below: int, start: int, stop: int
) -> float:
    """Best vertical score of columns [start, stop) of a row; start < stop."""
    up, here, down = signal[above], signal[row], signal[below]
    first = np.uintp(start)
    top = here[first]
    top = top if top < up[first] else up[first]
    top = top if top < down[first] else down[first]
    for i in range(stop - start):
        k = first + np.uintp(i)
        least = here[k] if here[k] < up[k] else up[k]
        least = least if least < down[k] else down[k]
        top = least if least > top else top
    return float(top)


@part
def _best_pair(here: npt.NDArray[Any], start: int, stop: int) -> float:
    """Best of the lesser of two neighbours in columns [start, stop) of a row; start < stop."""
    first = np.uintp(start)
    if stop - start < 2:
        return float(here[first])
    top = here[first]
    top = top if top < here[first + np.uintp(1)] else here[first + np.uintp(1)]
    for i in range(stop - start - 1):
        one, other = here[first + np.uintp(i)], here[first + np.uintp(i) + np.uintp(1)]
        least = one if one < other else other
        top = least if least > top else top
    return float(top)


@part
def _steep(
    signal: npt.NDArray[Any],
    row: int,
    from_px: int,
    to_px: int,
    floor: float,
    top: float,
    least_dn: float,
) -> int:
    """Position of a stripe that its vertical neighbours do not confirm, else -1.

    ``top`` is the row's best vertical score: fainter places than twice that are not of interest.
    """
    here = signal[row]
    limit = np.inf
    for _ in range(_TRIES):
        # The brightest pair below the last one that was refused.
        best, at = -np.inf, -1
        for i in range(from_px, to_px - 1):
            value = float(min(here[i], here[i + 1]))
            if value > best and value < limit:
                best, at = value, i
        if at < 0 or best - floor < least_dn or best - floor < (top - floor) / _AGREES:
            break
        if here[at + 1] > here[at]:
            at += 1
        if _confirmed(signal, row, from_px, to_px, at, floor):
            return at
        limit = best
    return -1


@part
def _confirmed(
    signal: npt.NDArray[Any], row: int, from_px: int, to_px: int, at: int, floor: float
) -> bool:
    """Whether the bright pair at ``at`` is a stripe: by itself, or by a neighbour in reach.

    By itself when it is four samples wide, which hot pixels hardly ever are, or three that look like a
    summit.
    """
    here = signal[row]
    level = floor + 0.3 * (float(here[at]) - floor)
    low, high = at, at
    while low > from_px and float(here[low - 1]) > level:
        low -= 1
    while high < to_px - 1 and float(here[high + 1]) > level:
        high += 1
    wide = high - low + 1
    if wide >= 4 or (wide == 3 and _summit(here, low + 1, from_px, to_px, floor)):
        return True
    reach = 4 + 2 * wide
    for other in (row - 1, row + 1):
        if other < 0 or other >= signal.shape[0]:
            continue
        line = signal[other]
        for j in range(max(from_px, low - reach), min(to_px - 1, high + reach)):
            if float(min(line[j], line[j + 1])) > level:
                return True
    return False


@part
def _summit(here: npt.NDArray[Any], at: int, from_px: int, to_px: int, floor: float) -> bool:
    """Whether three samples about ``at`` are a Gaussian's: they then tell the two beside them."""
    if at - 2 < from_px or at + 2 >= to_px:
        return False
    left, top, right = float(here[at - 1]) - floor, float(here[at]) - floor, float(here[at + 1]) - floor
    if not (left > 0.0 and right > 0.0 and top > left and top > right):
        return False
    # The third difference of a Gaussian's logarithm is nothing.
    cube = top * top * top
    beyond, before = right * right * right * left / cube, left * left * left * right / cube
    off = max(abs(float(here[at + 2]) - floor - beyond), abs(float(here[at - 2]) - floor - before))
    return off < 0.15 * top


@part
def second_try(signal: npt.NDArray[Any], row: int, from_px: int, to_px: int) -> int:
    """The brightest place of a row that is two columns wide, so no single hot column; or -1."""
    height = signal.shape[0]
    up, here, down = signal[max(row - 1, 0)], signal[row], signal[min(row + 1, height - 1)]
    if height == 1 or to_px - from_px < 4:
        return -1
    best, at = -np.inf, -1
    before = min(min(up[from_px], here[from_px]), down[from_px])
    for j in range(from_px + 1, to_px):
        score = min(min(up[j], here[j]), down[j])
        value = float(min(before, score))
        if value > best:
            best, at = value, j if score > before else j - 1
        before = score
    return at
