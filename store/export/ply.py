"""Binary little-endian PLY (Turk 1994) with every column of POINTS as a vertex property."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa

from ...schemas.tables import POINTS
from . import ExportInfo
from .rows import POINT, XYZ, write_packed

_TYPES = {"u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int", "f4": "float", "f8": "double"}


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``."""
    # Buffered: a raw file may take a part of the bytes of a full disk and raise nothing.
    with out.open("wb") as file:
        file.write(_head(info))
        write_packed(file, batches)


def _head(info: ExportInfo) -> bytes:
    units = {XYZ.get(c.name, c.name): c for c in POINTS.columns}
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for line in info.lines()]
    for name, column in units.items():
        unit = f" [{column.unit}]" if column.unit else ""
        lines.append(f"comment {name}{unit}: {column.description}")
    lines.append("comment scan_index: number of the scan in the list above, from 0")
    lines.append(f"element vertex {info.rows}")
    for name in POINT.names or ():
        lines.append(f"property {_TYPES[POINT[name].str[1:]]} {name}")
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "backslashreplace")
