"""The filters of denoise.py in a stretch of each row alone: the same numbers in less time."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ..schemas.recipe import Denoise
from .compiled import kernel, part
from .denoise import denoise

Ints = npt.NDArray[np.int64]

#: Stretches are worked on in whole multiples of this many pixels, a vector register of 8 bit samples.
_LANE: Final = 32


def filter_windows(
    frame: npt.NDArray[Any],
    steps: list[tuple[str, int]],
    first: Ints,
    last: Ints,
    *,
    in_place: bool = False,
    transposed: bool = False,
) -> npt.NDArray[Any]:
    """``frame`` (H, W), uint8 or uint16, with columns [first, last) (H,) of each row filtered.

    ``steps`` are ("gaussian" or "median", half size in px) in their order. What a later step needs of
    an earlier one beyond the stretch is made as well, so that every stretch holds the very numbers
    that filtering the whole frame would give, borders included. All else is as it was. ``in_place``
    writes into ``frame`` itself instead of a copy, which for large frames takes longer than the filter;
    ``transposed`` says that ``frame`` is a frame with its rows for columns, and so is the result.
    """
    height, width = frame.shape
    frame = np.ascontiguousarray(frame)
    stretches = [joined(first, last, 0, width)]
    for _, half in steps[:0:-1]:
        stretches.append(joined(*stretches[-1], half, width))
    begin, end = stretches[0]
    now = frame
    for (name, half), (low, high) in zip(steps, stretches[::-1], strict=True):
        # Only the stretches of this buffer are written and read: the rest of it costs nothing.
        out = np.empty((height, width), frame.dtype)
        if name == "gaussian":
            ups = _rounds_up(height if transposed else width, frame.dtype.char)
            none = np.zeros(width if transposed else height, np.uint8)
            _gaussian(now, low, high, ups if transposed else none, none if transposed else ups, out)
        elif half == 1:
            _median_3(now, low, high, out)
        else:
            _median(now, low, high, half, _comparators((2 * half + 1) ** 2), out)
        now = out
    target = frame if in_place else frame.copy()
    _put(now, begin, end, target)
    return target


@kernel
def joined(first: Ints, last: Ints, half: int, width: int) -> tuple[Ints, Ints]:
    """The stretches, joined with those of the rows up to ``half`` above and below, ``half`` wider."""
    height = len(first)
    begin, end = np.full(height, width, np.int64), np.zeros(height, np.int64)
    for row in range(height):
        if last[row] <= first[row]:
            continue
        for other in range(max(row - half, 0), min(row + half, height - 1) + 1):
            begin[other] = min(begin[other], max(first[row] - half, 0))
            end[other] = max(end[other], min(last[row] + half, width))
    return begin, end


@cache
def _rounds_up(width: int, kind: str) -> npt.NDArray[np.uint8]:
    """Columns (W,) where OpenCV's own Gaussian filter rounds halves up (1) and not to even (0).

    In 8 bit its vector code does the one and the scalar rest of a row the other, so that columns differ
    and the width decides, perhaps the processor too: OpenCV is asked. A row of 2 below a row of 0 gives
    one half everywhere.
    """
    rows = np.zeros((3, width), kind)
    rows[2] = 2
    return denoise(rows, Denoise(method="gaussian"))[1].astype(np.uint8)


@cache
def _comparators(count: int) -> npt.NDArray[np.int64]:
    """Pairs (N, 2) of a network that brings the median of ``count`` values to the middle.

    Batcher's merge exchange (Knuth, The Art of Computer Programming 3, 5.2.2, algorithm M), without the
    comparators that the middle does not depend on.
    """
    pairs: list[tuple[int, int]] = []
    top = p = 1 << ((count - 1).bit_length() - 1)
    while p:
        q, r, d = top, 0, p
        while True:
            pairs += [(i, i + d) for i in range(count - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2
    wanted, kept = {count // 2}, []
    for low, high in reversed(pairs):
        if low in wanted or high in wanted:
            wanted |= {low, high}
            kept.append((low, high))
    return np.array(kept[::-1], np.int64)


@kernel
def _put(source: npt.NDArray[Any], first: Ints, last: Ints, target: npt.NDArray[Any]) -> None:
    """Copy the stretches."""
    for row in range(len(first)):
        start = np.uintp(first[row])
        here, there = source[row], target[row]
        for j in range(last[row] - first[row]):
            there[start + np.uintp(j)] = here[start + np.uintp(j)]


@part
def _repeated(column: int, width: int) -> int:
    """The column that stands for one beyond a border: the border's own."""
    return min(max(column, 0), width - 1)


@part
def _mirrored(column: int, width: int) -> int:
    """The column that stands for one beyond a border by one: its mirror image."""
    if width > 1:
        if column < 0:
            return 1
        if column >= width:
            return width - 2
    return min(max(column, 0), width - 1)


@part
def _room(first: Ints, last: Ints, half: int) -> int:
    """Length of the longest stretch with ``half`` on either side, in whole vectors."""
    longest = 0
    for row in range(len(first)):
        longest = max(longest, last[row] - first[row])
    return (longest + 2 * half + _LANE - 1) // _LANE * _LANE


@kernel
def _median_3(frame: npt.NDArray[Any], first: Ints, last: Ints, out: npt.NDArray[Any]) -> None:
    """Median of 3 x 3; beyond a border its pixels are repeated, as in cv2.medianBlur."""
    height, width = frame.shape
    room = _room(first, last, 1)
    edge, columns = np.empty((3, room), frame.dtype), np.empty((3, room), frame.dtype)
    for row in range(height):
        begin, length = first[row], last[row] - first[row]
        if length <= 0:
            continue
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        if begin > 0 and begin + length < width:
            _median_3_row(frame, above, row, below, begin - 1, length, columns, out, row, begin)
            continue
        for j in range(length + 2):
            k = _repeated(begin - 1 + j, width)
            edge[0, j], edge[1, j], edge[2, j] = frame[above, k], frame[row, k], frame[below, k]
        _median_3_row(edge, 0, 1, 2, 0, length, columns, out, row, begin)


@part
def _median_3_row(
    frame: npt.NDArray[Any],
    above: int,
    middle: int,
    below: int,
    start: int,
    length: int,
    columns: npt.NDArray[Any],
    out: npt.NDArray[Any],
    row: int,
    begin: int,
) -> None:
    """The median of the greatest least, the middle middle and the least greatest of three columns."""
    # Whole arrays are handed over and views taken here: views as arguments cost more than the filter.
    up, here, down, target = frame[above], frame[middle], frame[below], out[row]
    low, mid, top = columns[0], columns[1], columns[2]
    source, at = np.uintp(start), np.uintp(begin)
    for j in range(length + 2):
        n = np.uintp(j)
        a, b, c = up[source + n], here[source + n], down[source + n]
        less, more = a if a < b else b, b if a < b else a
        rest = more if more < c else c
        top[n] = c if more < c else more
        low[n] = less if less < rest else rest
        mid[n] = rest if less < rest else less
    for j in range(length):
        n, n1, n2 = np.uintp(j), np.uintp(j) + np.uintp(1), np.uintp(j) + np.uintp(2)
        a = low[n] if low[n] > low[n1] else low[n1]
        a = a if a > low[n2] else low[n2]
        c = top[n] if top[n] < top[n1] else top[n1]
        c = c if c < top[n2] else top[n2]
        p, q, r = mid[n], mid[n1], mid[n2]
        less, more = p if p < q else q, q if p < q else p
        rest = more if more < r else r
        b = less if less > rest else rest
        less, more = a if a < b else b, b if a < b else a
        rest = more if more < c else c
        target[at + n] = less if less > rest else rest


@kernel
def _median(
    frame: npt.NDArray[Any], first: Ints, last: Ints, half: int, pairs: Ints, out: npt.NDArray[Any]
) -> None:
    """Median of (2 half + 1)^2 pixels by a sorting network that works on whole stretches at once.

    Lane i of the scratch holds the i-th neighbour of every pixel, and each comparator is a minimum and
    a maximum of two lanes. Beyond a border its pixels are repeated, as in cv2.medianBlur.
    """
    height, width = frame.shape
    size = 2 * half + 1
    lanes = np.zeros((size * size, _room(first, last, half)), frame.dtype)
    for row in range(height):
        begin, length = first[row], last[row] - first[row]
        if length <= 0:
            continue
        inside = begin >= half and begin + length + half <= width
        for dy in range(size):
            line = frame[min(max(row + dy - half, 0), height - 1)]
            for dx in range(size):
                lane, start = lanes[dy * size + dx], begin + dx - half
                if inside:
                    for j in range(length):
                        lane[np.uintp(j)] = line[np.uintp(start) + np.uintp(j)]
                else:
                    for j in range(length):
                        lane[j] = line[_repeated(start + j, width)]
        # Whole vectors: what lies behind a stretch is sorted along and not looked at.
        used = (length + _LANE - 1) // _LANE
        for n in range(len(pairs)):
            less, more = lanes[pairs[n, 0]], lanes[pairs[n, 1]]
            for j in range(used * _LANE):
                k = np.uintp(j)
                one, other = less[k], more[k]
                less[k] = one if one < other else other
                more[k] = other if one < other else one
        middle, target, at = lanes[size * size // 2], out[row], np.uintp(begin)
        for j in range(length):
            target[at + np.uintp(j)] = middle[np.uintp(j)]


@kernel
def _gaussian(
    frame: npt.NDArray[Any],
    first: Ints,
    last: Ints,
    up_rows: npt.NDArray[np.uint8],
    up_columns: npt.NDArray[np.uint8],
    out: npt.NDArray[Any],
) -> None:
    """Formula (12); borders are mirrored without repeating the border's own pixels.

    In the rows and columns that ``up_rows`` (H,) and ``up_columns`` (W,) mark halves are rounded up.
    """
    height, width = frame.shape
    room = _room(first, last, 1)
    edge, columns = np.empty((3, room), frame.dtype), np.empty(room, np.uint32)
    for row in range(height):
        begin, length = first[row], last[row] - first[row]
        if length <= 0:
            continue
        above, below = _mirrored(row - 1, height), _mirrored(row + 1, height)
        if begin > 0 and begin + length < width:
            _gaussian_row(
                frame,
                above,
                row,
                below,
                begin - 1,
                length,
                columns,
                up_rows,
                up_columns,
                out,
                row,
                begin,
            )
            continue
        for j in range(length + 2):
            k = _mirrored(begin - 1 + j, width)
            edge[0, j], edge[1, j], edge[2, j] = frame[above, k], frame[row, k], frame[below, k]
        _gaussian_row(edge, 0, 1, 2, 0, length, columns, up_rows, up_columns, out, row, begin)


@part
def _gaussian_row(
    frame: npt.NDArray[Any],
    above: int,
    middle: int,
    below: int,
    start: int,
    length: int,
    columns: npt.NDArray[np.uint32],
    up_rows: npt.NDArray[np.uint8],
    up_columns: npt.NDArray[np.uint8],
    out: npt.NDArray[Any],
    row: int,
    begin: int,
) -> None:
    """One stretch of a row: sums down the columns, then along the row."""
    up, here, down, target = frame[above], frame[middle], frame[below], out[row]
    source, at, up_row = np.uintp(start), np.uintp(begin), np.uint32(up_rows[row])
    for j in range(length + 2):
        n = np.uintp(j)
        k = source + n
        columns[n] = np.uint32(up[k]) + (np.uint32(here[k]) << np.uint32(1)) + np.uint32(down[k])
    for j in range(length):
        n, n1, n2 = np.uintp(j), np.uintp(j) + np.uintp(1), np.uintp(j) + np.uintp(2)
        total = np.uint32(columns[n] + (columns[n1] << np.uint32(1)) + columns[n2])
        # Adding 8 rounds halves up; adding 7 to an even and 8 to an odd number rounds them to even.
        odd = np.uint32(
            ((total >> np.uint32(4)) & np.uint32(1)) | up_row | np.uint32(up_columns[at + n])
        )
        target[at + n] = np.uint32(total + np.uint32(7) + odd) >> np.uint32(4)
