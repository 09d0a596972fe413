"""CSV: a header with the units in the names, a row a point."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pc

from ...schemas.tables import POINTS
from . import ExportInfo


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``; ``scan`` is the scan's id."""
    schema = pa.schema([pa.field("scan", pa.string()), *POINTS.arrow_schema()])
    with out.open("wb") as file, pc.CSVWriter(file, schema) as writer:
        for batch in batches:
            scans = pa.array(info.scans, pa.string()).take(batch.column("scan_index"))
            columns = [scans, *(batch.column(c.name) for c in POINTS.columns)]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
