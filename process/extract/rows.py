"""What the methods share: the samples about each peak, and the measures taken of them.

Rows are gathered into one float64 matrix, whatever the frame's type, so that each method is compiled
once. A method fills in centres and deviations; :func:`fill` writes them out.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import kernel, part
from .median import middle_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Columns of ``marks``: the row; the frame's column of sample 0; the half-open range of samples that
#: lie in the search window; the brightest sample of the stripe; first and last sample of its run and
#: of what is above half its height; first and last clipped sample of the run (-1: none); flags.
ROW, LEFT, BEGIN, END, SUMMIT, FIRST, LAST, HALF_FIRST, HALF_LAST, CUT_FIRST, CUT_LAST, FLAGS = range(
    12
)
#: Columns of ``values``: local background, height above it, width (standard deviation, from the width
#: at half height), and what the method finds: centre (frame, NaN for none) and its deviation.
BASE, HEIGHT, WIDTH, CENTRE, SIGMA = range(5)

#: Share of its height above which samples belong to a stripe. Lower, and a glow beside the stripe pulls
#: the centre; higher, and so few samples are left that the centre moves with its place in the pixel
#: (0.045 px at 0.5 for a stripe 1.8 px wide, 0.018 px here).
RUN_LEVEL: Final = 0.3
#: Width at half height of a Gaussian, in standard deviations.
FWHM: Final = 2.0 * math.sqrt(2.0 * math.log(2.0))
#: Below this ratio of height to noise the centre is called weak.
_WEAK_BELOW = 8.0
#: So narrow a stripe has one bright sample, and nothing tells where in its pixel it lies: weak as well.
_NARROW = 0.55
#: How far from where it stands the summit is looked for, again and again until it stays.
_NEAR = 2
#: A window must reach this many standard deviations to either side, or its median is no background.
_CLEAR = 5.0
_SATURATED, _EDGE, _WEAK, _SECOND = (
    int(Flag.SATURATED),
    int(Flag.EDGE),
    int(Flag.WEAK),
    int(Flag.SECOND),
)


def gather(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
) -> tuple[int, Floats, Ints, Floats]:
    """(count, samples (N, 2 K + 1), marks (N, 12), values (N, 5)) of rows with a stripe, count <= N.

    K is max_width_px rounded up. The arguments are those of every method, see
    :func:`turnscan.process.extract.fused.fused`. What is not base_dn high above the median of its
    window is no stripe.
    """
    whole = signal.dtype.kind != "f"
    from_px, to_px, base_dn, max_width_px = limits
    return _gather(signal, raw, *peaks, from_px, to_px, base_dn, max_width_px, noise, clip_dn, whole)


@kernel
def _gather(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peak: Ints,
    second: npt.NDArray[np.bool_],
    from_px: int,
    to_px: int,
    base_dn: float,
    max_width_px: float,
    noise: float,
    clip_dn: float,
    whole: bool,
) -> tuple[int, Floats, Ints, Floats]:
    rows = 0
    for row in range(len(peak)):
        rows += peak[row] >= 0
    half = math.ceil(max_width_px)
    samples = np.empty((rows, 2 * half + 1), np.float64)
    marks, values = np.empty((rows, 12), np.int64), np.empty((rows, 5), np.float64)
    count, base = 0, 0.0
    for row in range(len(peak)):
        if peak[row] < 0:
            continue
        source = signal[row]
        place = _climb(source, peak[row], from_px, to_px)
        left = place - half
        begin, end = max(from_px, left) - left, min(to_px, place + half + 1) - left
        line, mark, value = samples[count], marks[count], values[count]
        start = np.uintp(left + begin)
        shift = np.uintp(begin)
        for j in range(end - begin):
            line[shift + np.uintp(j)] = float(source[start + np.uintp(j)])
        base = middle_of(line, begin, end, base, noise, whole)
        top, height = _top(line, begin, end, half, base)
        if not height > 0.0:
            continue
        low, high = _edges(line, begin, end, top, base + 0.5 * height)
        width = _width(line, begin, end, low, high, base + 0.5 * height)
        if width * _CLEAR > half:
            # A wide stripe covers much of its window: the background lies farther out.
            for _ in range(3):
                reach = max(half, int(min(2.0 * _CLEAR * width, float(to_px - from_px))))
                base = _far_base(
                    source, place - reach, place + reach, from_px, to_px, base, noise, whole
                )
                top, height = _top(line, begin, end, half, base)
                if not height > 0.0:
                    break
                low, high = _edges(line, begin, end, top, base + 0.5 * height)
                width = _width(line, begin, end, low, high, base + 0.5 * height)
        if not height > base_dn:
            continue
        first, last = _edges(line, begin, end, top, base + RUN_LEVEL * height)
        flags = _SECOND if second[row] else 0
        if first == begin or last == end - 1:
            flags |= _EDGE
        if height < _WEAK_BELOW * noise or width < _NARROW:
            flags |= _WEAK
        cut_first = cut_last = -1
        frame_line = raw[row]
        for j in range(first, last + 1):
            if float(frame_line[left + j]) >= clip_dn:
                cut_first = j if cut_first < 0 else cut_first
                cut_last = j
        if cut_first >= 0:
            flags |= _SATURATED
        mark[ROW], mark[LEFT], mark[BEGIN], mark[END], mark[SUMMIT] = row, left, begin, end, top
        mark[FIRST], mark[LAST], mark[HALF_FIRST], mark[HALF_LAST] = first, last, low, high
        mark[CUT_FIRST], mark[CUT_LAST], mark[FLAGS] = cut_first, cut_last, flags
        value[BASE], value[HEIGHT], value[WIDTH] = base, height, width
        value[CENTRE], value[SIGMA] = np.nan, np.nan
        count += 1
    return count, samples, marks, values


@kernel
def fill(count: int, marks: Ints, values: Floats, out: npt.NDArray[Any]) -> int:
    """Write the rows that have a centre to ``out`` (H, STRIPE_DTYPE); returns how many there are."""
    n = 0
    for i in range(count):
        # NaN is below nothing; math.isfinite lets it pass where sums are reordered.
        if not abs(values[i, CENTRE]) < np.inf:
            continue
        point = out[n]
        point.row = marks[i, ROW]
        point.u_px = values[i, CENTRE]
        point.sigma_u_px = values[i, SIGMA]
        point.amplitude_dn = values[i, HEIGHT]
        point.width_px = values[i, WIDTH]
        point.background_dn = values[i, BASE]
        point.flags = marks[i, FLAGS]
        n += 1
    return n


@part
def _climb(line: npt.NDArray[Any], at: int, from_px: int, to_px: int) -> int:
    """The brightest sample near ``at``, and near that one, until there is none brighter."""
    while True:
        best = at
        for j in range(max(from_px, at - _NEAR), min(to_px, at + _NEAR + 1)):
            if line[j] > line[best]:
                best = j
        if best == at:
            return at
        at = best


@part
def _top(line: Floats, begin: int, end: int, place: int, base: float) -> tuple[int, float]:
    """Brightest sample of the stripe about ``place``, of all above half its height; and its height."""
    first, last = _edges(line, begin, end, place, base + 0.5 * (line[place] - base))
    top = first
    for j in range(first, last + 1):
        top = j if line[j] > line[top] else top
    return top, line[top] - base


@part
def _edges(line: Floats, begin: int, end: int, top: int, level: float) -> tuple[int, int]:
    """First and last sample of the unbroken run about ``top`` that is above ``level``."""
    first = last = top
    while first > begin and line[first - 1] > level:
        first -= 1
    while last < end - 1 and line[last + 1] > level:
        last += 1
    return first, last


@part
def _width(line: Floats, begin: int, end: int, low: int, high: int, level: float) -> float:
    """Width of the run [low, high] above ``level``, between samples, as a standard deviation in px.

    At a border, where there is no sample beyond the run, it ends half a pixel outside.
    """
    width = float(high - low)
    width += (line[low] - level) / (line[low] - line[low - 1]) if low > begin else 0.5
    width += (line[high] - level) / (line[high] - line[high + 1]) if high < end - 1 else 0.5
    return width / FWHM


@part
def _far_base(
    line: npt.NDArray[Any],
    low: int,
    high: int,
    from_px: int,
    to_px: int,
    guess: float,
    noise: float,
    whole: bool,
) -> float:
    """Median of the samples in columns [low, high] of the frame, as far as there are any."""
    low, high = max(from_px, low), min(to_px, high + 1)
    far = np.empty(high - low, np.float64)
    start = np.uintp(low)
    for j in range(high - low):
        far[np.uintp(j)] = float(line[start + np.uintp(j)])
    return middle_of(far, 0, high - low, guess, noise, whole)
