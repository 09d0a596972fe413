"""Columns of single frames gathered into Arrow record batches of a table, memory bounded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..schemas.tables import TableSpec

if TYPE_CHECKING:
    import pyarrow as pa

Columns = Mapping[str, Any]

#: Rows gathered before a batch is handed on: about 2.5 MB of STRIPES, and a row group of their file.
BATCH_ROWS = 65_536


def record_batches(spec: TableSpec, parts: Iterable[Columns]) -> Iterator[pa.RecordBatch]:
    """Batches of ``spec`` from ``parts``, each a mapping of column name to array of equal length.

    Values are cast to the declared types here, the one place where float64 becomes float32.
    """
    schema = spec.arrow_schema()
    held: list[Columns] = []
    rows = 0
    for part in parts:
        n = len(part[spec.columns[0].name])
        if not n:
            continue
        held.append(part)
        rows += n
        if rows >= BATCH_ROWS:
            yield _batch(spec, held, schema)
            held, rows = [], 0
    if held:
        yield _batch(spec, held, schema)


def _batch(spec: TableSpec, held: list[Columns], schema: pa.Schema) -> pa.RecordBatch:
    import pyarrow as pa

    arrays = []
    for column, field in zip(spec.columns, schema, strict=True):
        pieces = [np.asarray(part[column.name]) for part in held]
        joined = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
        arrays.append(pa.array(joined.astype(column.type, copy=False), type=field.type))
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def columns_of(batch: pa.RecordBatch) -> dict[str, np.ndarray[Any, Any]]:
    """The columns of a batch as NumPy arrays, without a copy."""
    return {
        name: batch.column(i).to_numpy(zero_copy_only=True) for i, name in enumerate(batch.schema.names)
    }
