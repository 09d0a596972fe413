"""Derived tables: written aside as Parquet, published under their key, manifest last; read back
with every page's checksum compared.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..schemas.document import dump_json
from ..schemas.errors import DamageError
from ..schemas.manifests import DerivationManifest, Kind
from ..schemas.software import __version__
from ..schemas.tables import TABLES, TableSpec
from . import layout
from .bytes import LocalFolder, storage_error
from .drafts import file_sha256
from .projection import read_manifest

if TYPE_CHECKING:
    import pyarrow as pa

ROW_GROUP_ROWS = 262_144


@cache
def made_with() -> Mapping[str, str]:
    """Versions and machine, recorded in a manifest but no part of any key."""
    from importlib.metadata import version

    libraries = ("numpy", "opencv-python-headless", "pyarrow")
    return {
        "turnscan": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        **{name: version(name) for name in libraries},
    }


def write_parquet(
    path: Path,
    spec: TableSpec,
    batches: Iterable[pa.RecordBatch],
    about: Callable[[], dict[str, str]],
) -> int:
    """Write ``batches`` of ``spec`` to ``path`` and return the number of rows.

    Rows must come sorted by the table's order; each batch is checked. Only one row group is held
    in memory. ``about`` is asked after the last batch: what the file says of itself stands at its end.
    The bytes depend on the rows, ``about`` and the library alone.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = spec.arrow_schema().with_metadata(
        {"turnscan.table": spec.name, "turnscan.table_version": str(spec.version)}
    )
    floats = [c.name for c in spec.columns if c.type.startswith("float")]
    order = [pq.SortingColumn(schema.get_field_index(name)) for name in spec.sort_by]
    rows = 0
    check = _OrderCheck(spec, str(path))
    with pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        compression_level=1,
        use_dictionary=[c.name for c in spec.columns if c.name not in floats],
        column_encoding=dict.fromkeys(floats, "BYTE_STREAM_SPLIT"),
        write_page_index=True,
        write_page_checksum=True,
        sorting_columns=order,
    ) as writer:
        held: list[Any] = []
        count = 0
        for batch in batches:
            table = spec.conform(pa.Table.from_batches([batch]), where=str(path))
            check.follow(table)
            rows += table.num_rows
            at = 0
            while at < table.num_rows:
                piece = table.slice(at, ROW_GROUP_ROWS - count)
                held.append(piece)
                count += piece.num_rows
                at += piece.num_rows
                if count == ROW_GROUP_ROWS:
                    writer.write_table(_joined(held, schema), row_group_size=ROW_GROUP_ROWS)
                    held, count = [], 0
        if held:
            writer.write_table(_joined(held, schema), row_group_size=ROW_GROUP_ROWS)
        writer.add_key_value_metadata(about())
    return rows


def _joined(pieces: list[pa.Table], schema: pa.Schema) -> pa.Table:
    import pyarrow as pa

    joined = pa.concat_tables([p.replace_schema_metadata(None) for p in pieces]).combine_chunks()
    return joined.cast(schema)


class _OrderCheck:
    """Rows must be sorted by (frame, row): readers and engines rely on it."""

    def __init__(self, spec: TableSpec, where: str) -> None:
        self._names = spec.sort_by
        self._where = where
        self._last: tuple[int, int] | None = None

    def follow(self, table: pa.Table) -> None:
        import numpy as np

        if not table.num_rows:
            return
        major, minor = (table.column(n).to_numpy().astype(np.int64) for n in self._names)
        step = (major << 32) | minor
        first = (int(major[0]), int(minor[0]))
        if np.any(np.diff(step) < 0) or (self._last is not None and first < self._last):
            raise DamageError(f"{self._where}: rows are not sorted by {', '.join(self._names)}")
        self._last = (int(major[-1]), int(minor[-1]))


def publish(
    store: LocalFolder,
    kind: Kind,
    batches: Iterable[pa.RecordBatch],
    fields: Callable[[], dict[str, Any]],
) -> DerivationManifest:
    """Write, publish and seal one derivation; returns the manifest that stands.

    ``fields`` is called once, when the last batch has been taken (so a table can be begun before its
    key is known), and gives those of :class:`DerivationManifest` but kind, path, rows, bytes, sha256,
    created_ns, duration_s, made_with and table_version. If another process published the same key
    first, its result stands and ours is dropped.
    """
    began = time.monotonic()
    spec = TABLES[kind]
    values: dict[str, Any] = {}

    def about() -> dict[str, str]:
        values.update(fields())
        return {f"turnscan.{k}": str(values[k]) for k in ("key", "scan", "recipe")}

    with store.staged(".parquet") as aside:
        try:
            rows = write_parquet(aside, spec, batches, about)
            size, sha256 = aside.stat().st_size, file_sha256(aside)
        except OSError as error:
            raise storage_error(error, aside) from error
        folder = layout.derivation_folder(
            kind,
            recipe=values["recipe"],
            calibration=values["calibration"],
            scan=values["scan"],
        )
        table_path = layout.table_file(folder, values["key"])
        manifest_path = layout.manifest_file(folder, values["key"])
        manifest = DerivationManifest(
            kind=kind,
            **values,
            path=table_path,
            table_version=spec.version,
            rows=rows,
            bytes=size,
            sha256=sha256,
            created_ns=time.time_ns(),
            duration_s=round(time.monotonic() - began, 3),
            made_with=dict(made_with()),
        ).sealed()
        with store.holding(alone=False):
            return _put(store, manifest, manifest_path, aside)


def _put(
    store: LocalFolder, manifest: DerivationManifest, manifest_path: str, aside: Path
) -> DerivationManifest:
    """The table, then its manifest; returns the manifest that stands."""
    if not store.put_if_absent(manifest.path, aside):
        if store.head(manifest_path) is not None:
            return read_manifest(store, manifest_path)
        # Either another process is between its two steps, or one was killed there. Equal bytes
        # make our manifest true of the table that lies there.
        if file_sha256(store.local(manifest.path)) != manifest.sha256:
            raise DamageError(
                f"{store.local(manifest.path)}: a table without manifest is in the way",
                hint="turnscan repair moves it aside; then run the command again",
            )
    if not store.put_if_absent(manifest_path, dump_json(manifest.plain())):
        return read_manifest(store, manifest_path)
    return manifest


def read_batches(store: LocalFolder, manifest: DerivationManifest) -> Iterator[pa.RecordBatch]:
    """The rows of a derivation, a row group at a time, page checksums compared.

    Raises
    ------
    DamageError
        The file is missing, has another size, or any page is not what was written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = store.local(manifest.path)
    spec = TABLES[manifest.kind]
    check_size(store, manifest)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            for group in range(file.num_row_groups):
                table = spec.conform(file.read_row_group(group), where=str(path))
                yield from table.combine_chunks().to_batches()
    except (pa.ArrowException, OSError) as error:
        raise damaged_table(path, str(error)) from error


def check_size(store: LocalFolder, manifest: DerivationManifest) -> None:
    """Refuse a table that is missing or of another size than its manifest says."""
    size = store.head(manifest.path)
    if size != manifest.bytes:
        found = (
            "is missing" if size is None else f"has {size} bytes, its manifest says {manifest.bytes}"
        )
        raise damaged_table(store.local(manifest.path), found)


def damaged_table(path: Path, what: str) -> DamageError:
    """The error for a derived table that cannot be trusted."""
    return DamageError(
        f"{path}: damaged table: {what}",
        hint="turnscan repair moves it aside, turnscan process derives it again",
    )
