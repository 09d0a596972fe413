"""Least-squares fit of one row, sample by sample: for rows that are clipped, struck, cut or very wide.

The model is a Gaussian on a straight background. Clipped samples say nothing and are left out: the
flanks give the centre. A median of three rows, along the stripe, only starts the fit and tells
outliers; the fit itself takes the row's own samples, so that nothing is smoothed across a depth edge.
Of a wide stripe the means of 2, 4, 8 ... neighbouring samples are fitted, which say no less; but not of
a clipped one, since a mean that holds a part of a plateau's edge is lost, and with it what tells most.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.tables import Flag
from ..compiled import kernel
from .descent import GATE, NARROWEST, Model, descend, is_unlike
from .start import SIDE, background_of, goes_on, profile_of, start_of

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_SATURATED, _EDGE, _SECOND = int(Flag.SATURATED), int(Flag.EDGE), int(Flag.SECOND)
#: How many samples on either side of the peak are taken, and how many of them must see the background.
_REACH, _SEEN = 28, 4
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


@kernel
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
    base_dn, max_width_px, noise, plain = limits
    most = int(math.ceil(2.0 * max_width_px)) + SIDE
    reach, pool = min(_REACH, most), 1
    while True:
        # Of the pooled samples about the peak, those that lie whole in the span.
        low = peak - pool // 2 - reach * pool
        low += max(0, (from_px - low + pool - 1) // pool) * pool
        n = (min(to_px, peak - pool // 2 + (reach + 1) * pool) - low) // pool
        if n < _LEAST:
            return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        lines, cut = np.empty((5, n), np.float64), np.empty(n, np.bool_)
        _gather(signal, raw, row, low, pool, clip_dn, lines, cut)
        inner = row > 0 and row < len(signal) - 1
        share = 1.0 / math.sqrt(pool)
        best, wanted = _fit_within(
            lines,
            cut,
            (peak - low - 0.5 * (pool - 1)) / pool,
            inner,
            reach if reach * pool < most else np.inf,
            (base_dn, max_width_px / pool, noise * share, plain * share),
            pool,
        )
        if best[0] and 3.5 * best[3] > reach:
            # So wide that no background was seen: once more, from afar.
            wanted = 2.0 * reach
        if wanted <= reach or reach * pool >= 2 * most:
            break
        clipped = False
        for j in range(max(0, peak - low - 1), min(n, peak - low + 2)):
            clipped |= pool == 1 and cut[j]
        more = 2
        while wanted < np.inf and wanted > more * reach and more * reach * pool < most:
            more *= 2
        if clipped:
            reach *= more
        else:
            pool *= more
    good, centre, sigma, width, height, base, flags = best
    if not good:
        return best
    # The mean of neighbours is a wider and lower Gaussian than what it is taken of.
    own = math.sqrt(width * width - (1.0 - 1.0 / (pool * pool)) / 12.0)
    centre, sigma = low + 0.5 * (pool - 1) + pool * centre, pool * sigma
    height, width = height * width / own, pool * own
    if centre - 2.5 * width < from_px or centre + 2.5 * width > to_px - 1:
        flags |= _EDGE
    if second_near(signal[row], centre, height, base, plain, from_px, to_px):
        flags |= _SECOND
    return True, centre, sigma, width, height, base, flags


@kernel
def _gather(
    signal: npt.NDArray[Any],
    raw: npt.NDArray[Any],
    row: int,
    low: int,
    pool: int,
    clip_dn: float,
    lines: Floats,
    cut: Bools,
) -> None:
    """Means of ``pool`` samples each, from column ``low`` on, of the row above, the row and that below.

    ``cut`` tells where one of the row's own is clipped.
    """
    share = 1.0 / pool
    for i in range(3):
        line, source = lines[i], signal[min(max(row + i - 1, 0), len(signal) - 1)]
        for j in range(len(cut)):
            total, start = 0.0, np.uintp(low + j * pool)
            for k in range(pool):
                total += float(source[start + np.uintp(k)])
            line[np.uintp(j)] = total * share
    source = raw[row]
    for j in range(len(cut)):
        clipped, start = False, np.uintp(low + j * pool)
        for k in range(pool):
            clipped |= float(source[start + np.uintp(k)]) >= clip_dn
        cut[np.uintp(j)] = clipped


@kernel
def _fit_within(
    lines: Floats,
    cut: Bools,
    place: float,
    inner: bool,
    room: float,
    limits: tuple[float, float, float, float],
    pool: int,
) -> tuple[_Row, float]:
    """The fit to pooled samples, and how far from the peak it wants them: beyond ``room``, no fit.

    ``lines`` are the row above, the row, the row below, and room for a profile and distances; the peak
    is at ``place``; ``inner`` is not the first or last row. All is counted in pooled samples.
    """
    above, here, below, profile = lines[0], lines[1], lines[2], lines[3]
    along = inner and goes_on(above, here, below, _nearest(place, len(here)))
    profile_of(above, here, below, along, profile)
    best, cost, strange, wanted, begun = _attempt(lines, cut, place, room, (0.0, 0.0), limits, pool)
    if wanted > room:
        return best, wanted
    if not best[0] or strange > _DOUBTFUL:
        # The rows beside it may show something else after all, or better: once more the other way.
        profile_of(above, here, below, not along, profile)
        other, its_cost, _, _, _ = _attempt(lines, cut, place, np.inf, begun, limits, pool)
        if other[0] and (not best[0] or its_cost < cost):
            best = other
    return best, 0.0


@kernel
def _nearest(place: float, n: int) -> int:
    """The sample nearest to ``place``, which at a border may lie in a mean that is not whole."""
    return min(max(int(math.floor(place + 0.5)), 0), n - 1)


@kernel
def _attempt(
    lines: Floats,
    cut: Bools,
    place: float,
    room: float,
    before: tuple[float, float],
    limits: tuple[float, float, float, float],
    pool: int,
) -> tuple[_Row, float, float, float, tuple[float, float]]:
    """The fit that the profile starts; its mean square remainder, each up to a gate; share of outliers;
    how far from the peak samples are needed: if farther than ``room``, nothing was fitted; and the
    start's centre and width.

    Nor is anything fitted from a start that is the one ``before``. ``limits`` are those of
    :func:`fit_row`, the rest those of :func:`_fit_within`.
    """
    base_dn, max_width, noise, plain = limits
    samples, profile = lines[1], lines[3]
    n, top = len(samples), _nearest(place, len(samples))
    none = (False, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    for j in range(max(0, top - 2), min(n, top + 3)):
        if profile[j] > profile[top]:
            top = j
    ok, centre, width, height, base = start_of(profile, cut, top, max_width)
    begun = (centre, width)
    if not ok or height < 0.5 * base_dn:
        return none, np.inf, 1.0, np.inf, begun
    bad = (none, np.inf, 1.0, 0.0, begun)
    half = 3.5 * width + 4.0
    if half + _SEEN > room:
        return none, np.inf, 1.0, half + _SEEN, begun
    if abs(centre - before[0]) < _SAME * width and abs(width - before[1]) < _SAME * width:
        return bad
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
    if abs(centre - place) > 2.5 / pool + 1.5 * width and not flags & _SATURATED:
        return bad
    if height < base_dn or not sigma < max(0.2 * width, 0.5 / pool):
        return bad
    if not flags & _SATURATED and not _filled(samples, model, plain):
        return bad
    cost, outliers, seen = _judge(rests, first, model, noise, plain, gate)
    if not seen:
        return bad
    return (True, centre, sigma, width, height, base + tilt * centre, flags), cost, outliers, 0.0, begun


@kernel
def _filled(samples: Floats, model: Model, noise: float) -> bool:
    """Whether the centre is bright: of two stripes taken together it lies where neither is."""
    centre, _, height, base, tilt = model
    middle, summit = round(centre), -np.inf
    for j in range(max(0, middle - 1), min(len(samples), middle + 2)):
        summit = max(summit, samples[j] - base - tilt * j)
    return summit >= _FILLED * height - 2.0 * noise


@kernel
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


@kernel
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
