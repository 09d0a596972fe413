"""The paper's method: Gaussian fit between the extrema of the grey gradient.

Xiao et al. 2015, section 3.2.2: samples above Gbase; the gradient is the difference of adjacent
samples; those between its maximum and its minimum are fitted with ln f = a0 + a1 x + a2 x^2 by least
squares (formulas 20-25); the centre is -a1 / (2 a2) (formula 26).
"""

from __future__ import annotations

import numpy as np

from .search import Floats, Stripes

_LEAST = 3


def varied_boundary(stripes: Stripes, noise: float, base_dn: float) -> tuple[Floats, Floats, Floats]:
    """Centres (N,), their standard deviation, and the fitted widths; NaN where there is no fit.

    No fit: fewer than three samples between the bounds, bounds in the wrong order, or a parabola that
    does not open downwards with its vertex between the bounds, or is so flat that the vertex is less
    certain than the stretch is long (a clipped stripe, as a rule). x is
    taken from the peak and the normal equations are solved by Cramer's rule, which is exact to
    rounding for such short stretches; the paper solves the same equations by Householder's method.
    """
    f = stripes.samples
    bright = stripes.inside & (f - stripes.background_dn[:, None] > base_dn)
    step = f[:, 1:] - f[:, :-1]
    # The difference of two samples counts when either is above Gbase: the bounds are its flanks.
    counts = (bright[:, 1:] | bright[:, :-1]) & stripes.inside[:, 1:] & stripes.inside[:, :-1]
    rise = np.where(counts, step, -np.inf).argmax(axis=1)
    fall = np.where(counts, step, np.inf).argmin(axis=1)
    index = np.arange(f.shape[1])
    # Both samples of either extreme difference belong to the stretch.
    use = (index >= rise[:, None]) & (index <= fall[:, None] + 1) & bright & (f > 0)
    x = np.where(use, stripes.positions(), 0.0)
    log = np.log(np.where(use, f, 1.0))
    count = use.sum(axis=1).astype(np.float64)
    s1, s2, s3, s4 = ((x**p).sum(axis=1) for p in (1, 2, 3, 4))
    t0, t1, t2 = ((log * x**p).sum(axis=1) for p in (0, 1, 2))
    with np.errstate(all="ignore"):
        det = count * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s2 * s3) + s2 * (s1 * s3 - s2 * s2)
        a1 = (count * (t1 * s4 - t2 * s3) - t0 * (s1 * s4 - s2 * s3) + s2 * (s1 * t2 - s2 * t1)) / det
        a2 = (count * (s2 * t2 - s3 * t1) - s1 * (s1 * t2 - s2 * t1) + t0 * (s1 * s3 - s2 * s2)) / det
        offset = -a1 / (2.0 * a2)
        first = np.where(use, x, np.inf).min(axis=1, initial=np.inf)
        last = np.where(use, x, -np.inf).max(axis=1, initial=-np.inf)
        good = (count >= _LEAST) & (a2 < 0) & (offset >= first) & (offset <= last)
        sigma = _sigma(x, f, use, offset, (count, s1, s2, s3, s4), det, a2, noise)
        width = np.sqrt(-0.5 / a2)
        # A nearly flat parabola has its vertex anywhere: the fit knows that by its own deviation.
        good &= sigma <= last - first
    nan = np.float64(np.nan)
    return (
        np.where(good, stripes.peak + offset, nan),
        np.where(good, sigma, nan),
        np.where(good, width, nan),
    )


def _sigma(
    x: Floats,
    f: Floats,
    use: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    offset: Floats,
    sums: tuple[Floats, ...],
    det: Floats,
    a2: Floats,
    noise: float,
) -> Floats:
    """First-order standard deviation of -a1 / (2 a2), the noise of ln f being s / f.

    With N the normal matrix, da = N^-1 sum(v e / f), v = (1, x, x^2); so each sample moves the centre
    by g = -(c1 + 2 offset c2) / (2 a2) times e / f, with (c1, c2) rows 1 and 2 of N^-1 v.
    """
    count, s1, s2, s3, s4 = sums
    # Rows 1 and 2 of the inverse of [[n s1 s2] [s1 s2 s3] [s2 s3 s4]], times its determinant.
    r1 = (s2 * s3 - s1 * s4, count * s4 - s2 * s2, s1 * s2 - count * s3)
    r2 = (s1 * s3 - s2 * s2, s1 * s2 - count * s3, count * s2 - s1 * s1)
    c1 = r1[0][:, None] + r1[1][:, None] * x + r1[2][:, None] * x * x
    c2 = r2[0][:, None] + r2[1][:, None] * x + r2[2][:, None] * x * x
    gain = -(c1 + 2.0 * offset[:, None] * c2) / (2.0 * a2 * det)[:, None]
    share = np.where(use, gain / np.where(use, f, 1.0), 0.0)
    return noise * np.sqrt((share**2).sum(axis=1))
