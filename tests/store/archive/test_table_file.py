"""A table being written: row groups of one size however rows come, order checked, the disk heard of."""

from __future__ import annotations

import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from turnscan.schemas.errors import DamageError
from turnscan.schemas.tables import STRIPES
from turnscan.store import table_file
from turnscan.store.table_file import TableFile


def batch(first: int, rows: int) -> pa.RecordBatch:
    """Rows ``first`` onwards of a table with ten rows a frame."""
    at = np.arange(first, first + rows)
    values = {c.name: np.sin(at + k) * 300 + 400 for k, c in enumerate(STRIPES.columns)}
    values |= {"frame": at // 10, "row": at % 10, "laser": at % 3}
    arrays = [pa.array(values[c.name].astype(c.type)) for c in STRIPES.columns]
    return pa.RecordBatch.from_arrays(arrays, schema=STRIPES.arrow_schema())


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_file, "ROW_GROUP_ROWS", 100)


def write(path: Path, sizes: list[int], *, behind: bool = False) -> bytes:
    at = 0
    with TableFile(path, STRIPES, behind=behind) as file:
        for size in sizes:
            file.take(batch(at, size))
            at += size
        said, _ = file.finish({"turnscan.key": "k"})()
        assert file.rows == at
    assert said == path.stat().st_size
    return path.read_bytes()


def test_the_bytes_depend_neither_on_the_batches_nor_on_the_thread(tmp_path: Path) -> None:
    whole = write(tmp_path / "a", [1234])
    assert write(tmp_path / "b", [100] * 12 + [34]) == whole
    assert write(tmp_path / "d", [1, 0, 250, 3, 980], behind=True) == whole
    assert write(tmp_path / "c", [1, 0, 250, 3, 980]) == whole
    with pq.ParquetFile(tmp_path / "a", page_checksum_verification=True) as file:
        groups = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
        table = file.read()
    assert groups == [100] * 12 + [34]
    assert table.equals(pa.Table.from_batches([batch(0, 1234)]))
    assert table.schema.metadata[b"turnscan.key"] == b"k"


def test_a_table_without_rows_is_a_table(tmp_path: Path) -> None:
    write(tmp_path / "a", [])
    assert pq.read_table(tmp_path / "a").schema.equals(STRIPES.arrow_schema())


@pytest.mark.parametrize("second", [0, 94, 99])
def test_rows_out_of_order_are_refused(tmp_path: Path, second: int) -> None:
    with TableFile(tmp_path / "a", STRIPES) as file:
        file.take(batch(0, 101))
        with pytest.raises(DamageError, match="not sorted by frame, row"):
            file.take(batch(second, 5))
    backwards = batch(0, 50).take(pa.array(np.r_[0:20, 19:18:-1, 18, 21:50]))
    with (
        TableFile(tmp_path / "b", STRIPES) as file,
        pytest.raises(DamageError, match="not sorted by frame, row"),
    ):
        file.take(backwards)


@pytest.fixture
def little_room() -> Iterator[None]:
    """Files of this process may not grow beyond 20 kB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, ignored)


@pytest.mark.usefixtures("little_room")
@pytest.mark.parametrize("behind", [False, True])
def test_a_disk_that_fills_is_heard_of(tmp_path: Path, behind: bool) -> None:
    with (
        pytest.raises(OSError, match="File too large"),
        TableFile(tmp_path / "a", STRIPES, behind=behind) as file,
    ):
        for i in range(100):
            file.take(batch(1000 * i, 1000))
        file.finish({})()
