"""Stripe points become columns in the types of STRIPES, in full batches, without losing any."""

from __future__ import annotations

import numpy as np
import pytest

from turnscan.process import stripe_columns
from turnscan.process.extract import STRIPE_DTYPE
from turnscan.process.stripe_columns import StripeColumns
from turnscan.schemas.tables import STRIPES


def points(rows: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = np.empty(rows, STRIPE_DTYPE)
    for name in out.dtype.names:
        out[name] = rng.uniform(0, 500, rows)
    return out


@pytest.mark.parametrize("room", [1, 7, 64, 1000])
def test_every_point_arrives_once_and_in_order(monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    monkeypatch.setattr(stripe_columns, "BATCH_ROWS", room)
    columns = StripeColumns()
    frames = [points(n, n) for n in (5, 0, 64, 1, 30)]
    made = []
    for i, frame in enumerate(frames):
        laser = i if i % 2 else np.arange(len(frame)).astype(np.uint8)
        made += columns.add(frame, frame=10 + i, t_ns=10**18 + i, angle_rad=0.1 * i, laser=laser)
        assert all(len(c["row"]) == room for c in made)
    made += columns.rest()
    assert columns.rest() == []
    joined = {c.name: np.concatenate([m[c.name] for m in made]) for c in STRIPES.columns}
    assert {n: v.dtype.name for n, v in joined.items()} == {c.name: c.type for c in STRIPES.columns}
    together = np.concatenate(frames)
    for name in STRIPE_DTYPE.names:
        assert np.array_equal(joined[name], together[name].astype(joined[name].dtype)), name
    counts = [len(f) for f in frames]
    assert np.array_equal(joined["frame"], np.repeat(np.arange(10, 15), counts))
    assert np.array_equal(joined["t_ns"], np.repeat(10**18 + np.arange(5), counts))
    angles = np.array([0.1 * i for i in range(5)], np.float32)
    assert np.array_equal(joined["angle_rad"], np.repeat(angles, counts))
    lasers = [np.full(n, i) if i % 2 else np.arange(n) for i, n in enumerate(counts)]
    assert np.array_equal(joined["laser"], np.concatenate(lasers))


def test_full_columns_are_not_written_to_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stripe_columns, "BATCH_ROWS", 4)
    columns = StripeColumns()
    (first,) = columns.add(points(5, 1), frame=1, t_ns=1, angle_rad=0.0, laser=0)
    before = {n: v.copy() for n, v in first.items()}
    columns.add(points(9, 2), frame=2, t_ns=2, angle_rad=1.0, laser=1)
    assert all(np.array_equal(first[n], before[n]) for n in before)
