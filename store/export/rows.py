"""Points as packed structured arrays, for formats that store them one after another."""

from __future__ import annotations

from collections.abc import Iterable
from io import BufferedWriter

import numpy as np
import pyarrow as pa

from ...schemas.tables import POINTS

#: Viewers look for x, y, z; the unit stands in a comment.
XYZ = {"x_mm": "x", "y_mm": "y", "z_mm": "z"}
_REST = [c for c in POINTS.columns if c.name not in XYZ]
_FIRST = [c for c in POINTS.columns if c.name in XYZ]
_COLUMNS = [*((c.name, c.type) for c in (*_FIRST, *_REST)), ("scan_index", "uint16")]

#: One point, little-endian without gaps: x, y, z first, as readers expect, then the other columns.
POINT = np.dtype([(XYZ.get(n, n), np.dtype(t).newbyteorder("<")) for n, t in _COLUMNS])


#: Points packed at a time: few enough that each column's pass finds them in the CPU's cache.
_STEP = 8192


def write_packed(file: BufferedWriter, batches: Iterable[pa.RecordBatch]) -> None:
    """Write the rows of ``batches`` as POINT, one after another."""
    buffer = np.empty(_STEP, POINT)
    for batch in batches:
        columns = [(XYZ.get(n, n), batch.column(n).to_numpy()) for n, _ in _COLUMNS]
        for at in range(0, batch.num_rows, _STEP):
            rows = buffer[: batch.num_rows - at]
            for name, values in columns:
                rows[name] = values[at : at + _STEP]
            file.write(rows.view(np.uint8).data)
