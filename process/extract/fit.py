"""Least-squares fit of one row, sample by sample: for rows that are clipped, struck, cut or very wide.

The model is a Gaussian on a straight background. Clipped samples say nothing and are left out: the
flanks give the centre. A median of three rows, along the stripe, only starts the fit and tells
outliers; the fit itself takes the row's own samples, so that nothing is smoothed across a depth edge.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import inlined, part
from .descent import GATE, NARROWEST, Model, descend, is_unlike
from .start import SIDE, background_of, goes_on, profile_of, start_of

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_SATURATED, _EDGE, _SECOND = int(Flag.SATURATED), int(Flag.EDGE), int(Flag.SECOND)
#: Fewer samples than this are no fit.
_LEAST = 4
#: Starts that differ by less than this share of the width in centre and width are the same.
_SAME = 0.1
#: More than this share of outliers makes a second start worth its time.
_DOUBTFUL = 0.12
#: Share of the height that is there at the centre.
_FILLED = 0.75
#: What is seen of a stripe, over the noise of a matched filter: less is found in noise alone now and
#: then.
CERTAIN = 7.0
#: How far from the centre a second stripe is looked for, in px.
_NEAR = 24

_Row = tuple[bool, float, float, float, float, float, int]
#: What is returned where nothing can be fitted.
NO_FIT: Final = (False, 0.0, 0.0, 0.0, 0.0, 0.0, 0)


@inlined
def fit_row(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    peak: int,
    span: tuple[int, int],
    limits: tuple[float, float, float, float],
    clip_dn: float,
) -> _Row:
    """(good, centre, its deviation, width, height, background, flags) of the stripe near ``peak``.

    ``span`` is the half-open range of columns that may be used, ``limits`` are base_dn, max_width_px,
    the noise under the stripe and that of the frame. ``good`` is False where no stripe can be
    fitted: too few samples, too faint, centre away from the peak or not better known than the
    stripe is wide.
    """
    from_px, to_px = span
    plain = limits[3]
    reach = int(math.ceil(2.0 * limits[1])) + SIDE
    best = NO_FIT
    for turn in range(2):
        low, high = max(from_px, peak - reach), min(to_px, peak + reach + 1)
        lines, cut = np.empty((5, high - low), np.float64), np.empty(high - low, np.bool_)
        _gather(signal, raw, row, low, clip_dn, lines, cut)
        best = _fit_within(lines, cut, peak - low, 0 < row < len(signal) - 1, limits)
        if not best[0] or 3.5 * best[3] <= reach or turn == 1:
            best = best[0], low + best[1], best[2], best[3], best[4], best[5], best[6]
            break
        # So wide that no background was seen: once more, from afar.
        reach *= 2
    good, centre, sigma, width, height, base, flags = best
    if good:
        if centre - 2.5 * width < from_px or centre + 2.5 * width > to_px - 1:
            flags |= _EDGE
        if second_near(signal[row], centre, height, base, plain, from_px, to_px):
            flags |= _SECOND
    return good, centre, sigma, width, height, base, flags


@part
def _gather(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    low: int,
    clip_dn: float,
    lines: Floats,
    cut: Bools,
) -> None:
    """The samples of the row above, the row and that below, from column ``low`` on.

    ``cut`` tells where the row's own is clipped.
    """
    start = np.uintp(low)
    for i in range(3):
        line, source = lines[i], signal[min(max(row + i - 1, 0), len(signal) - 1)]
        for j in range(len(cut)):
            line[np.uintp(j)] = float(source[start + np.uintp(j)])
    source = raw[row]
    for j in range(len(cut)):
        cut[np.uintp(j)] = float(source[start + np.uintp(j)]) >= clip_dn


@inlined
def _fit_within(
    lines: Floats, cut: Bools, top: int, inner: bool, limits: tuple[float, float, float, float]
) -> _Row:
    """The fit to gathered samples, in whose places the centre is counted.

    ``lines`` are the row above, the row, the row below, and room for a profile and distances; the peak
    is at ``top``; ``inner`` is not the first or last row.
    """
    above, here, below, profile = lines[0], lines[1], lines[2], lines[3]
    along = inner and goes_on(above, here, below, top)
    best, cost, begun = NO_FIT, np.inf, (0.0, 0.0)
    for turn in range(2):
        profile_of(above, here, below, along, profile)
        found, its_cost, strange, begun = _attempt(lines, cut, top, begun, limits)
        if turn == 0 or (found[0] and (not best[0] or its_cost < cost)):
            best, cost = found, its_cost
        if found[0] and strange <= _DOUBTFUL:
            break
        # The rows beside it may show something else after all, or better: once more the other way.
        along = not along
    return best


@part
def _attempt(
    lines: Floats,
    cut: Bools,
    place: int,
    before: tuple[float, float],
    limits: tuple[float, float, float, float],
) -> tuple[_Row, float, float, tuple[float, float]]:
    """The fit that the profile starts; its mean square remainder, each up to a gate; share of outliers;
    and the start's centre and width.

    Nothing is fitted from a start that is the one ``before``. ``limits`` are those of :func:`fit_row`,
    the rest those of :func:`_fit_within`.
    """
    base_dn, max_width, noise, plain = limits
    samples, profile = lines[1], lines[3]
    n, top = len(samples), place
    for j in range(max(0, top - 2), min(n, top + 3)):
        if profile[j] > profile[top]:
            top = j
    ok, centre, width, height, base = start_of(profile, cut, top, max_width)
    begun = (centre, width)
    bad = (NO_FIT, np.inf, 1.0, begun)
    if not ok or height < 0.5 * base_dn:
        return bad
    if abs(centre - before[0]) < _SAME * width and abs(width - before[1]) < _SAME * width:
        return bad
    half = 3.5 * width + 4.0
    base, tilt = background_of(profile, centre, width, noise, height)
    first = max(0, int(math.floor(centre - half)))
    stop = min(n, int(math.ceil(centre + half)) + 1)
    if stop - first < _LEAST:
        return bad
    rests = lines[4, : stop - first]
    begin = (centre, width, height, base, tilt)
    model, sigma, gate, flags = descend(samples, cut, profile, first, begin, noise, rests)
    centre, width, height, base, tilt = model
    if flags < 0 or not NARROWEST <= width <= max_width or not -0.5 <= centre <= n - 0.5:
        return bad
    if abs(centre - place) > 2.5 + 1.5 * width and not flags & _SATURATED:
        return bad
    if height < base_dn or not sigma < max(0.2 * width, 0.5):
        return bad
    if not flags & _SATURATED and not _filled(samples, model, plain):
        return bad
    cost, outliers, seen = _judge(rests, first, model, noise, plain, gate)
    if not seen:
        return bad
    return (True, centre, sigma, width, height, base + tilt * centre, flags), cost, outliers, begun


@part
def _filled(samples: Floats, model: Model, noise: float) -> bool:
    """Whether the centre is bright: of two stripes taken together it lies where neither is."""
    centre, _, height, base, tilt = model
    middle, summit = round(centre), -np.inf
    for j in range(max(0, middle - 1), min(len(samples), middle + 2)):
        summit = max(summit, samples[j] - base - tilt * j)
    return summit >= _FILLED * height - 2.0 * noise


@part
def _judge(
    rests: Floats, first: int, model: Model, noise: float, plain: float, gate: float
) -> tuple[float, float, bool]:
    """Mean square distance, each up to a gate; share of outliers; whether a stripe is seen at all."""
    centre, width, height, _, _ = model
    cost, energy, n, outliers = 0.0, 0.0, 0, 0
    for j in range(len(rests)):
        rest = rests[j]
        if rest >= 0.0:
            cost += min(rest * rest, GATE * GATE * noise * noise)
            n += 1
            if rest > gate:
                outliers += 1
            else:
                t = (first + j - centre) / width
                energy += (height * math.exp(-0.5 * t * t)) ** 2
    seen = not is_unlike(rests, height, noise) and energy >= (CERTAIN * plain) ** 2
    return cost / max(n, 1), outliers / max(n, 1), seen


@part
def second_near(
    line: npt.NDArray[Any],
    centre: float,
    height: float,
    base: float,
    noise: float,
    from_px: int,
    to_px: int,
) -> bool:
    """Whether a second stripe stands so near to the first that the search takes it for a part of it.

    Outwards from the centre the samples fall, and must not rise again. They are taken in pairs: the
    lesser of the two to rise, the greater to fall, so that single hot or dark pixels do nothing.
    """
    rise, level = max(0.25 * height, 5.0 * noise), base + 0.4 * height
    for side in (-1, 1):
        at = int(round(centre)) - side
        valley = np.inf
        for _ in range(_NEAR):
            at += side
            if not from_px + 1 <= at < to_px - 1:
                break
            one, other = float(line[at]), float(line[at + side])
            valley = min(valley, max(one, other))
            lesser = min(one, other)
            if lesser - valley > rise and lesser > level:
                return True
    return False
