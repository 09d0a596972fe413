"""E57 (ASTM E2807) through pye57: metres, intensity, row and column of the sweep; a scan each.

pye57 writes a scan in one piece, so the points of one scan are in memory at a time. It knows no
further attributes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pye57
from pye57 import libe57
from pye57.libe57 import E57Exception

from . import ExportInfo
from .refusal import refusal

#: pye57 keeps row and column in 16 bits.
_INDEX_LIMIT = 65535


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:  # noqa: ARG001
    """Write ``batches``, which come ordered by scan, to ``out``."""
    file = None
    try:
        file = pye57.E57(str(out), mode="w")
        # The standard's way to add what it has no name for: an element under a namespace of our own.
        file.image_file.extensionsAdd("turnscan", "urn:turnscan:export")
        text = "\n".join(info.lines())
        file.root.set("turnscan:export", libe57.StringNode(file.image_file, text))
        held: list[pa.RecordBatch] = []
        index = 0
        for batch in batches:
            scans = batch.column("scan_index").to_numpy()
            for number in np.unique(scans):
                if number != index:
                    _put(file, held, info, index)
                    held, index = [], int(number)
                held.append(batch.filter(pa.array(scans == number)))
        _put(file, held, info, index)
        file.close()
    except E57Exception as error:
        if file is not None:
            _let_go(file)
        raise refusal(error, out) from error
    except BaseException:
        if file is not None:
            _let_go(file)
        raise


def _let_go(file: pye57.E57) -> None:
    """Close without writing what is left, and keep pye57 from trying again when it is collected."""
    with contextlib.suppress(E57Exception):
        file.image_file.cancel()
    del file.image_file


def _put(file: pye57.E57, held: list[pa.RecordBatch], info: ExportInfo, index: int) -> None:
    table = pa.Table.from_batches(held) if held else None
    if table is None or not table.num_rows:
        return

    def column(name: str) -> npt.NDArray[np.float64]:
        return table.column(name).to_numpy().astype(np.float64)

    # Rounded to what is stored: the bounds that pye57 writes must hold for the stored values.
    data = {f"cartesian{a.upper()}": _single(column(f"{a}_mm") / 1000.0) for a in "xyz"}
    data["intensity"] = _single(column("amplitude_dn"))
    row, frame = table.column("row").to_numpy(), table.column("frame").to_numpy()
    if frame.max() <= _INDEX_LIMIT:
        data["rowIndex"] = row.astype(np.int32)
        data["columnIndex"] = frame.astype(np.int32)
    file.write_scan_raw(data, name=info.scans[index])


def _single(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return values.astype(np.float32).astype(np.float64)
