"""Rays against shapes, compiled: the first thing that a ray meets.

Shapes are rows of numbers in their own space: 0-8 ``shape_from_scene`` rotation by rows, 9-11 centre in
the scene, 12-14 half sizes (plane: x, y; box: x, y, z; sphere, cylinder: radius, radius, half height).
Triangles stand in scene space under one tree of boxes. Directions are unit vectors.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from .compiling import compiled

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

PLANE: Final = 0
BOX: Final = 1
ROOM: Final = 2
SPHERE: Final = 3
CYLINDER: Final = 4
NUMBERS: Final = 15

#: A ray through the very edge between two triangles must not slip between them by rounding.
_EDGE = 1e-12


class Packed(NamedTuple):
    """A scene as arrays: S shapes, T triangles (sorted as the tree wants them), N nodes of the tree."""

    kind: Ints
    number: Floats
    #: (T, 3, 3): a corner and the two edges from it.
    triangle: Floats
    #: (T,) index of the mesh among the document's shapes.
    owner: Ints
    #: (N, 6): low and high corner of each node's box.
    box: Floats
    #: (N, 3): first triangle, how many (0: an inner node), and the node to go on with if this one's box
    #: is missed. Nodes stand in depth-first order, so a box that is met goes on with the next one.
    link: Ints
    #: (S,) index of each shape among the document's shapes.
    name: Ints


@compiled
def _box_interval(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hx: float, hy: float, hz: float
) -> tuple[float, float, int, int]:
    """Entry and exit of the block [-h, h], and the axes on which they happen."""
    near, far, near_axis, far_axis = -math.inf, math.inf, 0, 0
    for axis, o, d, h in ((0, ox, dx, hx), (1, oy, dy, hy), (2, oz, dz, hz)):
        if d == 0.0:
            # Along a slab: in it all the way, or never.
            if o < -h or o > h:
                return math.inf, -math.inf, 0, 0
            continue
        a, b = (-h - o) / d, (h - o) / d
        if a > b:
            a, b = b, a
        if a > near:
            near, near_axis = a, axis
        if b < far:
            far, far_axis = b, axis
    return near, far, near_axis, far_axis


@compiled
def _meet(
    kind: int,
    number: Floats,
    s: int,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, int]:
    """Distance to one shape in its own space (inf: none), and the face that is met."""
    if kind == PLANE:
        if dz == 0.0:
            return math.inf, 0
        t = -oz / dz
        if t > 0.0 and abs(ox + t * dx) <= number[s, 12] and abs(oy + t * dy) <= number[s, 13]:
            return t, 0
        return math.inf, 0
    if kind in {BOX, ROOM}:
        near, far, near_axis, far_axis = _box_interval(
            ox, oy, oz, dx, dy, dz, number[s, 12], number[s, 13], number[s, 14]
        )
        if near > far:
            return math.inf, 0
        if kind == BOX:
            d = dx if near_axis == 0 else dy if near_axis == 1 else dz
            return (near, near_axis * 2 + (1 if d < 0 else 0)) if near > 0.0 else (math.inf, 0)
        d = dx if far_axis == 0 else dy if far_axis == 1 else dz
        return (far, far_axis * 2 + (1 if d > 0 else 0)) if far > 0.0 else (math.inf, 0)
    if kind == SPHERE:
        b = ox * dx + oy * dy + oz * dz
        root = b * b - (ox * ox + oy * oy + oz * oz - number[s, 12] * number[s, 12])
        if root < 0.0:
            return math.inf, 0
        t = -b - math.sqrt(root)
        return (t, 0) if t > 0.0 else (math.inf, 0)
    # A cylinder: its mantle between the lids, or a lid within the mantle.
    best, face = math.inf, 0
    a = dx * dx + dy * dy
    if a > 0.0:
        b = ox * dx + oy * dy
        root = b * b - a * (ox * ox + oy * oy - number[s, 12] * number[s, 12])
        if root >= 0.0:
            t = (-b - math.sqrt(root)) / a
            if t > 0.0 and abs(oz + t * dz) <= number[s, 14]:
                best = t
    if number[s, 14] < math.inf and dz != 0.0:
        t = ((number[s, 14] if dz < 0 else -number[s, 14]) - oz) / dz
        x, y = ox + t * dx, oy + t * dy
        if 0.0 < t < best and x * x + y * y <= number[s, 12] * number[s, 12]:
            best, face = t, 2 if dz < 0 else 1
    return best, face


@compiled
def _triangles(
    packed: Packed,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    best: float,
) -> tuple[float, int]:
    """The nearest triangle before ``best``: its distance and number (-1: none).

    Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", J. Graphics Tools 2 (1997).
    """
    triangle, box, link = packed.triangle, packed.box, packed.link
    found, node = -1, 0
    # Of a zero the sign must not matter: a ray on the very face of a box is in it.
    ix = 1.0 / dx if dx != 0.0 else math.inf
    iy = 1.0 / dy if dy != 0.0 else math.inf
    iz = 1.0 / dz if dz != 0.0 else math.inf
    while node < len(link):
        near, far = 0.0, best
        for axis, o, i in ((0, ox, ix), (1, oy, iy), (2, oz, iz)):
            # Along a slab i is infinite, and 0 * inf is not a number: comparisons then leave it out.
            a, b = (box[node, axis] - o) * i, (box[node, axis + 3] - o) * i
            if a > b:
                a, b = b, a
            if a > near:  # noqa: PLR1730 - max() would take over what is not a number
                near = a
            if b < far:  # noqa: PLR1730
                far = b
        if near > far:
            node = link[node, 2]
            continue
        node += 1
        for n in range(link[node - 1, 0], link[node - 1, 0] + link[node - 1, 1]):
            ax, ay, az = triangle[n, 1, 0], triangle[n, 1, 1], triangle[n, 1, 2]
            bx, by, bz = triangle[n, 2, 0], triangle[n, 2, 1], triangle[n, 2, 2]
            px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
            scale = ax * px + ay * py + az * pz
            if scale == 0.0:
                continue
            tx, ty, tz = ox - triangle[n, 0, 0], oy - triangle[n, 0, 1], oz - triangle[n, 0, 2]
            u = (tx * px + ty * py + tz * pz) / scale
            if u < -_EDGE or u > 1.0 + _EDGE:
                continue
            qx, qy, qz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
            v = (dx * qx + dy * qy + dz * qz) / scale
            if v < -_EDGE or u + v > 1.0 + _EDGE:
                continue
            t = (bx * qx + by * qy + bz * qz) / scale
            if 0.0 < t < best:
                best, found = t, n
    return best, found


@compiled
def first_hit(
    packed: Packed, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int, int]:
    """(distance, index of shape or of triangle after all shapes, face); (inf, -1, 0) for none."""
    best, what, face = math.inf, -1, 0
    q = packed.number
    for s in range(len(packed.kind)):
        x, y, z = ox - q[s, 9], oy - q[s, 10], oz - q[s, 11]
        t, side = _meet(
            packed.kind[s],
            q,
            s,
            q[s, 0] * x + q[s, 1] * y + q[s, 2] * z,
            q[s, 3] * x + q[s, 4] * y + q[s, 5] * z,
            q[s, 6] * x + q[s, 7] * y + q[s, 8] * z,
            q[s, 0] * dx + q[s, 1] * dy + q[s, 2] * dz,
            q[s, 3] * dx + q[s, 4] * dy + q[s, 5] * dz,
            q[s, 6] * dx + q[s, 7] * dy + q[s, 8] * dz,
        )
        if t < best:
            best, what, face = t, s, side
    if len(packed.triangle):
        t, n = _triangles(packed, ox, oy, oz, dx, dy, dz, best)
        if n >= 0:
            best, what, face = t, len(packed.kind) + n, 0
    return best, what, face


@compiled
def normal_at(
    packed: Packed, what: int, face: int, px: float, py: float, pz: float
) -> tuple[float, float, float]:
    """The unit normal of what was hit at a point, not yet turned towards anybody."""
    shapes = len(packed.kind)
    if what >= shapes:
        e, n = packed.triangle, what - shapes
        x = e[n, 1, 1] * e[n, 2, 2] - e[n, 1, 2] * e[n, 2, 1]
        y = e[n, 1, 2] * e[n, 2, 0] - e[n, 1, 0] * e[n, 2, 2]
        z = e[n, 1, 0] * e[n, 2, 1] - e[n, 1, 1] * e[n, 2, 0]
        length = math.sqrt(x * x + y * y + z * z)
        return x / length, y / length, z / length
    q, kind = packed.number, packed.kind[what]
    if kind == SPHERE or (kind == CYLINDER and face == 0):
        x, y, z = px - q[what, 9], py - q[what, 10], pz - q[what, 11]
        along = 0.0 if kind == SPHERE else q[what, 6] * x + q[what, 7] * y + q[what, 8] * z
        radius = q[what, 12]
        return (
            (x - along * q[what, 6]) / radius,
            (y - along * q[what, 7]) / radius,
            (z - along * q[what, 8]) / radius,
        )
    axis = 2 if kind in {PLANE, CYLINDER} else face // 2
    return q[what, 3 * axis], q[what, 3 * axis + 1], q[what, 3 * axis + 2]


@compiled
def cast_all(packed: Packed, origin: Floats, direction: Floats) -> tuple[Floats, Ints, Ints, Floats]:
    """Distance, shape index (of the document), face and facing normal of rays (N, 3)."""
    count = len(direction)
    distance, name = np.empty(count), np.empty(count, np.int64)
    side, normal = np.empty(count, np.int64), np.zeros((count, 3))
    for i in range(count):
        ox, oy, oz = origin[i, 0], origin[i, 1], origin[i, 2]
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        t, what, face = first_hit(packed, ox, oy, oz, dx, dy, dz)
        distance[i], side[i], name[i] = t, face, -1
        if what < 0:
            continue
        shapes = len(packed.kind)
        name[i] = packed.name[what] if what < shapes else packed.owner[what - shapes]
        x, y, z = normal_at(packed, what, face, ox + t * dx, oy + t * dy, oz + t * dz)
        turn = -1.0 if x * dx + y * dy + z * dz > 0 else 1.0
        normal[i, 0], normal[i, 1], normal[i, 2] = turn * x, turn * y, turn * z
    return distance, name, side, normal
