"""CSV: a header with the units in the names, a row a point."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pc

from ...schemas.tables import POINTS
from . import ExportInfo


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``; the columns that are no points say what made them.

    CSV has no comments that every reader skips, so recipe, calibration and key stand in each row; the
    key is shortened to the name of its table in the archive.
    """
    origin = {
        "recipe": [info.recipe] * len(info.scans),
        "calibration": info.calibrations,
        "key": [f"k-{key[:12]}" for key in info.keys],
    }
    texts = [pa.field(n, pa.string()) for n in ("scan", *origin)]
    schema = pa.schema([texts[0], *POINTS.arrow_schema(), *texts[1:]])
    with out.open("wb") as file, pc.CSVWriter(file, schema) as writer:
        for batch in batches:
            index = batch.column("scan_index")
            scans, *rest = (
                pa.array(values, pa.string()).take(index) for values in (info.scans, *origin.values())
            )
            columns = [scans, *(batch.column(c.name) for c in POINTS.columns), *rest]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
