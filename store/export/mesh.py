"""A mesh of the ordered sweep through trimesh: neighbours in row and frame become triangles.

- Triangles span only neighbours that lie near each other, so that depth edges stay open: no edge is
  longer than eight times the median distance of neighbours along the stripe, or of neighbours across
  frames, whichever of the two is larger.
- A full turn closes: where the angle from the last frame on to the first is about one more step,
  these two are neighbours.
- Triangles face the camera. Where ``ExportInfo.viewpoints`` does not tell where it was, their winding
  follows the order of frames and rows.
- STL and OBJ are in mm; GLB in metres with +Y up, as glTF wants.

A mesh needs all of its points in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import trimesh

from ...schemas.errors import InputError
from . import ExportInfo, Viewpoint

_REACH = 8.0

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:
    """Write the mesh of all ``batches`` to ``out``."""
    held = list(batches)
    if not info.rows:
        raise InputError("there are no points to make a mesh of", hint="turnscan status")
    table = pa.Table.from_batches(held)
    columns = {n: table.column(n).to_numpy() for n in table.column_names}
    points = np.stack([columns[f"{a}_mm"].astype(np.float64) for a in "xyz"], axis=1)
    faces = sweep_faces(points, columns, info.viewpoints)
    if not len(faces):
        raise InputError(
            "no points are neighbours of each other: there is no mesh",
            hint="export points (.ply) instead",
        )
    if suffix == ".glb":
        points = points[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0]) / 1000.0
    mesh = trimesh.Trimesh(points, faces, process=False)
    mesh.metadata["turnscan"] = "; ".join(info.lines())
    header = {"header": "\n# ".join(info.lines())} if suffix == ".obj" else {}
    data: Any = mesh.export(file_type=suffix[1:], **header)
    data = data if isinstance(data, bytes) else data.encode("ascii", "backslashreplace")
    if suffix == ".stl":
        # Binary STL begins with 80 bytes that are free, but must not read "solid".
        data = info.short().encode()[:80].ljust(80) + data[80:]
    out.write_bytes(data)


def sweep_faces(
    points: Floats, columns: dict[str, npt.NDArray[Any]], viewpoints: Sequence[Viewpoint] = ()
) -> Ints:
    """Triangles (M, 3) between points (N, 3) of neighbouring rows and frames of one laser and scan."""
    scan, laser = columns["scan_index"], columns["laser"]
    parts = []
    for s, n in np.unique(np.stack([scan, laser], axis=1), axis=0):
        index = np.flatnonzero((scan == s) & (laser == n))
        frame, row, angle = (columns[c][index] for c in ("frame", "row", "angle_rad"))
        faces = index[_grid_faces(points[index], frame, row, angle.astype(np.float64))]
        if viewpoints:
            faces = _facing(points, faces, columns["angle_rad"], viewpoints[int(s)])
        parts.append(faces)
    return np.concatenate(parts) if parts else np.zeros((0, 3), np.int64)


def _grid_faces(points: Floats, frame: npt.NDArray[Any], row: npt.NDArray[Any], angle: Floats) -> Ints:
    frames, first, column = np.unique(frame, return_index=True, return_inverse=True)
    rows = row.astype(np.int64) - int(row.min())
    grid = np.full((len(frames), int(rows.max()) + 1), -1, np.int64)
    grid[column, rows] = np.arange(len(points))
    if _closes(angle[first]):
        grid = np.concatenate([grid, grid[:1]])
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


def _closes(angle_rad: Floats) -> bool:
    """Whether one more step from the last of these angles leads to the first, once around."""
    if len(angle_rad) < 3:
        return False
    # Angles may be recorded as they go on (370 deg) or wrapped (10 deg): steps are the same.
    steps = np.remainder(np.diff(angle_rad) + np.pi, 2 * np.pi) - np.pi
    step = float(np.median(steps))
    gap = np.copysign(2 * np.pi, step) - float(steps.sum())
    return bool(abs(gap - step) <= 0.5 * abs(step))


def _facing(points: Floats, faces: Ints, angle_rad: npt.NDArray[Any], viewpoint: Viewpoint) -> Ints:
    """``faces``, wound so that each is counterclockwise as its camera saw it."""
    turn = viewpoint.turn_sign * angle_rad[faces].astype(np.float64)
    x, y, z = viewpoint.centre_mm
    seen_from = np.stack(
        [
            np.cos(turn) * x - np.sin(turn) * y,
            np.sin(turn) * x + np.cos(turn) * y,
            np.full_like(turn, z),
        ],
        axis=-1,
    ).mean(axis=1)
    a, b, c = (points[faces[:, i]] for i in range(3))
    away = (np.cross(b - a, c - a) * (seen_from - (a + b + c) / 3)).sum(axis=1) < 0
    return np.where(away[:, None], faces[:, ::-1], faces)


def _median_length(points: Floats, a: Ints, b: Ints) -> float:
    both = (a >= 0) & (b >= 0)
    if not both.any():
        return 0.0
    return float(np.median(np.sqrt(((points[a[both]] - points[b[both]]) ** 2).sum(axis=1))))
