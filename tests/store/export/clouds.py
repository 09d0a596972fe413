"""Point tables with every column in use, and independent readers of PLY and PCD."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from turnscan.schemas.tables import POINTS
from turnscan.store.export import ExportInfo

SCANS = ("s-01AAAAAAAAAAAAAAAAAAAAAAAA", "s-01BBBBBBBBBBBBBBBBBBBBBBBB")
ALL = (".ply", ".csv", ".parquet", ".pcd", ".las", ".laz", ".e57", ".glb", ".stl", ".obj")
POINT_FORMATS = ALL[:7]
MESHES = ALL[7:]


def batch(columns: dict[str, Any], scan: int = 0) -> pa.RecordBatch:
    """A batch as the archive gives them; columns that are left out are zero."""
    count = len(next(iter(columns.values())))
    arrays = [
        pa.array(np.asarray(columns.get(c.name, np.zeros(count)), np.dtype(c.type)))
        for c in POINTS.columns
    ]
    made = pa.RecordBatch.from_arrays(arrays, schema=POINTS.arrow_schema())
    number = pa.array(np.full(count, scan, np.uint16))
    return made.append_column(pa.field("scan_index", pa.uint16()), number)


def cloud(rows: int, scan: int = 0, seed: int = 3) -> pa.RecordBatch:
    """A sweep whose values differ in every column, with NaN where POINTS allow it."""
    rng = np.random.default_rng(seed + scan)
    columns: dict[str, Any] = {}
    for c in POINTS.columns:
        kind = np.dtype(c.type)
        if kind.kind == "f":
            columns[c.name] = rng.normal(0, 700, rows).astype(kind)
        else:
            columns[c.name] = rng.integers(0, min(np.iinfo(kind).max, 60000), rows, endpoint=True)
    columns["amplitude_dn"] = rng.uniform(1, 255, rows)
    columns["frame"] = np.arange(rows) // 40
    columns["row"] = np.arange(rows) % 40 + 300
    columns["laser"] = np.zeros(rows)
    columns["sigma_range_mm"][::5] = np.nan
    columns["x_mm"] = columns["frame"] * 1.01 + rng.normal(0, 0.01, rows)
    columns["y_mm"] = columns["row"] * -1.03 + rng.normal(0, 0.01, rows)
    columns["z_mm"] = rng.normal(500, 0.01, rows)
    return batch(columns, scan)


def info(batches: Sequence[pa.RecordBatch], **more: Any) -> ExportInfo:
    rows = sum(b.num_rows for b in batches)
    return ExportInfo(
        SCANS,
        "default (r-0123456789ab)",
        ["c-1", "c-2"],
        ["a" * 64, "b" * 64],
        "turnscan 0",
        **{"rows": rows, **more},
    )


def column(batches: Sequence[pa.RecordBatch], name: str) -> np.ndarray:
    return np.concatenate([b.column(name).to_numpy() for b in batches])


def xyz_mm(batches: Sequence[pa.RecordBatch]) -> np.ndarray:
    return np.stack([column(batches, f"{a}_mm").astype(np.float64) for a in "xyz"], axis=1)


#: Types of the PLY description (Turk 1994), little-endian.
_PLY = {
    "char": "i1",
    "uchar": "u1",
    "short": "<i2",
    "ushort": "<u2",
    "int": "<i4",
    "uint": "<u4",
    "float": "<f4",
    "double": "<f8",
}


def read_ply(path: Path) -> tuple[np.ndarray, list[str]]:
    """Vertices and comments of a binary PLY, by its description alone."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
    rest = [line.split() for line in lines[2:] if not line.startswith("comment ")]
    assert rest[0][:2] == ["element", "vertex"]
    assert {words[0] for words in rest[1:]} == {"property"}
    dtype = np.dtype([(name, _PLY[kind]) for _, kind, name in rest[1:]])
    assert len(body) == int(rest[0][2]) * dtype.itemsize
    return np.frombuffer(body, dtype), comments


def read_pcd(path: Path) -> tuple[np.ndarray, list[str]]:
    """Points and comments of a binary PCD 0.7, by its description alone."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    lines = head.decode("ascii").splitlines()
    comments = [line[2:] for line in lines if line.startswith("# ")]
    entries = [line.split(" ", 1) for line in lines if not line.startswith("#")]
    order = ["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"]
    assert [name for name, _ in entries] == order
    of = dict(entries)
    kinds = [t.lower() + s for t, s in zip(of["TYPE"].split(), of["SIZE"].split(), strict=True)]
    assert set(of["COUNT"].split()) == {"1"}
    dtype = np.dtype(list(zip(of["FIELDS"].split(), [f"<{k}" for k in kinds], strict=True)))
    assert int(of["POINTS"]) == int(of["WIDTH"]) * int(of["HEIGHT"])
    assert len(body) == int(of["POINTS"]) * dtype.itemsize
    return np.frombuffer(body, dtype), comments
