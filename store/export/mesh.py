"""A mesh of the ordered sweep through trimesh: neighbours in row and frame become triangles.

Triangles span only neighbours that lie near each other, so that depth edges stay open: an edge may be
at most eight times the median distance of neighbours along the stripe or across frames. Triangles
face the scanner. STL and OBJ are in mm; GLB in metres with +Y up, as glTF wants. A mesh needs all of
its points in memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import trimesh

from ...schemas.errors import InputError
from . import ExportInfo

_REACH = 8.0


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:
    """Write the mesh of all ``batches`` to ``out``."""
    table = pa.Table.from_batches(list(batches)) if info.rows else None
    if table is None:
        raise InputError(f"{out}: there are no points to make a mesh of")
    columns = {n: table.column(n).to_numpy() for n in table.column_names}
    points = np.stack([columns[f"{a}_mm"].astype(np.float64) for a in "xyz"], axis=1)
    faces = sweep_faces(
        points, columns["scan_index"], columns["laser"], columns["frame"], columns["row"]
    )
    if not len(faces):
        raise InputError(
            f"{out}: no points are neighbours of each other", hint="export points (.ply) instead"
        )
    if suffix == ".glb":
        points = points[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0]) / 1000.0
    mesh = trimesh.Trimesh(points, faces, process=False)
    mesh.metadata["turnscan"] = "; ".join(info.lines())
    data: Any = mesh.export(file_type=suffix[1:])
    out.write_bytes(data if isinstance(data, bytes) else data.encode())


def sweep_faces(
    points: npt.NDArray[np.float64],
    scan: npt.NDArray[Any],
    laser: npt.NDArray[Any],
    frame: npt.NDArray[Any],
    row: npt.NDArray[Any],
) -> npt.NDArray[np.int64]:
    """Triangles (M, 3) between points (N, 3) of neighbouring rows and frames of one laser and scan."""
    parts = []
    for s, n in np.unique(np.stack([scan, laser], axis=1), axis=0):
        index = np.flatnonzero((scan == s) & (laser == n))
        parts.append(_grid_faces(points, index, frame[index], row[index]))
    return np.concatenate(parts) if parts else np.zeros((0, 3), np.int64)


def _grid_faces(
    points: npt.NDArray[np.float64],
    index: npt.NDArray[np.int64],
    frame: npt.NDArray[Any],
    row: npt.NDArray[Any],
) -> npt.NDArray[np.int64]:
    frames, column = np.unique(frame, return_inverse=True)
    rows = row.astype(np.int64) - int(row.min())
    grid = np.full((len(frames), int(rows.max()) + 1), -1, np.int64)
    grid[column, rows] = index
    # A full turn closes: its last frame is a neighbour of its first.
    a, b = grid[:-1, :-1], grid[:-1, 1:]
    c, d = grid[1:, :-1], grid[1:, 1:]
    along = _median_length(points, a, b)
    across = _median_length(points, a, c)
    limit = _REACH * max(along, across)
    faces = []
    for triangle in ((a, b, c), (b, d, c)):
        t = np.stack([x.ravel() for x in triangle], axis=1)
        t = t[(t >= 0).all(axis=1)]
        edges = points[t] - points[np.roll(t, 1, axis=1)]
        t = t[(np.sqrt((edges**2).sum(axis=2)) <= limit).all(axis=1)]
        faces.append(t)
    return np.concatenate(faces)


def _median_length(
    points: npt.NDArray[np.float64], a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]
) -> float:
    both = (a >= 0) & (b >= 0)
    if not both.any():
        return 0.0
    return float(np.median(np.sqrt(((points[a[both]] - points[b[both]]) ** 2).sum(axis=1))))
