"""Columns of frames become record batches without losing rows, order or types."""

from __future__ import annotations

import numpy as np
import pytest

from turnscan.process import batches
from turnscan.process.batches import columns_of, record_batches
from turnscan.schemas.tables import STRIPES


def part(frame: int, rows: int) -> dict[str, np.ndarray]:
    out = {c.name: np.zeros(rows) for c in STRIPES.columns}
    out["frame"] = np.full(rows, frame)
    out["row"] = np.arange(rows)
    return out


def test_rows_keep_their_order_over_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH_ROWS", 10)
    parts = [part(i, n) for i, n in enumerate([3, 0, 9, 4, 7, 1])]
    made = list(record_batches(STRIPES, iter(parts)))
    assert [b.num_rows for b in made] == [12, 11, 1]
    frames = np.concatenate([columns_of(b)["frame"] for b in made])
    assert frames.tolist() == [0] * 3 + [2] * 9 + [3] * 4 + [4] * 7 + [5]
    for b in made:
        assert b.schema.equals(STRIPES.arrow_schema(), check_metadata=True)


def test_no_rows_make_no_batch() -> None:
    assert list(record_batches(STRIPES, [part(0, 0)])) == []


def test_only_few_rows_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH_ROWS", 10)
    given = 0

    def stream() -> object:
        nonlocal given
        for i in range(100):
            given += 5
            yield part(i, 5)

    taken = 0
    for batch in record_batches(STRIPES, stream()):
        taken += batch.num_rows
        assert given - taken <= 10
