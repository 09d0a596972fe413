"""Binary little-endian PLY (Turk 1994) with every column of POINTS as a vertex property."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa

from ...schemas.tables import POINTS
from . import ExportInfo
from .rows import packed, packed_dtype

_TYPES = {"u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int", "f4": "float", "f8": "double"}
#: Viewers look for x, y, z; the unit stands in a comment.
_NAMES = {"x_mm": "x", "y_mm": "y", "z_mm": "z"}


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``."""
    with out.open("wb", buffering=0) as file:
        dtype: np.dtype[np.void] | None = None
        for batch in batches:
            if dtype is None:
                dtype = packed_dtype(_ordered(batch).schema, _NAMES)
                file.write(_head(dtype, info))
            file.write(packed(_ordered(batch), dtype).data.cast("B"))
        if dtype is None:
            schema = POINTS.arrow_schema().append(pa.field("scan_index", pa.uint16()))
            empty = pa.RecordBatch.from_pylist([], schema=schema)
            file.write(_head(packed_dtype(_ordered(empty).schema, _NAMES), info))


def _ordered(batch: pa.RecordBatch) -> pa.RecordBatch:
    """x, y, z first, as every reader expects."""
    names = batch.schema.names
    return batch.select([*_NAMES, *(n for n in names if n not in _NAMES)])


def _head(dtype: np.dtype[np.void], info: ExportInfo) -> bytes:
    units = {_NAMES.get(c.name, c.name): c for c in POINTS.columns}
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for line in info.lines()]
    for name in dtype.names or ():
        if name in units:
            unit = f" [{units[name].unit}]" if units[name].unit else ""
            lines.append(f"comment {name}{unit}: {units[name].description}")
    lines.append(f"element vertex {info.rows}")
    for name in dtype.names or ():
        lines.append(f"property {_TYPES[dtype[name].str[1:]]} {name}")
    return ("\n".join([*lines, "end_header"]) + "\n").encode()
