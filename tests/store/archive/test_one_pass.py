"""Both tables made while the log is read: the bytes are those of one step after the other."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from turnscan.process import batches, stripe_columns
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive, table_file
from turnscan.store.verify import verify


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Row groups and batches so small that four frames of 48 rows fill several."""
    monkeypatch.setattr(table_file, "ROW_GROUP_ROWS", 50)
    monkeypatch.setattr(stripe_columns, "BATCH_ROWS", 50)
    monkeypatch.setattr(batches, "BATCH_ROWS", 50)


def derived(archive: Archive, *, overlap: bool = False) -> dict[str, bytes]:
    (outcome,) = derive(archive, archive.scans(), BUILT_IN["default"], overlap=overlap)
    assert outcome.error is None
    return {m.kind: (archive.root / m.path).read_bytes() for m in archive.derivations()}


def forget(archive: Archive, kind: str = "") -> None:
    for path in (archive.root / "derived" / kind).rglob("k-*"):
        path.unlink()
    archive.rebuild_catalog()


def test_neither_threads_nor_a_sealed_step_between_change_a_byte(lab: Archive) -> None:
    forget(lab)
    alone = derived(lab)
    for path in (lab.root / m.path for m in lab.derivations()):
        groups = pq.read_metadata(path)
        rows = [groups.row_group(i).num_rows for i in range(groups.num_row_groups)]
        assert len(rows) > 2
        assert set(rows[:-1]) == {50}
    forget(lab)
    assert derived(lab, overlap=True) == alone
    forget(lab, "points")
    assert derived(lab) == alone
    forget(lab, "stripes")
    assert derived(lab, overlap=True) == alone
    assert verify(lab) == []


@pytest.mark.parametrize("overlap", [False, True])
def test_what_breaks_off_leaves_nothing(
    lab: Archive, monkeypatch: pytest.MonkeyPatch, overlap: bool
) -> None:
    forget(lab)
    write = pq.ParquetWriter.write_table
    count = 0

    def full(writer: pq.ParquetWriter, *args: object, **named: object) -> None:
        nonlocal count
        count += 1
        if count == 5:
            raise OSError(28, "No space left on device")
        write(writer, *args, **named)

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["default"], overlap=overlap)
    assert "the disk is full" in str(outcome.error)
    assert outcome.error is not None
    assert outcome.error.hint
    assert lab.derivations() == []
    assert os.listdir(lab.root / "staging") == []
    assert not [p for p in Path(lab.root / "derived").rglob("*") if p.is_file()]
