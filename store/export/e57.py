"""E57 (ASTM E2807) through pye57: metres, intensity, row and column of the sweep; a scan each.

pye57 writes a scan in one piece, so the points of one scan are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pye57

from . import ExportInfo


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Write ``batches``, which come ordered by scan, to ``out``."""
    file = pye57.E57(str(out), mode="w")
    try:
        held: list[pa.RecordBatch] = []
        index = 0
        for batch in batches:
            for number in np.unique(batch.column("scan_index").to_numpy()):
                if number != index:
                    _put(file, held, info, index)
                    held, index = [], int(number)
                mine = batch.filter(pa.compute.equal(batch.column("scan_index"), number))
                held.append(mine)
        _put(file, held, info, index)
    finally:
        file.close()


def _put(file: pye57.E57, held: list[pa.RecordBatch], info: ExportInfo, index: int) -> None:
    if not held:
        return
    table = pa.Table.from_batches(held)

    def column(name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return table.column(name).to_numpy().astype(np.float64)

    data = {f"cartesian{a.upper()}": column(f"{a}_mm") / 1000.0 for a in "xyz"}
    data["intensity"] = column("amplitude_dn")
    data["rowIndex"] = column("row").astype(np.int32)
    data["columnIndex"] = column("frame").astype(np.int32)
    file.write_scan_raw(data, name=info.scans[index])
