"""What stands in the simulated room: shapes with their own ray intersections, in scene space (mm)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Shape(Protocol):
    """Something that light falls on."""

    @property
    def albedo(self) -> float:
        """Share of the light that is scattered back, 0 to 1."""

    def hit(self, origin: Floats, direction: Floats) -> tuple[Floats, Ints]:
        """Distance (N,) along unit rays (N, 3) to the first hit, inf for none, and the face hit."""

    def normal(self, points: Floats, face: Ints) -> Floats:
        """Unit normals (N, 3) at points on the surface."""


def _slabs(
    origin: Floats, direction: Floats, low: Floats, high: Floats
) -> tuple[Floats, Floats, Ints, Ints]:
    """Entry and exit distance of an axis-aligned box, and the axes on which they happen."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    # A ray along a slab is in it all the way or never; on its very face 0 / 0 would say neither.
    along, inside = direction == 0, (origin >= low) & (origin <= high)
    near = np.where(along, np.where(inside, -np.inf, np.inf), np.minimum(a, b))
    far = np.where(along, np.where(inside, np.inf, -np.inf), np.maximum(a, b))
    return near.max(axis=1), far.min(axis=1), near.argmax(axis=1), far.argmin(axis=1)


def _axis_normal(direction_sign: Floats, axis: Ints) -> Floats:
    out = np.zeros((len(axis), 3))
    out[np.arange(len(axis)), axis] = direction_sign
    return out


@dataclass(frozen=True)
class Walls:
    """The inside of an axis-aligned box: four walls, floor and ceiling. Faces 0-5: axis * 2 + side."""

    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]
    albedo: float = 0.8

    def hit(self, origin: Floats, direction: Floats) -> tuple[Floats, Ints]:
        """See :class:`Shape`; rays start inside."""
        _, exit_at, _, axis = _slabs(origin, direction, np.array(self.low_mm), np.array(self.high_mm))
        side = (direction[np.arange(len(axis)), axis] > 0).astype(np.int64)
        return exit_at, axis * 2 + side

    def normal(self, points: Floats, face: Ints) -> Floats:
        """See :class:`Shape`; towards the inside."""
        return _axis_normal(np.where(face % 2 == 1, -1.0, 1.0), face // 2)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box seen from outside. Faces 0-5: axis * 2 + side."""

    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]
    albedo: float = 0.7

    def hit(self, origin: Floats, direction: Floats) -> tuple[Floats, Ints]:
        """See :class:`Shape`."""
        enter, leave, axis, _ = _slabs(origin, direction, np.array(self.low_mm), np.array(self.high_mm))
        side = (direction[np.arange(len(axis)), axis] < 0).astype(np.int64)
        return np.where((enter > 0) & (enter <= leave), enter, np.inf), axis * 2 + side

    def normal(self, points: Floats, face: Ints) -> Floats:
        """See :class:`Shape`."""
        return _axis_normal(np.where(face % 2 == 1, 1.0, -1.0), face // 2)


def _smaller_root(a: Floats, b: Floats, c: Floats) -> Floats:
    """The smaller root of a t^2 + 2 b t + c, inf where there is none ahead."""
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-b - np.sqrt(b * b - a * c)) / a
    return np.where(np.isfinite(t) & (t > 0), t, np.inf)


@dataclass(frozen=True)
class Sphere:
    """A ball seen from outside."""

    centre_mm: tuple[float, float, float]
    radius_mm: float
    albedo: float = 0.9

    def hit(self, origin: Floats, direction: Floats) -> tuple[Floats, Ints]:
        """See :class:`Shape`."""
        to = origin - np.array(self.centre_mm)
        b = (to * direction).sum(axis=1)
        t = _smaller_root(np.ones(len(b)), b, (to * to).sum(axis=1) - self.radius_mm**2)
        return t, np.zeros(len(t), np.int64)

    def normal(self, points: Floats, face: Ints) -> Floats:
        """See :class:`Shape`."""
        return (points - np.array(self.centre_mm)) / self.radius_mm


@dataclass(frozen=True)
class Pillar:
    """A vertical cylinder that reaches through floor and ceiling, seen from outside."""

    x_mm: float
    y_mm: float
    radius_mm: float
    albedo: float = 0.6

    def hit(self, origin: Floats, direction: Floats) -> tuple[Floats, Ints]:
        """See :class:`Shape`."""
        to = origin[:, :2] - np.array([self.x_mm, self.y_mm])
        flat = direction[:, :2]
        b = (to * flat).sum(axis=1)
        t = _smaller_root((flat * flat).sum(axis=1), b, (to * to).sum(axis=1) - self.radius_mm**2)
        return t, np.zeros(len(t), np.int64)

    def normal(self, points: Floats, face: Ints) -> Floats:
        """See :class:`Shape`."""
        out = (points - np.array([self.x_mm, self.y_mm, 0.0])) / self.radius_mm
        out[:, 2] = 0.0
        return out


@dataclass(frozen=True)
class Hits:
    """Where rays end: distance, point, surface (shape * 8 + face), brightness factor."""

    distance_mm: Floats
    points_mm: Floats
    surface: Ints


@dataclass(frozen=True)
class Scene:
    """Shapes in scene space."""

    shapes: Sequence[Shape]

    def cast(self, origin_mm: Floats, direction: Floats) -> Hits:
        """The first surface that each unit ray (N, 3) from ``origin_mm`` (3,) or (N, 3) meets."""
        start = np.broadcast_to(origin_mm, direction.shape)
        best = np.full(len(direction), np.inf)
        surface = np.full(len(direction), -1, np.int64)
        for i, shape in enumerate(self.shapes):
            t, face = shape.hit(start, direction)
            nearer = t < best
            best = np.where(nearer, t, best)
            surface = np.where(nearer, i * 8 + face, surface)
        with np.errstate(invalid="ignore"):
            points = start + best[:, None] * direction
        return Hits(best, points, surface)

    def reflectance(self, points_mm: Floats, surface: Ints, towards: Floats) -> Floats:
        """Albedo times the cosine between the normals and the unit directions ``towards`` (N, 3)."""
        out = np.zeros(len(points_mm))
        for i, shape in enumerate(self.shapes):
            mine = surface // 8 == i
            if mine.any():
                normal = shape.normal(points_mm[mine], surface[mine] % 8)
                out[mine] = shape.albedo * np.abs((normal * towards[mine]).sum(axis=1))
        return out
