"""Rays meet shapes where the shapes' own equations say, wherever they stand and are turned."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.scene import Scene, turned
from turnscan.schemas.errors import InputError
from turnscan.schemas.scene import Box, Cylinder, Mesh, Plane, Room, Shape, Sphere

from .rigs import ROOM, ball, box, pillar

TURN = (20.0, -35.0, 50.0)
SHAPES: list[Shape] = [
    ROOM,
    Room(kind="room", at_mm=(100, 50, 20), size_mm=(4000, 3500, 3000), turn_deg=TURN),
    box((500.0, -300.0, -400.0), (900.0, 300.0, 200.0)),
    Box(kind="box", at_mm=(700, 50, -60), size_mm=(400, 600, 500), turn_deg=TURN),
    ball((600.0, 100.0, 50.0), 250.0),
    pillar(700.0, -100.0, 150.0),
    Cylinder(kind="cylinder", at_mm=(600, 0, 80), radius_mm=150, height_mm=500, turn_deg=TURN),
    Plane(kind="plane", at_mm=(400, -100, 0), turn_deg=(20.0, 70.0, 5.0)),
    Plane(kind="plane", at_mm=(400, -100, 0), turn_deg=(20.0, 70.0, 5.0), size_mm=(600, 300)),
]


def rotation(turn_deg: tuple[float, ...]) -> np.ndarray:
    """scene_from_shape, written down apart: x first, then y, then z."""
    a, b, c = np.radians(turn_deg)
    x = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    y = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    z = np.array([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
    return z @ y @ x


def outside_by_mm(shape: Shape, points: np.ndarray) -> np.ndarray:
    """How far points are outside of the surface, written down apart from the intersections."""
    local = (points - np.array(shape.at_mm)) @ rotation(shape.turn_deg)
    if isinstance(shape, Room | Box):
        return (np.abs(local) - np.array(shape.size_mm) / 2).max(axis=1)
    if isinstance(shape, Sphere):
        return np.linalg.norm(local, axis=1) - shape.radius_mm
    if isinstance(shape, Cylinder):
        mantle = np.hypot(local[:, 0], local[:, 1]) - shape.radius_mm
        lids = np.abs(local[:, 2]) - (shape.height_mm or math.inf) / 2
        return np.maximum(mantle, lids)
    assert isinstance(shape, Plane)
    return np.abs(local[:, 2])


def directions(count: int, seed: int = 1) -> np.ndarray:
    out = np.random.default_rng(seed).normal(size=(count, 3))
    return out / np.linalg.norm(out, axis=1)[:, None]


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.sampled_from([0.0, 90.0, -180.0, 270.0]) | st.floats(-360, 360)] * 3))
def test_turns_go_about_x_then_y_then_z(turn: tuple[float, float, float]) -> None:
    assert turned(turn) == pytest.approx(rotation(turn), abs=1e-12)


def test_quarter_turns_are_exact() -> None:
    assert set(np.abs(turned((90.0, -270.0, 180.0))).ravel().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)
def test_rays_end_on_the_surface_and_meet_nothing_before(shape: Shape) -> None:
    direction, origin = directions(4000), np.array([10.0, 20.0, -30.0])
    hits = Scene([shape]).cast(origin, direction)
    met = hits.shape == 0
    assert np.array_equal(met, np.isfinite(hits.distance_mm))
    assert met.all() if isinstance(shape, Room) else 20 < met.sum() < 2500
    points = hits.points_mm[met]
    assert np.abs(outside_by_mm(shape, points)).max() < 1e-9
    normal = hits.normal[met]
    assert np.allclose(np.linalg.norm(normal, axis=1), 1.0)
    assert ((normal * direction[met]).sum(axis=1) < 0).all(), "normals look against the ray"
    # The normal is the gradient of the distance from the surface.
    gradient = np.stack(
        [
            outside_by_mm(shape, points + 1e-4 * e) - outside_by_mm(shape, points - 1e-4 * e)
            for e in np.eye(3)
        ],
        axis=1,
    )
    if not isinstance(shape, Plane):
        assert np.abs(np.abs((gradient / 2e-4 * normal).sum(axis=1)) - 1).max() < 1e-3
    if isinstance(shape, Plane) and shape.size_mm:
        local = (points - np.array(shape.at_mm)) @ rotation(shape.turn_deg)
        assert (np.abs(local[:, :2]) <= np.array(shape.size_mm) / 2 + 1e-9).all()
        whole = Scene([shape.model_copy(update={"size_mm": None})]).cast(origin, direction[~met])
        ahead = np.isfinite(whole.distance_mm)
        beyond = (whole.points_mm[ahead] - np.array(shape.at_mm)) @ rotation(shape.turn_deg)
        assert (np.abs(beyond[:, :2]) > np.array(shape.size_mm) / 2).any(axis=1).all()
        return
    # March along all rays: outside of the shape (inside of a room) up to the hit, or all the way.
    reach = np.where(met, hits.distance_mm, 5000.0)
    for part in np.linspace(0.0, 0.999, 300):
        gap = outside_by_mm(shape, origin + (part * reach)[:, None] * direction)
        assert (gap < 1e-9 if isinstance(shape, Room) else gap > -1e-9).all()


AXES = np.concatenate([np.eye(3), -np.eye(3)])


def test_rays_along_the_axes() -> None:
    """A direction of zero divides by zero in the slabs; -0.0 does it with the other sign."""
    block = Scene([box((1.0, -1.0, -1.0), (3.0, 1.0, 1.0))])
    walls = Scene([box((-5.0, -6.0, -7.0), (8.0, 9.0, 10.0), Room)])
    for direction in (AXES, np.where(AXES == 0, -0.0, AXES)):
        hits = block.cast(np.zeros(3), direction)
        assert hits.distance_mm.tolist() == [1.0] + [math.inf] * 5
        assert hits.face[0] == 0
        hits = walls.cast(np.zeros(3), direction)
        assert hits.distance_mm == pytest.approx([8.0, 9.0, 10.0, 5.0, 6.0, 7.0])
        assert hits.face.tolist() == [1, 3, 5, 0, 2, 4]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_rays_on_the_very_face_of_a_slab(axis: int, side: float) -> None:
    """Along a face, 0 / 0: the ray grazes the box, and in a room it reaches the wall ahead."""
    low, high = (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)
    block, walls = Scene([box(low, high)]), Scene([box(low, high, Room)])
    for along in {0, 1, 2} - {axis}:
        for sign in (1.0, -1.0):
            origin, direction = np.zeros((1, 3)), np.zeros((1, 3))
            origin[0, axis], direction[0, along] = side * 2.0, sign
            hits = walls.cast(origin, direction)
            assert (hits.distance_mm[0], hits.face[0]) == (2.0, along * 2 + (sign > 0))
            origin[0, along] = -5.0 * sign
            hits = block.cast(origin, direction)
            assert (hits.distance_mm[0], hits.face[0]) == (3.0, along * 2 + (sign < 0))
            origin[0, axis] = side * 2.001
            assert block.cast(origin, direction).distance_mm[0] == math.inf


def test_a_vertical_ray_and_cylinders() -> None:
    up = np.array([[0.0, 0.0, 1.0]])
    for x in (0.0, 100.0):
        hits = Scene([pillar(100.0, 0.0, 20.0)]).cast(np.array([[x, 50.0, 0.0]]), up)
        assert hits.distance_mm[0] == math.inf
    rod = Cylinder(kind="cylinder", at_mm=(0, 0, 10), radius_mm=3, height_mm=4)
    for x, expected in ((2.9, 8.0), (3.1, math.inf)):
        hits = Scene([rod]).cast(np.array([[x, 0.0, 0.0]]), up)
        assert hits.distance_mm[0] == expected
    assert Scene([rod]).cast(np.zeros(3), up).normal.tolist() == [[0, 0, -1]]
    assert Scene([rod]).cast(np.array([0, 0, 30.0]), -up).normal.tolist() == [[0, 0, 1]]


def test_what_lies_behind_is_not_hit() -> None:
    direction = np.array([[-1.0, 0.0, 0.0]])
    behind = [
        box((1.0, -1.0, -1.0), (3.0, 1.0, 1.0)),
        ball((5.0, 0, 0), 1.0),
        pillar(5.0, 0, 1.0),
        Plane(kind="plane", at_mm=(2, 0, 0), turn_deg=(0, 90, 0)),
    ]
    hits = Scene(behind).cast(np.zeros(3), direction)
    assert hits.distance_mm[0] == math.inf
    assert hits.shape.tolist() == [-1]
    assert Scene(behind).cast(np.zeros(3), -direction).shape.tolist() == [0]


# -- meshes ---------------------------------------------------------------------------------------


def soup(count: int, seed: int) -> tuple[Mesh, np.ndarray]:
    """A mesh of random triangles about the origin, and its corners."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 1, 3)) * 80 + rng.normal(size=(count, 3, 3)) * 15
    vertices = tuple(tuple(v) for v in corners.reshape(-1, 3).tolist())
    triangles = tuple((3 * n, 3 * n + 1, 3 * n + 2) for n in range(count))
    return Mesh(kind="mesh", vertices_mm=vertices, triangles=triangles), corners


@pytest.mark.parametrize("count", [1, 4, 5, 300, 1500])
def test_a_mesh_is_hit_where_its_triangles_are(count: int) -> None:
    """The tree of boxes against every triangle tried: its plane first, then the side of each edge."""
    mesh, corners = soup(count, seed=count)
    origin = np.array([400.0, 50.0, -20.0])
    target = np.random.default_rng(7).normal(size=(400, 3)) * 60
    direction = (target - origin) / np.linalg.norm(target - origin, axis=1)[:, None]
    expected = np.full(len(direction), math.inf)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for i, d in enumerate(direction):
        t = ((corners[:, 0] - origin) * normal).sum(axis=1) / (normal @ d)
        point = origin + t[:, None] * d
        good = t > 0
        for k in range(3):
            side = corners[:, (k + 1) % 3] - corners[:, k]
            good &= (np.cross(side, point - corners[:, k]) * normal).sum(axis=1) >= 0
        expected[i] = t[good].min(initial=math.inf)
    hits = Scene([mesh]).cast(origin, direction)
    assert np.array_equal(np.isfinite(hits.distance_mm), np.isfinite(expected))
    met = np.isfinite(expected)
    assert hits.distance_mm[met] == pytest.approx(expected[met], rel=1e-9)
    assert set(hits.shape[met].tolist()) <= {0}


def ball_mesh(radius: float, across: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a ball made of ``across`` rings, without gaps."""
    polar = np.linspace(0, math.pi, across + 1)
    around = np.arange(2 * across) * math.pi / across
    grid = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(around),
            np.sin(polar)[:, None] * np.sin(around),
            np.broadcast_to(np.cos(polar)[:, None], (across + 1, 2 * across)),
        ],
        axis=-1,
    )
    n = np.arange((across + 1) * 2 * across).reshape(across + 1, 2 * across)
    a, b, c, d = n[:-1], np.roll(n, -1, 1)[:-1], n[1:], np.roll(n, -1, 1)[1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    return radius * grid.reshape(-1, 3), triangles


def test_a_mesh_without_gaps_lets_no_ray_through() -> None:
    """Rays aimed at vertices and at middles of edges, from outside and from inside."""
    vertices, triangles = ball_mesh(100.0, 12)
    mesh = Mesh(
        kind="mesh",
        vertices_mm=tuple(tuple(v) for v in vertices.tolist()),
        triangles=tuple(tuple(t) for t in triangles.tolist()),
    )
    scene = Scene([mesh])
    edges = (vertices[triangles[:, 0]] + vertices[triangles[:, 1]]) / 2
    aims = np.concatenate([vertices, edges])
    for origin in (np.array([3.0, 2.0, 1.0]), np.array([150.0, 80.0, 60.0])):
        direction = aims - origin
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        hits = scene.cast(origin, direction)
        assert np.isfinite(hits.distance_mm).all()


def test_meshes_stand_where_they_are_put(tmp_path: Path) -> None:
    """One corner of a cube, through a file in metres, turned and moved."""
    (tmp_path / "cube.obj").write_text(
        "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nf 1 2 3 4\n",
    )
    shape = Mesh(
        kind="mesh", file="cube.obj", mm_per_unit=1000.0, at_mm=(10, 20, 30), turn_deg=(0, 0, 90)
    )
    scene = Scene([ball((0, 0, -500), 10), shape], folder=tmp_path)
    down = np.array([[0.0, 0.0, -1.0]])
    # The square from (0, 0) to (100, 100) lies from (-90, 20) to (10, 120) now.
    for x, y, hit in ((-85, 25, True), (5, 115, True), (15, 50, False), (-50, 15, False)):
        hits = scene.cast(np.array([x, y, 100.0]), down)
        assert (hits.distance_mm[0] == 70.0) == hit, (x, y)
        assert hits.shape[0] == (1 if hit else -1)


def test_a_mesh_without_area_is_refused() -> None:
    flat = Mesh(
        kind="mesh", vertices_mm=((0, 0, 0), (1, 1, 1), (2, 2, 2)), triangles=((0, 1, 2), (0, 0, 1))
    )
    with pytest.raises(InputError, match="no triangle of it has an area"):
        Scene([flat])
