"""How far points of two derivations are apart: matched by (frame, laser, row), streaming.

Memory is that of one batch of each and of fixed histograms, whatever the size of the tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Columns = Mapping[str, npt.NDArray[Any]]
Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

#: Lengths of shifts are counted in bins 1.2 % wide, from 1 nm to 100 m: quantiles are good to that.
_LENGTH_EDGES_MM = np.geomspace(1e-6, 1e5, 2122)
#: Ranges in bins 0.4 % wide, from 1 mm to 100 m, joined into a few at the end.
_RANGE_EDGES_MM = np.geomspace(1.0, 1e5, 2880)
_RANGES_SHOWN = 10
_USED = ("x_mm", "y_mm", "z_mm", "range_mm")


@dataclass(frozen=True)
class RangeBin:
    """Shifts of the points that the first derivation sees at ranges in [from_mm, to_mm)."""

    from_mm: float
    to_mm: float
    points: int
    rms_mm: float
    bias_mm: float


@dataclass(frozen=True)
class ShiftStatistics:
    """Second minus first, over the matched points.

    ``rms_mm``, ``p50_mm``, ``p95_mm``, ``max_mm`` are of the shift's length in scene space; ``bias_mm``
    is the mean change of range, ``range_rms_mm`` its rms; ``x_mm y_mm z_mm`` the mean shift. None where
    nothing matches.
    """

    matched: int
    only_first: int
    only_second: int
    rms_mm: float | None = None
    bias_mm: float | None = None
    range_rms_mm: float | None = None
    p50_mm: float | None = None
    p95_mm: float | None = None
    max_mm: float | None = None
    x_mm: float | None = None
    y_mm: float | None = None
    z_mm: float | None = None
    by_range: tuple[RangeBin, ...] = ()


def _zeros(n: int) -> Floats:
    return np.zeros(n)


@dataclass
class Shifts:
    """What is summed up while two tables stream by; several scans may follow one another."""

    only_first: int = 0
    only_second: int = 0
    lengths: Counts = field(default_factory=lambda: np.zeros(len(_LENGTH_EDGES_MM) + 1, np.int64))
    range_count: Counts = field(default_factory=lambda: np.zeros(len(_RANGE_EDGES_MM) + 1, np.int64))
    range_square: Floats = field(default_factory=lambda: _zeros(len(_RANGE_EDGES_MM) + 1))
    range_change: Floats = field(default_factory=lambda: _zeros(len(_RANGE_EDGES_MM) + 1))
    range_change_square: float = 0.0
    sum_mm: Floats = field(default_factory=lambda: _zeros(3))
    longest_mm: float = 0.0

    def add(self, first: Columns, second: Columns) -> None:
        """Matched rows: the same points under both derivations, in the same order."""
        shift = np.stack(
            [second[n].astype(np.float64) - first[n].astype(np.float64) for n in _USED[:3]], axis=1
        )
        if not len(shift):
            return
        square = np.einsum("ij,ij->i", shift, shift)
        length = np.sqrt(square)
        change = second["range_mm"].astype(np.float64) - first["range_mm"].astype(np.float64)
        at = np.searchsorted(_RANGE_EDGES_MM, first["range_mm"], side="right")
        bins = len(self.range_count)
        self.lengths += np.bincount(
            np.searchsorted(_LENGTH_EDGES_MM, length, side="right"), minlength=len(self.lengths)
        )
        self.range_count += np.bincount(at, minlength=bins)
        self.range_square += np.bincount(at, square, minlength=bins)
        self.range_change += np.bincount(at, change, minlength=bins)
        self.range_change_square += float(change @ change)
        self.sum_mm += shift.sum(axis=0)
        self.longest_mm = max(self.longest_mm, float(length.max()))

    def join(self, other: Shifts) -> None:
        """Take in what another one has summed up."""
        self.only_first += other.only_first
        self.only_second += other.only_second
        for name in ("lengths", "range_count", "range_square", "range_change", "sum_mm"):
            getattr(self, name)[...] += getattr(other, name)
        self.range_change_square += other.range_change_square
        self.longest_mm = max(self.longest_mm, other.longest_mm)

    def statistics(self) -> ShiftStatistics:
        """The numbers so far."""
        n = int(self.range_count.sum())
        if not n:
            return ShiftStatistics(0, self.only_first, self.only_second)
        x, y, z = (float(s) / n for s in self.sum_mm)
        return ShiftStatistics(
            matched=n,
            only_first=self.only_first,
            only_second=self.only_second,
            rms_mm=math.sqrt(float(self.range_square.sum()) / n),
            bias_mm=float(self.range_change.sum()) / n,
            range_rms_mm=math.sqrt(self.range_change_square / n),
            p50_mm=self._quantile(0.5),
            p95_mm=self._quantile(0.95),
            max_mm=self.longest_mm,
            x_mm=x,
            y_mm=y,
            z_mm=z,
            by_range=tuple(self._by_range()),
        )

    def length_histogram(self, bins: int = 60) -> tuple[Floats, Counts]:
        """Edges (bins + 1) and counts of the shifts' lengths, from 0 to above the 99th percentile.

        Longer ones are counted in the last bin.
        """
        most = max(self._quantile(0.99) * 1.15, 1e-6)
        edges = np.linspace(0.0, most, bins + 1)
        bounds = np.concatenate([[0.0], _LENGTH_EDGES_MM])
        middle = np.sqrt(np.maximum(bounds, 1e-7) * np.append(bounds[1:], bounds[-1] * 1.012))
        at = np.clip(np.searchsorted(edges, middle, side="right") - 1, 0, bins - 1)
        return edges, np.bincount(at, self.lengths, minlength=bins).round().astype(np.int64)

    def _quantile(self, part: float) -> float:
        """The length that ``part`` of the shifts do not exceed; to the width of a bin."""
        total = np.cumsum(self.lengths)
        at = int(np.searchsorted(total, part * total[-1]))
        if at == 0:
            return 0.0
        upper = _LENGTH_EDGES_MM[min(at, len(_LENGTH_EDGES_MM) - 1)]
        return min(float(math.sqrt(_LENGTH_EDGES_MM[at - 1] * upper)), self.longest_mm)

    def _by_range(self) -> Iterator[RangeBin]:
        """About ten bins of equal width between the nearest and the farthest points that matter."""
        share = np.cumsum(self.range_count) / self.range_count.sum()
        inner = np.concatenate([[0.0], _RANGE_EDGES_MM, [np.inf]])
        low = inner[int(np.searchsorted(share, 0.001))]
        high = inner[min(int(np.searchsorted(share, 0.999)) + 1, len(_RANGE_EDGES_MM))]
        edges = nice_edges(float(low), float(high), _RANGES_SHOWN)
        centre = np.sqrt(np.maximum(inner[:-1], 1e-3) * np.minimum(inner[1:], 1e6))
        at = np.searchsorted(edges, centre, side="right")
        for i in range(len(edges) + 1):
            mine = at == i
            n = int(self.range_count[mine].sum())
            if n:
                yield RangeBin(
                    from_mm=float(edges[i - 1]) if i else 0.0,
                    to_mm=float(edges[i]) if i < len(edges) else float(_RANGE_EDGES_MM[-1]),
                    points=n,
                    rms_mm=math.sqrt(float(self.range_square[mine].sum()) / n),
                    bias_mm=float(self.range_change[mine].sum()) / n,
                )


def nice_edges(low: float, high: float, count: int) -> Floats:
    """Round numbers at equal distances that cover [low, high] in about ``count`` steps."""
    width = max(high - low, 1e-6) / count
    power = 10.0 ** math.floor(math.log10(width))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= width * 0.7)
    return np.arange(math.floor(low / step), math.ceil(high / step) + 1, dtype=np.float64) * step


class ShiftGrid:
    """Mean length of shifts over (frame, row), coarse enough for a picture."""

    def __init__(self, frames: int, rows: int, *, most_frames: int = 420, most_rows: int = 300) -> None:
        self.frames, self.rows = max(frames, 1), max(rows, 1)
        shape = (min(self.rows, most_rows), min(self.frames, most_frames))
        self.sum_mm = np.zeros(shape)
        self.count = np.zeros(shape, np.int64)

    def add(self, first: Columns, second: Columns) -> None:
        """Matched rows, as in :meth:`Shifts.add`."""
        height, width = self.count.shape
        length = np.sqrt(
            sum((second[n].astype(np.float64) - first[n].astype(np.float64)) ** 2 for n in _USED[:3])
        )
        y = np.minimum(first["row"].astype(np.int64) * height // self.rows, height - 1)
        x = np.minimum(first["frame"].astype(np.int64) * width // self.frames, width - 1)
        at = y * width + x
        size = height * width
        self.sum_mm += np.bincount(at, length, minlength=size).reshape(height, width)
        self.count += np.bincount(at, minlength=size).reshape(height, width)

    def mean_mm(self) -> Floats:
        """Mean length of the shifts (rows, frames); NaN where no points match."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.where(self.count > 0, self.sum_mm / np.maximum(self.count, 1), np.nan))


def sum_shifts(
    first: Iterable[Columns], second: Iterable[Columns], into: Shifts, grid: ShiftGrid | None = None
) -> None:
    """Add the shifts between two POINTS tables of one scan, sorted by frame, to ``into``."""
    for a, b in _stretches(iter(first), iter(second)):
        ka, kb = _keys(a), _keys(b)
        if np.array_equal(ka, kb):
            one, two = a, b
        else:
            _, ia, ib = np.intersect1d(ka, kb, return_indices=True)
            one, two = ({n: v[i] for n, v in c.items()} for c, i in ((a, ia), (b, ib)))
        into.only_first += len(ka) - len(one["frame"])
        into.only_second += len(kb) - len(one["frame"])
        into.add(one, two)
        if grid is not None:
            grid.add(one, two)


def _keys(columns: Columns) -> Counts:
    """(frame, row, laser) as one number."""
    frame, row, laser = (columns[n].astype(np.int64) for n in ("frame", "row", "laser"))
    return frame << 24 | row << 8 | laser


def _stretches(
    first: Iterator[Columns], second: Iterator[Columns]
) -> Iterator[tuple[Columns, Columns]]:
    """The same frames of both tables, a stretch at a time; whole frames only."""
    a, b = _Stream(first), _Stream(second)
    while True:
        below = min(a.whole_below(), b.whole_below())
        yield a.take(below), b.take(below)
        if a.ended and b.ended:
            return
        (a if a.whole_below() <= b.whole_below() else b).more()


class _Stream:
    """Batches of one table, of which only those not yet taken are held."""

    def __init__(self, batches: Iterator[Columns]) -> None:
        self._batches = batches
        self._held: dict[str, npt.NDArray[Any]] = {
            n: np.zeros(0, np.int64) for n in ("frame", "row", "laser", *_USED)
        }
        self.ended = False

    def whole_below(self) -> float:
        """Frames below this number are held as a whole."""
        if self.ended:
            return math.inf
        frame = self._held["frame"]
        return float(frame[-1]) if len(frame) else -1.0

    def take(self, below: float) -> Columns:
        """The rows of frames below this number, which are held no longer."""
        frame = self._held["frame"]
        at = len(frame) if below == math.inf else int(np.searchsorted(frame, below))
        taken = {n: v[:at] for n, v in self._held.items()}
        self._held = {n: v[at:] for n, v in self._held.items()}
        return taken

    def more(self) -> None:
        """Hold the next batch, too."""
        batch = next(self._batches, None)
        if batch is None:
            self.ended = True
        elif len(self._held["frame"]):
            self._held = {n: np.concatenate([v, batch[n]]) for n, v in self._held.items()}
        else:
            self._held = {n: batch[n] for n in self._held}
