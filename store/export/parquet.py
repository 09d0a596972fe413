"""Parquet of one or several scans, with the columns' units and meanings in the field metadata."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ...schemas.tables import POINTS
from . import ExportInfo


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``; ``scan`` is the scan's id."""
    schema = pa.schema([pa.field("scan", pa.string(), nullable=False), *POINTS.arrow_schema()])
    schema = schema.with_metadata({"turnscan.export": "; ".join(info.lines())})
    floats = [c.name for c in POINTS.columns if c.type.startswith("float")]
    with pq.ParquetWriter(
        out,
        schema,
        compression="zstd",
        compression_level=1,
        use_dictionary=[name for name in schema.names if name not in floats],
        column_encoding=dict.fromkeys(floats, "BYTE_STREAM_SPLIT"),
        write_page_checksum=True,
    ) as writer:
        for batch in batches:
            scans = pa.array(info.scans, pa.string()).take(batch.column("scan_index"))
            columns = [scans, *(batch.column(c.name) for c in POINTS.columns)]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
