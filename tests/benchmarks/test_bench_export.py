"""Exporting a million points, against writing the same bytes to the same file system."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from turnscan.schemas.tables import POINTS
from turnscan.store.export import ExportInfo, export_points

pytestmark = pytest.mark.benchmark

ROWS = 1_000_000
BATCH = 262_144


def million() -> list[pa.RecordBatch]:
    """A million points in batches as the archive gives them."""
    rng = np.random.default_rng(5)
    arrays = []
    for c in POINTS.columns:
        kind = np.dtype(c.type)
        if kind.kind == "f":
            arrays.append(pa.array(rng.normal(200, 50, ROWS).astype(kind)))
        else:
            arrays.append(pa.array((np.arange(ROWS) // 977 % 250).astype(kind)))
    whole = pa.RecordBatch.from_arrays(arrays, schema=POINTS.arrow_schema())
    number = pa.array(np.zeros(ROWS, np.uint16))
    whole = whole.append_column(pa.field("scan_index", pa.uint16()), number)
    return [whole.slice(at, BATCH) for at in range(0, ROWS, BATCH)]


def cpu(work: Callable[[], None]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def write_bytes(path: Path, data: bytes) -> None:
    with path.open("wb", buffering=0) as file:
        file.write(data)
        os.fsync(file.fileno())


#: Format -> ratio that is wanted, or None where the number is for information.
TARGETS = {".ply": 3.0, ".pcd": None, ".parquet": None, ".csv": None}


def test_export_against_writing_the_same_bytes(tmp_path: Path) -> None:
    batches = million()
    info = ExportInfo(["s-1"], "default (r-1)", ["c-1"], ["k-1"], "turnscan", ROWS)
    best = dict.fromkeys(TARGETS, float("inf"))
    raw = dict.fromkeys(TARGETS, float("inf"))
    sizes = {}
    for turn in range(5):
        for suffix, target in TARGETS.items():
            if turn > 1 and target is None:
                continue
            out = tmp_path / f"cloud{suffix}"
            took = cpu(lambda out=out: export_points(batches, out, info, overwrite=True))
            best[suffix] = min(best[suffix], took)
            data = out.read_bytes()
            sizes[suffix] = len(data)
            took = cpu(lambda data=data: write_bytes(tmp_path / "raw", data))
            raw[suffix] = min(raw[suffix], took)
    print()
    for suffix, target in TARGETS.items():
        wanted = "for information" if target is None else f"target {target}"
        print(
            f"export 1 M points to {suffix}, CPU over writing its {sizes[suffix] / 1e6:.0f} MB: "
            f"ratio {best[suffix] / raw[suffix]:.2f} ({best[suffix] * 1e3:.0f} ms), {wanted}"
        )
    for suffix, target in TARGETS.items():
        if target is not None:
            assert best[suffix] / raw[suffix] < 3 * target
