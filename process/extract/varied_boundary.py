"""The paper's method: Gaussian fit between the extrema of the grey gradient.

Xiao et al. 2015, section 3.2.2: samples above Gbase; the gradient is the difference of adjacent
samples; those between its maximum and its minimum are fitted with ln f = a0 + a1 x + a2 x^2 by least
squares (formulas 20-25); the centre is -a1 / (2 a2) (formula 26). Its deviation is 1.3 to 1.5 times
the bound, since the stretch holds 43 % of the information.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import kernel, part
from .rows import (
    BASE,
    BEGIN,
    CENTRE,
    CUT_FIRST,
    END,
    HEIGHT,
    LEFT,
    SIGMA,
    SUMMIT,
    WIDTH,
    Floats,
    Ints,
    fill,
    gather,
)

_LEAST = 3
#: What clipping adds to the deviation, in px: root mean square over simulated stripes of 1 to 6 px that
#: were clipped at a sixth to four fifths of their height.
_CLIPPED = 0.25


def varied_boundary(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    peaks: tuple[Ints, npt.NDArray[np.bool_]],
    limits: tuple[int, int, float, float],
    noise: float,
    clip_dn: float,
    out: npt.NDArray[Any],
) -> int:
    """Fill ``out`` with the paper's centre of every stripe; arguments as in ``fused.fused``.

    No fit: fewer than three samples between the bounds, bounds in the wrong order, or a parabola that
    does not open downwards with its vertex between the bounds, or is so flat that the vertex is less
    certain than the stretch is long (a clipped stripe, as a rule). x is
    taken from the peak and the normal equations are solved by Cramer's rule, which is exact to
    rounding for such short stretches; the paper solves the same equations by Householder's method.

    The deviation is first-order noise of the samples, and what the background does that the fit does
    not know of: the logarithm of stripe and background is no parabola, and its vertex moves with the
    place in the pixel, for r = background / height by 0.055 r / (r + 0.45) / sqrt(w) px (noiseless
    stripes of 1 to 5 px).
    """
    rows = gather(signal, raw, peaks, limits, noise, clip_dn)
    _varied_boundary(*rows, noise, limits[2])
    count, _, marks, values = rows
    return int(fill(count, marks, values, out))


@kernel
def _varied_boundary(
    count: int, samples: Floats, marks: Ints, values: Floats, noise: float, base_dn: float
) -> None:
    for i in range(count):
        line, mark, value = samples[i], marks[i], values[i]
        level = value[BASE] + base_dn
        steepest_rise, steepest_fall = -np.inf, np.inf
        rise = fall = -1
        for j in range(mark[BEGIN], mark[END] - 1):
            # The difference of two samples counts when either is above Gbase: the bounds are its
            # flanks.
            if line[j] > level or line[j + 1] > level:
                step = line[j + 1] - line[j]
                if step > steepest_rise:
                    steepest_rise, rise = step, j
                if step < steepest_fall:
                    steepest_fall, fall = step, j
        if rise < 0:
            continue
        # Both samples of either extreme difference belong to the stretch.
        good, offset, sigma, width = log_parabola(
            line, rise, fall + 1, max(level, 0.0), 0.0, mark[SUMMIT], noise
        )
        if good:
            value[CENTRE] = mark[LEFT] + mark[SUMMIT] + offset
            ratio = max(value[BASE], 0.0) / value[HEIGHT]
            phase = 0.055 * ratio / (ratio + 0.45) / math.sqrt(max(value[WIDTH], 0.5))
            phase += _CLIPPED if mark[CUT_FIRST] >= 0 else 0.0
            value[SIGMA], value[WIDTH] = math.hypot(sigma, phase), width


@part
def log_parabola(
    line: Floats, first: int, last: int, level: float, base: float, origin: int, noise: float
) -> tuple[bool, float, float, float]:
    """(good, vertex from ``origin``, its deviation, width) of the parabola fitted to ln(sample - base).

    Of the samples from ``first`` to ``last`` those above ``level``, which is at least ``base``, count
    alike.

    The deviation is of first order, the noise of ln f being s / f: with N the normal matrix,
    da = N^-1 sum(v e / f), v = (1, x, x^2); so each sample moves the vertex -a1 / (2 a2) by
    -(c1 + 2 vertex c2) / (2 a2) times e / f, with (c1, c2) rows 1 and 2 of N^-1 v.
    """
    bad = (False, 0.0, 0.0, 0.0)
    n = s1 = s2 = s3 = s4 = t0 = t1 = t2 = 0.0
    least, most = last + 1, first - 1
    for j in range(first, last + 1):
        if line[j] > level:
            x, y = float(j - origin), math.log(line[j] - base)
            square = x * x
            n += 1.0
            s1 += x
            s2 += square
            s3 += x * square
            s4 += square * square
            t0 += y
            t1 += x * y
            t2 += square * y
            least, most = min(least, j), max(most, j)
    if n < _LEAST:
        return bad
    det = n * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s2 * s3) + s2 * (s1 * s3 - s2 * s2)
    if not det > 0.0:
        return bad
    a1 = (n * (t1 * s4 - t2 * s3) - t0 * (s1 * s4 - s2 * s3) + s2 * (s1 * t2 - s2 * t1)) / det
    a2 = (n * (s2 * t2 - s3 * t1) - s1 * (s1 * t2 - s2 * t1) + t0 * (s1 * s3 - s2 * s2)) / det
    if not a2 < 0.0:
        return bad
    vertex = -a1 / (2.0 * a2)
    if not least - origin <= vertex <= most - origin:
        return bad
    # Row 1 plus twice the vertex times row 2 of the inverse of [[n s1 s2] [s1 s2 s3] [s2 s3 s4]].
    r0 = s2 * s3 - s1 * s4 + 2.0 * vertex * (s1 * s3 - s2 * s2)
    r1 = n * s4 - s2 * s2 + 2.0 * vertex * (s1 * s2 - n * s3)
    r2 = s1 * s2 - n * s3 + 2.0 * vertex * (n * s2 - s1 * s1)
    squares = 0.0
    for j in range(first, last + 1):
        if line[j] > level:
            x = float(j - origin)
            share = (r0 + r1 * x + r2 * x * x) / (line[j] - base)
            squares += share * share
    sigma = noise * math.sqrt(squares) / (-2.0 * a2 * det)
    # A nearly flat parabola has its vertex anywhere: the fit knows that by its own deviation.
    return sigma <= most - least, vertex, sigma, math.sqrt(-0.5 / a2)
