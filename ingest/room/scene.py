"""A scene made ready for rays: the document's shapes as arrays, meshes read and sorted into a tree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...schemas import scene as document
from ...schemas.errors import InputError
from .mesh_reading import read_mesh
from .rays import BOX, CYLINDER, NUMBERS, PLANE, ROOM, SPHERE, Floats, Ints, Packed, cast_all

#: Triangles in a leaf of the tree.
_LEAF = 4


def turned(turn_deg: Sequence[float]) -> Floats:
    """Rotation (3, 3) by angles about x, then y, then z: ``scene_from_shape``."""
    out = np.eye(3)
    for axis, angle in enumerate(turn_deg):
        quarter, rest = divmod(angle, 90.0)
        # Quarter turns are exact, so that a box turned by 90 degrees is still square to the axes.
        c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter) % 4]
        if rest:
            c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        i, j = ((1, 2), (2, 0), (0, 1))[axis]
        step = np.eye(3)
        step[i, i], step[i, j], step[j, i], step[j, j] = c, -s, s, c
        out = step @ out
    return out


@dataclass(frozen=True)
class Hits:
    """Where rays end: distance (N,) (inf: nowhere), points (N, 3), shape (N,) (-1: none), face, normal.

    ``shape`` counts the document's shapes; ``normal`` looks against the ray.
    """

    distance_mm: Floats
    points_mm: Floats
    shape: Ints
    face: Ints
    normal: Floats


class Scene:
    """Shapes in scene space that rays can be cast at.

    Parameters
    ----------
    shapes
        Shapes of a scene document.
    folder
        What mesh files are relative to; InputError if one cannot be read.
    """

    def __init__(self, shapes: Sequence[document.Shape], *, folder: Path | None = None) -> None:
        self.shapes = tuple(shapes)
        self.albedo: Floats = np.array([shape.albedo for shape in self.shapes], np.float64)
        kinds, numbers, names = [], [], []
        corners: list[Floats] = [np.empty((0, 3, 3))]
        owners: list[Ints] = [np.empty(0, np.int64)]
        for i, shape in enumerate(self.shapes):
            if isinstance(shape, document.Mesh):
                found = _mesh_triangles(shape, folder)
                corners.append(found)
                owners.append(np.full(len(found), i, np.int64))
                continue
            kind, half = _simple(shape)
            kinds.append(kind)
            names.append(i)
            numbers.append([*turned(shape.turn_deg).T.ravel(), *shape.at_mm, *half])
        self.packed = _with_tree(
            np.array(kinds, np.int64),
            np.array(numbers, np.float64).reshape(-1, NUMBERS),
            np.concatenate(corners),
            np.concatenate(owners),
            np.array(names, np.int64),
        )

    def cast(self, origin_mm: Floats, direction: Floats) -> Hits:
        """The first surface that each unit ray (N, 3) from ``origin_mm`` (3,) or (N, 3) meets."""
        start = np.ascontiguousarray(np.broadcast_to(origin_mm, direction.shape), np.float64)
        ray = np.ascontiguousarray(direction, np.float64)
        distance, shape, face, normal = cast_all(self.packed, start, ray)
        with np.errstate(invalid="ignore"):
            points = start + distance[:, None] * ray
        return Hits(distance, points, shape, face, normal)


def _simple(shape: document.Shape) -> tuple[int, tuple[float, float, float]]:
    """The kind and the half sizes of a shape that is no mesh."""
    if isinstance(shape, document.Plane):
        x, y = shape.size_mm or (math.inf, math.inf)
        return PLANE, (x / 2, y / 2, 0.0)
    if isinstance(shape, document.Box | document.Room):
        x, y, z = shape.size_mm
        return BOX if isinstance(shape, document.Box) else ROOM, (x / 2, y / 2, z / 2)
    if isinstance(shape, document.Sphere):
        return SPHERE, (shape.radius_mm,) * 3
    assert isinstance(shape, document.Cylinder)
    return CYLINDER, (shape.radius_mm, shape.radius_mm, (shape.height_mm or math.inf) / 2)


def _mesh_triangles(shape: document.Mesh, folder: Path | None) -> Floats:
    """Corners (T, 3, 3) in scene space; triangles without area are left out."""
    if shape.file is None:
        corners = np.array(shape.vertices_mm, np.float64)[np.array(shape.triangles, np.int64)]
    else:
        corners = read_mesh((folder or Path()) / shape.file) * shape.mm_per_unit
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners = corners[(area != 0).any(axis=1)]
    if not len(corners):
        raise InputError(
            f"mesh {shape.file or 'in the scene'}: no triangle of it has an area",
            hint="give a mesh of triangles that are not degenerate",
        )
    return corners @ turned(shape.turn_deg).T + np.array(shape.at_mm)


def _with_tree(kind: Ints, number: Floats, corners: Floats, owner: Ints, name: Ints) -> Packed:
    """Sort triangles along a space-filling curve, and halve them into a tree of boxes."""
    order = np.argsort(_along_curve(corners.mean(axis=1)), kind="stable") if len(corners) else owner
    corners = corners[order]
    links = _halved(len(corners))
    boxes = np.empty((len(links), 6))
    leaves = np.array([n for n, link in enumerate(links) if link[1]], np.int64)
    if len(leaves):
        begins = [links[n][0] for n in leaves]
        boxes[leaves, :3] = np.minimum.reduceat(corners.min(axis=1), begins, axis=0)
        boxes[leaves, 3:] = np.maximum.reduceat(corners.max(axis=1), begins, axis=0)
    for node in range(len(links) - 1, -1, -1):
        if links[node][1] == 0:
            # Its first half follows it; the second half is what that one goes on with.
            one, two = boxes[node + 1], boxes[links[node + 1][2]]
            boxes[node, :3] = np.minimum(one[:3], two[:3])
            boxes[node, 3:] = np.maximum(one[3:], two[3:])
    edges = np.stack(
        [corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1
    )
    link = np.array(links, np.int64).reshape(-1, 3)
    return Packed(kind, number, np.ascontiguousarray(edges), owner[order], boxes, link, name)


def _halved(count: int) -> list[list[int]]:
    """The nodes of a tree over ``count`` things in order; see :class:`~.rays.Packed`."""
    links: list[list[int]] = []
    # Parts still to be split, the next one in depth-first order last; nodes whose part has not ended.
    todo = [(0, count)] if count else []
    open_until: list[tuple[int, int]] = []
    while todo:
        begin, end = todo.pop()
        node = len(links)
        while open_until and open_until[-1][1] <= begin:
            links[open_until.pop()[0]][2] = node
        open_until.append((node, end))
        leaf = end - begin <= _LEAF
        links.append([begin, end - begin if leaf else 0, 0])
        if not leaf:
            half = (begin + end) // 2
            todo += [(half, end), (begin, half)]
    for node, _ in open_until:
        links[node][2] = len(links)
    return links


def _along_curve(points: Floats) -> npt.NDArray[np.uint64]:
    """The places of points (N, 3) along Morton's curve (IBM report, 1966), with 21 bits an axis."""
    low = points.min(axis=0)
    extent = np.maximum(points.max(axis=0) - low, 1e-12)
    cell = ((points - low) / extent * (2**21 - 1)).astype(np.uint64)
    out = np.zeros(len(points), np.uint64)
    for bit in range(21):
        for axis in range(3):
            at = np.uint64(3 * bit + axis)
            out |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << at
    return out
