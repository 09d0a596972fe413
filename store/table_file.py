"""One derived table being written as Parquet, in row groups of a fixed size.

If asked to, a thread of its own compresses and writes them while the caller goes on; small tables
never start it. The bytes depend on the rows, on what the file says of itself and on pyarrow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from ..schemas.errors import DamageError
from ..schemas.tables import TableSpec
from .bytes import fsync_file
from .drafts import file_sha256

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

#: A quarter of a million values of all columns are about 2.5 MB: what stays in a core's cache.
ROW_GROUP_ROWS: Final = 65_536


@cache
def _settings(spec: TableSpec) -> dict[str, Any]:
    """How a table is written. Measured: dictionaries of numbers that hardly repeat, and statistics of
    values that no order follows, cost more than compressing them, and save nothing.
    """
    import pyarrow.parquet as pq

    floats = [c.name for c in spec.columns if c.type.startswith("float")]
    schema = spec.arrow_schema()
    return {
        "compression": "zstd",
        "compression_level": 1,
        "use_dictionary": False,
        "column_encoding": dict.fromkeys(floats, "BYTE_STREAM_SPLIT"),
        "write_statistics": [c.name for c in spec.columns if c.name not in _UNORDERED],
        "max_rows_per_page": ROW_GROUP_ROWS,
        "write_page_index": True,
        "write_page_checksum": True,
        "sorting_columns": [pq.SortingColumn(schema.get_field_index(n)) for n in spec.sort_by],
    }


_UNORDERED: Final = frozenset(
    ("sigma_u_px", "amplitude_dn", "width_px", "background_dn", "sigma_range_mm")
)


class TableFile:
    """The file ``path``, which must not exist, with rows of ``spec`` sorted by the table's order.

    Use as a context manager: on an exception what is being written is let go of. ``behind``: with a
    thread.
    """

    def __init__(self, path: Path, spec: TableSpec, *, behind: bool = False) -> None:
        self._behind = behind
        self.path = path
        self.rows = 0
        self._spec = spec
        self._check = _OrderCheck(spec, str(path))
        self._writer: pq.ParquetWriter | None = None
        self._pool: ThreadPoolExecutor | None = None
        self._busy: Future[None] | None = None
        self._held: list[pa.Table] = []
        self._held_rows = 0

    def take(self, batch: pa.RecordBatch) -> None:
        """Add the rows of ``batch``, checked; its arrays must not change afterwards.

        Raises
        ------
        DamageError
            The batch is none of this table, or not in its order.
        OSError
            The disk refuses, now or at an earlier batch.
        """
        import pyarrow as pa

        table = self._spec.conform(pa.Table.from_batches([batch]), where=str(self.path))
        self._check.follow(table)
        self.rows += table.num_rows
        at = 0
        while at < table.num_rows:
            piece = table.slice(at, ROW_GROUP_ROWS - self._held_rows)
            at += piece.num_rows
            self._held.append(piece)
            self._held_rows += piece.num_rows
            if self._held_rows == ROW_GROUP_ROWS:
                (self._write_behind if self._behind else self._write)(self._group())

    def finish(self, about: Mapping[str, str]) -> Callable[[], tuple[int, str]]:
        """Write what is left and what the file says of itself: now, or in the thread.

        Returns what waits for that and gives the size in bytes and the SHA-256.
        """
        left = self._group() if self._held else None

        def end() -> tuple[int, str]:
            if left is not None:
                self._write(left)
            writer = self._open()
            writer.add_key_value_metadata(dict(about))
            writer.close()
            if self._pool is not None:
                # So that nobody waits for it when it is published.
                fsync_file(self.path)
            return self.path.stat().st_size, file_sha256(self.path)

        if self._pool is None:
            result = end()
            return lambda: result
        self._settle()
        return self._pool.submit(end).result

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        if self._writer is not None:
            # Closed already, or never to be published: what its end fails of is nobody's concern.
            with suppress(OSError):
                self._writer.close()

    def _group(self) -> pa.Table:
        """What is held, as one row group."""
        import pyarrow as pa

        group = pa.concat_tables(self._held).combine_chunks()
        self._held, self._held_rows = [], 0
        return group

    def _write_behind(self, group: pa.Table) -> None:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "parquet")
        # One group at a time: memory stays bounded, and a full disk is heard of.
        self._settle()
        self._busy = self._pool.submit(self._write, group)

    def _settle(self) -> None:
        if self._busy is not None:
            self._busy.result()
            self._busy = None

    def _write(self, group: pa.Table) -> None:
        self._open().write_table(group, row_group_size=ROW_GROUP_ROWS)

    def _open(self) -> pq.ParquetWriter:
        import pyarrow.parquet as pq

        if self._writer is None:
            spec = self._spec
            schema = spec.arrow_schema().with_metadata(
                {"turnscan.table": spec.name, "turnscan.table_version": str(spec.version)}
            )
            self._writer = pq.ParquetWriter(self.path, schema, **_settings(spec))
        return self._writer


class _OrderCheck:
    """Rows must be sorted by (frame, row): readers and engines rely on it."""

    def __init__(self, spec: TableSpec, where: str) -> None:
        self._names = spec.sort_by
        self._where = where
        self._last = (0, 0)

    def follow(self, table: pa.Table) -> None:
        if not table.num_rows:
            return
        major, minor = (table.column(n).to_numpy() for n in self._names)
        back = (major[1:] < major[:-1]) | ((major[1:] == major[:-1]) & (minor[1:] < minor[:-1]))
        if back.any() or (int(major[0]), int(minor[0])) < self._last:
            raise DamageError(f"{self._where}: rows are not sorted by {', '.join(self._names)}")
        self._last = (int(major[-1]), int(minor[-1]))
