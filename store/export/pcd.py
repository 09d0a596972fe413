"""Binary PCD 0.7 (Point Cloud Library file format), every column of POINTS as a field."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa

from ...schemas.tables import POINTS
from . import ExportInfo
from .rows import packed, packed_dtype

_NAMES = {"x_mm": "x", "y_mm": "y", "z_mm": "z"}
_KINDS = {"u": "U", "i": "I", "f": "F"}


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``."""
    schema = POINTS.arrow_schema().append(pa.field("scan_index", pa.uint16()))
    dtype = packed_dtype(schema, _NAMES)
    with out.open("wb", buffering=0) as file:
        file.write(_head(dtype, info))
        for batch in batches:
            file.write(packed(batch, dtype).data.cast("B"))


def _head(dtype: np.dtype[np.void], info: ExportInfo) -> bytes:
    names = dtype.names or ()
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "# lengths in mm"]
    lines += [f"# {line}" for line in info.lines()]
    lines += [
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(dtype[n].itemsize) for n in names)}",
        f"TYPE {' '.join(_KINDS[dtype[n].kind] for n in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {info.rows}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {info.rows}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode()
