"""Binary PCD 0.7 (Point Cloud Library file format), every column of POINTS as a field."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa

from . import ExportInfo
from .rows import POINT, write_packed

_KINDS = {"u": "U", "i": "I", "f": "F"}


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Stream ``batches`` to ``out``."""
    # Buffered: a raw file may take a part of the bytes of a full disk and raise nothing.
    with out.open("wb") as file:
        file.write(_head(info))
        write_packed(file, batches)


def _head(info: ExportInfo) -> bytes:
    names = POINT.names or ()
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "# lengths in mm"]
    lines += [f"# {line}" for line in info.lines()]
    lines += [
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(POINT[n].itemsize) for n in names)}",
        f"TYPE {' '.join(_KINDS[POINT[n].kind] for n in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {info.rows}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {info.rows}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "backslashreplace")
