"""Derived tables: written aside as Parquet, published under their key, manifest last; read back
with every page's checksum compared.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..schemas.document import dump_json
from ..schemas.errors import DamageError
from ..schemas.manifests import DerivationManifest, Kind
from ..schemas.software import __version__
from ..schemas.tables import TABLES
from . import layout
from .bytes import LocalFolder
from .drafts import file_sha256
from .projection import read_manifest
from .table_file import TableFile

if TYPE_CHECKING:
    import pyarrow as pa


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


class TableDraft:
    """One derivation while it is written, aside; :meth:`publish` gives it its name.

    ``fields`` of its manifest are those of :class:`DerivationManifest` but kind, path, rows, bytes,
    sha256, created_ns, duration_s, made_with and table_version.
    """

    def __init__(self, store: LocalFolder, kind: Kind, file: TableFile) -> None:
        self._store = store
        self._kind = kind
        self._file = file
        self._began = time.monotonic()
        self._fields: Mapping[str, Any] = {}
        self._finished: Callable[[], tuple[int, str]] | None = None

    @property
    def rows(self) -> int:
        """Rows taken so far."""
        return self._file.rows

    def take(self, batch: pa.RecordBatch) -> None:
        """Add rows, sorted by the table's order; see :meth:`TableFile.take`."""
        self._file.take(batch)

    def finish(self, fields: Mapping[str, Any]) -> None:
        """All rows were taken: write the end of the file, in the background if it is large."""
        about = {f"turnscan.{k}": str(fields[k]) for k in ("key", "scan", "recipe")}
        self._fields = fields
        self._finished = self._file.finish(about)

    def publish(self) -> DerivationManifest:
        """Publish and seal what :meth:`finish` ended; returns the manifest that stands.

        If another process published the same key first, its result stands and ours is dropped.
        """
        assert self._finished is not None, "finish() comes first"
        size, sha256 = self._finished()
        values = self._fields
        folder = layout.derivation_folder(
            self._kind,
            recipe=values["recipe"],
            calibration=values["calibration"],
            scan=values["scan"],
        )
        manifest_path = layout.manifest_file(folder, values["key"])
        manifest = DerivationManifest(
            kind=self._kind,
            **values,
            path=layout.table_file(folder, values["key"]),
            table_version=TABLES[self._kind].version,
            rows=self.rows,
            bytes=size,
            sha256=sha256,
            created_ns=time.time_ns(),
            duration_s=round(time.monotonic() - self._began, 3),
            made_with=dict(made_with()),
        ).sealed()
        with self._store.holding(alone=False):
            return _put(self._store, manifest, manifest_path, self._file.path)


@contextmanager
def drafting(store: LocalFolder, kind: Kind, *, behind: bool) -> Iterator[TableDraft]:
    """A draft of one derived table; what was not published at the end is removed.

    ``behind``: row groups are compressed and written in a thread of their own.

    Raises
    ------
    StorageError
        The disk refuses.
    """
    with store.staged(".parquet") as aside, TableFile(aside, TABLES[kind], behind=behind) as file:
        yield TableDraft(store, kind, file)


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
