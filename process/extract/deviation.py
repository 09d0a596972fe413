"""How well a centre is known: the noise at the stripe itself, and what few samples add to it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import part
from .moments import BASE, CENTRE, CLIPPED, DONE, FAILED, HEIGHT, REST, WIDE, WIDTH
from .window import SAMPLES

Floats = npt.NDArray[np.float64]

#: Degrees of freedom of the remainder: samples less centre, width and height.
FREE = SAMPLES - 3
#: Narrower than this, in px, moments move with the phase by more than 1 % of the usual deviation.
NARROW = 1.0
#: Which of the ordered remainders tells the noise, and how far below the mean that is for a normal one.
_QUANTILE, _QUANTILE_SIGMAS = 0.2, 0.8416
#: Share of the weighted remainder that the fit itself takes away, times the width: see
#: _variance_at_flanks.
_TAKEN = 0.673
#: Samples of a stripe of the widest window, three standard deviations to either side; and some.
_MOST = 64


@part
def noise_at_stripe(
    signal: npt.NDArray[Any], found: Floats, state: npt.NDArray[np.uint8], noise: float
) -> tuple[float, float, float, float]:
    """Noise of the samples about the stripe, and noise as the centre feels it: from the remainders of
    all rows that are done, and both once more from those only whose moments are.

    Shot noise, speckle and a profile that is not Gaussian all show there, and belong into the
    deviation. Both are ``noise`` unless the remainders are clearly above it.
    """
    # Some sixty rows tell it as well as all of them.
    rest = found[REST]
    step = max(1, len(rest) // 60)
    some = np.empty(len(rest) // step + 1, np.float64)
    common = loud = common_done = loud_done = noise
    # A low quantile, since impulses hit many rows; chi-square's lies below its mean by the cube.
    spread = math.sqrt(2.0 / (9.0 * FREE))
    low = (1.0 - spread * spread - _QUANTILE_SIGMAS * spread) ** 3
    for turn in range(2):
        n = others = 0
        for row in range(0, len(rest), step):
            if state[row] == DONE or (turn == 1 and state[row] != FAILED):
                some[n] = rest[row]
                n += 1
            others += state[row] == CLIPPED or state[row] == WIDE
        if n >= 8:
            variance = np.sort(some[:n])[int(_QUANTILE * n)] / (FREE * low)
            doubt = 1.0 + 3.0 * 1.4 * math.sqrt(2.0 / FREE / n)
            if variance > noise * noise * doubt:
                common = math.sqrt(variance)
                loud = max(noise, math.sqrt(_at_flanks(signal, found, state, step, variance)))
        if turn == 0:
            common_done, loud_done = common, loud
            if others == 0:
                break
            common = loud = noise
    return common, loud, common_done, loud_done


@part
def _at_flanks(
    signal: npt.NDArray[Any],
    found: Floats,
    state: npt.NDArray[np.uint8],
    step: int,
    variance: float,
) -> float:
    """Mean variance at the flanks of some rows; ``variance`` where only clipped rows could tell it."""
    rest = found[REST]
    total, n = 0.0, 0
    shape = np.empty(_MOST, np.float64)
    for row in range(step // 2, len(rest), 2 * step):
        if state[row] == DONE and rest[row] < 2.0 * FREE * variance:
            model = (found[CENTRE, row], found[WIDTH, row], found[HEIGHT, row], found[BASE, row])
            total += _variance_at_flanks(signal[row], model, shape)
            n += 1
    return total / n if n > 0 else variance


@part
def _variance_at_flanks(
    line: npt.NDArray[Any], model: tuple[float, float, float, float], shape: Floats
) -> float:
    """Variance of the samples, weighted as they move the centre, with its squared slope.

    ``shape`` (at least as many as the samples) is memory for the Gaussian's.
    """
    centre, width, height, base = model
    first = max(0, int(centre - 3.0 * width))
    stop = min(len(line), int(centre + 3.0 * width) + 2, first + _MOST)
    # The model is near, not exact: what height, centre and width still explain is taken away first.
    g0 = g2 = g4 = r0 = r1 = r2 = 0.0
    for j in range(first, stop):
        t = (j - centre) / width
        value = math.exp(-0.5 * t * t)
        shape[j - first] = value
        rest = float(line[j]) - base - height * value
        g0 += value * value
        g2 += (t * value) ** 2
        g4 += (t * t * value) ** 2
        r0 += value * rest
        r1 += t * value * rest
        r2 += t * t * value * rest
    det = g0 * g4 - g2 * g2
    taller, moved, wider = (g4 * r0 - g2 * r2) / det, r1 / g2, (g0 * r2 - g2 * r0) / det
    total = 0.0
    for j in range(first, stop):
        t = (j - centre) / width
        value = shape[j - first]
        rest = float(line[j]) - base - value * (height + taller + t * (moved + t * wider))
        total += (t * value * rest) ** 2
    # Of the weighted remainder this fit has taken a part.
    return total / (g2 * max(1.0 - _TAKEN / width, 0.3))


@part
def add_phase_error(out: npt.NDArray[Any], count: int, state: npt.NDArray[np.uint8]) -> None:
    """Widen the deviations of the narrow stripes among the first ``count`` points."""
    for i in range(count):
        point = out[i]
        if point.width_px < NARROW and state[point.row] == DONE:
            point.sigma_u_px = math.hypot(point.sigma_u_px, _phase_error(point.width_px))


@part
def _phase_error(width: float) -> float:
    """Deviation of the moments' centre over the places in a pixel, for the narrowest window, k = 1.

    Window times stripe has the variance v = w^2 / (w^2 + 1) and is sampled at whole pixels: by
    Poisson's sum formula its mean moves by 4 pi v exp(-2 pi^2 v) sin(2 pi u), and the centre by 1 / (1
    - v) of that.
    """
    v = width * width / (width * width + 1.0)
    return 4.0 * math.pi * v * math.exp(-2.0 * math.pi**2 * v) / (1.0 - v) / math.sqrt(2.0)
