"""Ridge of the frame, by the derivatives of a Gaussian.

C. Steger, "An unbiased detector of curvilinear structures", IEEE Transactions on Pattern Analysis and
Machine Intelligence 20 (1998) 113-125. The frame is smoothed by a Gaussian and differentiated; across
a bright line the second derivative is most negative, along the eigenvector n of the Hessian matrix H;
there the first derivative vanishes t n away from the pixel, t = -(n . grad) / (n . H n).

The ridge is two-dimensional, a stripe point belongs to a row. The line runs across n: from the point
t n it meets the pixel's own row at u = x + t / n_x. The smoothing takes in the rows above and below:
straight stripes come out better than one row allows, and steps and ends are rounded off.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import kernel, part
from .rows import (
    CENTRE,
    CUT_FIRST,
    FLAGS,
    HALF_FIRST,
    HALF_LAST,
    LEFT,
    ROW,
    SIGMA,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

_EDGE = int(Flag.EDGE)
_ROOT_2, _ROOT_2_PI = math.sqrt(2.0), math.sqrt(2.0 * math.pi)
#: Kernels reach this many standard deviations; their ends hold what lies beyond.
_REACH = 4.0
#: Narrower kernels are undersampled.
_NARROWEST = 1.0
#: How many pixels from the middle at half height the ridge is looked for.
_STEPS: Final = 3
#: A pixel that has the ridge so near has it for its own; else its neighbour is asked.
_OWN = 0.25
#: Least component of n along the row: a ridge that runs along the row crosses it anywhere.
_ACROSS = 0.25
#: Second derivatives stand for the whole profile: over all places in a pixel that moves the centre by
#: 0.047 / W^2 px (standard deviation), W^2 being the sum of the squares of the stripe's and kernel's
#: widths.
_PHASE = 0.047
#: What clipping adds to the deviation, in px: root mean square over simulated stripes of 1 to 6 px that
#: were clipped at a sixth to four fifths of their height.
_CLIPPED = 0.02


def steger(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the ridge of every stripe at its rows; arguments as in ``fused.fused``.

    The kernel's standard deviation is the median width of the frame's stripe, see :func:`kernel_px`.
    Points whose kernel reaches over the frame's border by more than half (2 standard deviations) are
    flagged as EDGE. The deviation is first-order noise of the gradient, and what the smoothing does
    to a curved, stepped or ending stripe, as far as the centres show it. Neighbouring rows are
    correlated.
    """
    count, _, marks, values = gather(signal, raw, peaks, limits, noise, clip_dn)
    if count == 0:
        return 0
    sigma = kernel_px(float(np.median(values[:count, WIDTH])))
    _steger(signal, limits[0], limits[1], count, marks, values, noise, sigma, derivatives(sigma))
    return int(fill(count, marks, values, out))


def kernel_px(width_px: float) -> float:
    """Standard deviation of the kernel for a stripe whose own is ``width_px``.

    Steger demands at least w / sqrt(3) for a bar of half-width w, which is the standard deviation of
    the bar: so the stripe's own, which also is the matched filter. At least 1 px.
    """
    return max(width_px, _NARROWEST)


def derivatives(sigma_px: float) -> Floats:
    """(3, 2 R + 1): a Gaussian and its first two derivatives, integrated over the pixels.

    To be multiplied with the samples from -R to R and added up. Without the tails a constant would have
    derivatives: the outermost ones hold them.
    """
    reach = math.ceil(_REACH * sigma_px)
    edges = np.arange(-reach, reach + 2) - 0.5
    bell = np.exp(-0.5 * (edges / sigma_px) ** 2) / (math.sqrt(2.0 * math.pi) * sigma_px)
    slope = -edges / sigma_px**2 * bell
    area = np.array([0.5 * math.erfc(-e / (sigma_px * math.sqrt(2.0))) for e in edges])
    area[[0, -1]] = 0.0, 1.0
    bell[[0, -1]] = slope[[0, -1]] = 0.0
    return np.stack([np.diff(area), -np.diff(bell), np.diff(slope)])


@kernel
def _steger(
    signal: npt.NDArray[Any],
    from_px: int,
    to_px: int,
    count: int,
    marks: Ints,
    values: Floats,
    noise: float,
    sigma: float,
    table: Floats,
) -> None:
    reach = table.shape[1] // 2
    side = reach + _STEPS
    columns = np.empty((3, 2 * side + 1), np.float64)
    # Noise of a first derivative, in that of a sample.
    gain = math.sqrt(np.sum(table[0] ** 2) * np.sum(table[1] ** 2))
    ends = _rows_to_end(count, marks)
    for i in range(count):
        row, start = marks[i, ROW], marks[i, LEFT] + (marks[i, HALF_FIRST] + marks[i, HALF_LAST]) // 2
        _along_columns(signal, row, start - side, from_px, to_px, table, columns)
        at = 0
        found, offset, bend, slant = _ridge(columns, _STEPS, table)
        while found and abs(offset) > _OWN:
            # Of two pixels that point at each other the one that is nearer to the ridge has it.
            step = 1 if offset > 0.0 else -1
            if abs(at + step) > _STEPS:
                found = abs(offset) <= 1.0
                break
            beside, back, bend_beside, slant_beside = _ridge(columns, at + step + _STEPS, table)
            if not beside:
                found = abs(offset) <= 1.0
                break
            nearer = abs(back) < abs(offset)
            if back * step > 0.0 or nearer:
                at, offset, bend, slant = at + step, back, bend_beside, slant_beside
            if back * step <= 0.0:
                found = abs(offset) <= 1.0
                break
        if not found:
            continue
        centre = start + at + offset
        width = values[i, WIDTH]
        values[i, CENTRE] = centre
        phase = _PHASE / (width * width + sigma * sigma)
        phase += _CLIPPED if marks[i, CUT_FIRST] >= 0 else 0.0
        margin = min(centre - from_px, to_px - 1.0 - centre)
        along = min(float(row), signal.shape[0] - 1.0 - row)
        # Beyond the border the last row is repeated. What lies there is pulled off a slanted stripe, by
        # sigma slant (g(d) - d Q(d)) at d = rows / sigma; the slant itself looks half as large there.
        # Beyond the end of a stripe there is nothing, which does about the same.
        d = ends[i] / sigma
        beyond = math.exp(-0.5 * d * d) / _ROOT_2_PI - 0.5 * d * math.erfc(d / _ROOT_2)
        bent = 2.0 * slant * sigma * beyond
        spread = noise * gain * math.sqrt(1.0 + slant * slant) / bend
        values[i, SIGMA] = math.sqrt(spread * spread + phase * phase + bent * bent)
        if min(margin, along) < 2.0 * sigma:
            marks[i, FLAGS] |= _EDGE
    _add_curvature(count, marks, values, sigma)


@part
def _rows_to_end(count: int, marks: Ints) -> Ints:
    """How many rows the stripe goes on for above and below each row, the lesser of the two (N,)."""
    out = np.zeros(count, np.int64)
    for i in range(1, count):
        out[i] = out[i - 1] + 1 if marks[i, ROW] - marks[i - 1, ROW] == 1 else 0
    below = 0
    for i in range(count - 1, -1, -1):
        below = below + 1 if i < count - 1 and marks[i + 1, ROW] - marks[i, ROW] == 1 else 0
        out[i] = min(out[i], below)
    return out


@part
def _add_curvature(count: int, marks: Ints, values: Floats, sigma: float) -> None:
    """Add what the smoothing flattens: sigma^2 / 2 times the stripe's second derivative along the rows.

    That is taken from the rows two standard deviations away, and is large beside a step. In the middle
    of a step it vanishes: so the largest of the rows within one standard deviation counts.
    """
    reach, near = math.ceil(2.0 * sigma), math.ceil(sigma)
    bends = np.zeros(count, np.float64)
    for i in range(reach, count - reach):
        if marks[i + reach, ROW] - marks[i - reach, ROW] == 2 * reach:
            bend = values[i - reach, CENTRE] - 2.0 * values[i, CENTRE] + values[i + reach, CENTRE]
            # False for NaN too; math.isfinite lets it pass where sums are reordered.
            if abs(bend) < np.inf:
                bends[i] = abs(bend)
    for i in range(count):
        bend = 0.0
        for j in range(max(0, i - near), min(count, i + near + 1)):
            bend = max(bend, bends[j])
        values[i, SIGMA] = math.hypot(values[i, SIGMA], 0.5 * bend * (sigma / reach) ** 2)


@part
def _along_columns(
    signal: npt.NDArray[Any],
    row: int,
    first: int,
    from_px: int,
    to_px: int,
    table: Floats,
    out: Floats,
) -> None:
    """The three kernels along the columns from ``first`` on, at one row: (3, n); borders repeat."""
    reach, n = table.shape[1] // 2, out.shape[1]
    smooth, slope, bend = out[0], out[1], out[2]
    out[:] = 0.0
    inside = first >= from_px and first + n <= to_px
    for k in range(-reach, reach + 1):
        line = signal[min(max(row + k, 0), signal.shape[0] - 1)]
        a, b, c = table[0, k + reach], table[1, k + reach], table[2, k + reach]
        if inside:
            start = np.uintp(first)
            for j in range(n):
                place = np.uintp(j)
                sample = float(line[start + place])
                smooth[place] += a * sample
                slope[place] += b * sample
                bend[place] += c * sample
        else:
            for j in range(n):
                sample = float(line[min(max(first + j, from_px), to_px - 1)])
                smooth[j] += a * sample
                slope[j] += b * sample
                bend[j] += c * sample


@part
def _ridge(columns: Floats, first: int, table: Floats) -> tuple[bool, float, float, float]:
    """(is a ridge, offset of its crossing with the row, -eigenvalue, |n_y / n_x|) at one pixel.

    The pixel lies in the row; its kernel begins at ``first`` of ``columns``.
    """
    rx = ry = rxx = rxy = ryy = 0.0
    start = np.uintp(first)
    for j in range(table.shape[1]):
        at = np.uintp(j)
        smooth, slope, bend = columns[0, start + at], columns[1, start + at], columns[2, start + at]
        a, b, c = table[0, at], table[1, at], table[2, at]
        rx += b * smooth
        ry += a * slope
        rxx += c * smooth
        rxy += b * slope
        ryy += a * bend
    half, part = 0.5 * (rxx + ryy), 0.5 * (rxx - ryy)
    size = math.hypot(part, rxy)
    value = half - size
    # The eigenvalue of largest magnitude must be the negative one: a bright line.
    if not (half < 0.0 and size > 0.0):
        return False, 0.0, 0.0, 0.0
    # Of the two forms of the eigenvector the one that does not vanish.
    nx, ny = (part - size, rxy) if part < 0.0 else (rxy, -part - size)
    length = math.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    if abs(nx) < _ACROSS:
        return False, 0.0, 0.0, 0.0
    offset = -(rx * nx + ry * ny) / value / nx
    return True, offset, -value, abs(ny / nx)
