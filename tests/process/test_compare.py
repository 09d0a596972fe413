"""Comparing two derivations: against a dictionary of points, whatever the batches; bounded memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.process.compare import ShiftGrid, Shifts, nice_edges, sum_shifts

Columns = dict[str, np.ndarray]
NAMES = ("frame", "laser", "row", "x_mm", "y_mm", "z_mm", "range_mm")


def table(rng: np.random.Generator, frames: int, rows: int, keep: float) -> Columns:
    """A sweep of two lasers, some points missing, sorted by frame and row."""
    frame, row, laser = (
        a.ravel() for a in np.meshgrid(np.arange(frames), np.arange(rows), [0, 1], indexing="ij")
    )
    some = rng.random(len(frame)) < keep
    out = {"frame": frame[some].astype(np.uint32), "row": row[some].astype(np.uint16)}
    out["laser"] = laser[some].astype(np.uint8)
    seed = out["frame"] * 7919.0 + out["row"] * 31.0 + out["laser"]
    for i, name in enumerate(("x_mm", "y_mm", "z_mm")):
        out[name] = (1000.0 * np.sin(seed + i)).astype(np.float32)
    out["range_mm"] = (3000.0 + 1000.0 * np.cos(seed)).astype(np.float32)
    return out


def moved(rng: np.random.Generator, columns: Columns) -> Columns:
    out = dict(columns)
    for name in NAMES[3:]:
        out[name] = (columns[name] + rng.normal(0.3, 1.0, len(columns["frame"]))).astype(np.float32)
    return out


def cut(columns: Columns, at: list[int]) -> Iterator[Columns]:
    bounds = sorted({0, len(columns["frame"]), *(a % (len(columns["frame"]) + 1) for a in at)})
    for a, b in pairwise(bounds):
        yield {n: v[a:b] for n, v in columns.items()}


def by_key(columns: Columns) -> dict[tuple[int, int, int], np.ndarray]:
    values = np.stack([columns[n].astype(np.float64) for n in NAMES[3:]], axis=1)
    keys = zip(*(columns[n].tolist() for n in NAMES[:3]), strict=True)
    return dict(zip(keys, values, strict=True))  # type: ignore[arg-type]


CUTS = st.lists(st.integers(0, 5000), max_size=9)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 9), st.sampled_from([0.0, 0.3, 0.9, 1.0]), CUTS, CUTS)
def test_it_is_what_a_dictionary_says(
    seed: int, frames: int, keep: float, cuts_a: list[int], cuts_b: list[int]
) -> None:
    rng = np.random.default_rng(seed)
    a = table(rng, frames, 23, keep)
    b = moved(rng, table(rng, frames, 23, 0.8))
    shifts, grid = Shifts(), ShiftGrid(frames, 23)
    sum_shifts(cut(a, cuts_a), cut(b, cuts_b), shifts, grid)
    told = shifts.statistics()
    one, two = by_key(a), by_key(b)
    both = sorted(one.keys() & two.keys())
    assert (told.matched, told.only_first, told.only_second) == (
        len(both),
        len(one) - len(both),
        len(two) - len(both),
    )
    assert grid.count.sum() == len(both)
    if not both:
        assert (told.rms_mm, told.by_range) == (None, ())
        return
    gap = np.array([two[k] - one[k] for k in both])
    length = np.linalg.norm(gap[:, :3], axis=1)
    assert told.rms_mm == pytest.approx(np.sqrt(np.mean(length**2)))
    assert told.max_mm == pytest.approx(length.max())
    assert told.bias_mm == pytest.approx(gap[:, 3].mean(), abs=1e-9)
    assert (told.x_mm, told.y_mm, told.z_mm) == pytest.approx(tuple(gap[:, :3].mean(axis=0)), abs=1e-9)
    assert told.p95_mm == pytest.approx(np.quantile(length, 0.95, method="inverted_cdf"), rel=0.013)
    assert told.p50_mm == pytest.approx(np.quantile(length, 0.5, method="inverted_cdf"), rel=0.013)
    assert sum(r.points for r in told.by_range) == len(both)
    edges, counts = shifts.length_histogram()
    assert counts.sum() == len(both)
    assert len(edges) == len(counts) + 1


def test_ranges_are_told_apart() -> None:
    n = 4000
    range_mm = np.linspace(1000, 6000, n)
    base: Columns = {"frame": np.arange(n) // 100, "row": np.arange(n) % 100, "laser": np.zeros(n, int)}
    base |= {"x_mm": range_mm, "y_mm": np.zeros(n), "z_mm": np.zeros(n), "range_mm": range_mm}
    grown = {**base, "x_mm": range_mm * 1.001, "range_mm": range_mm * 1.001}
    shifts = Shifts()
    sum_shifts(iter([base]), iter([grown]), shifts)
    bins = shifts.statistics().by_range
    assert 8 <= len(bins) <= 14
    assert [b.from_mm % 500 for b in bins] == [0.0] * len(bins)
    for b in bins:
        middle = (max(b.from_mm, 1000) + min(b.to_mm, 6000)) / 2
        assert b.bias_mm == pytest.approx(0.001 * middle, rel=0.01)
        assert b.rms_mm == pytest.approx(0.001 * middle, rel=0.02)


def test_several_scans_sum_up_to_one() -> None:
    rng = np.random.default_rng(1)
    a, c = table(rng, 5, 11, 1.0), table(rng, 7, 11, 0.8)
    b, d = moved(rng, a), moved(rng, c)
    apart, other, both = Shifts(), Shifts(), Shifts()
    sum_shifts(iter([a]), iter([b]), apart)
    sum_shifts(iter([c]), iter([d]), other)
    sum_shifts(iter([a]), iter([b]), both)
    sum_shifts(iter([c]), iter([d]), both)
    apart.join(other)
    assert apart.statistics() == both.statistics()


@given(st.floats(0.0, 1e4), st.floats(1e-3, 1e4))
def test_edges_are_round_and_cover_all(low: float, width: float) -> None:
    edges = nice_edges(low, low + width, 10)
    assert edges[0] <= low + 1e-6
    assert edges[-1] >= low + width - 1e-6
    assert 2 <= len(edges) <= 18


def test_memory_does_not_grow_with_the_tables() -> None:
    def endless(batches: int, shift: float) -> Iterator[dict[str, Any]]:
        n = 20_000
        for i in range(batches):
            frame = np.arange(i * n, (i + 1) * n) // 480
            flat = np.full(n, shift, np.float32)
            yield dict.fromkeys(NAMES[3:], flat) | {
                "frame": frame.astype(np.uint32),
                "row": (np.arange(i * n, (i + 1) * n) % 480).astype(np.uint16),
                "laser": np.zeros(n, np.uint8),
            }

    def peak(batches: int) -> int:
        tracemalloc.start()
        shifts = Shifts()
        sum_shifts(endless(batches, 1.0), endless(batches, 2.0), shifts)
        assert shifts.statistics().matched == batches * 20_000
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    few, many = peak(4), peak(40)
    assert many < 1.2 * few, (few, many)
