"""The simulated room: its truth is exact, its shadows are real, and processing finds it again."""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.demo import demo_calibration, demo_scene, write_demo_frames
from turnscan.ingest.room.render import Light, Rendered, Truth, _crossings, render
from turnscan.ingest.room.rig import SimulatedRig, forward_project
from turnscan.ingest.room.scene import Box, Pillar, Scene, Sphere, Walls
from turnscan.ingest.room.truth import range_errors_mm
from turnscan.process.extract import extract_stripe
from turnscan.process.stages import PointChain
from turnscan.schemas.calibration import (
    Calibration,
    Intrinsics,
    LaserPlane,
    PaperCalibration,
    TurntableAxis,
    parse_calibration,
)
from turnscan.schemas.errors import CalibrationError, StorageError
from turnscan.schemas.recipe import BUILT_IN

LENS = (-0.21, 0.16, 0.0008, -0.0004, 0.01)
ROOM = Walls((-3000.0, -2000.0, -1200.0), (4000.0, 2500.0, 1400.0))
DARK = Light(ambient_dn=0.0, noise_dn=0.0, shot_dn_per_dn=0.0)


def rig(*, distortion: tuple[float, ...] = (0.0,) * 5, skew: float = 0.0) -> SimulatedRig:
    """Camera at the scene's origin, looking along +y at angle 0; laser 300 mm to its right."""
    paper = PaperCalibration(
        rig="sim",
        width_px=640,
        height_px=480,
        f_px=760.0,
        cx_px=318.5,
        cy_px=241.25,
        skew=skew,
        distortion=distortion,
        L_mm=300.0,
        D_mm=300.0,
        theta_rad=1.2,
        c_mm=0.0,
    )
    return SimulatedRig(paper.calibration())


def wall(y_mm: float = 2000.0) -> Scene:
    """One wall across the camera's view; the others are far behind everything."""
    return Scene([Walls((-1e5, -1e5, -1e5), (1e5, y_mm, 1e5))])


def truth_of(scene: Scene, a: SimulatedRig, angle: float = 0.0) -> Truth:
    return render(scene, a, angle, seed=0, light=DARK).truth


# -- the camera -----------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.003, 0.003)] * 2, st.floats(-0.1, 0.1)))
def test_projection_is_opencvs(distortion: tuple[float, ...]) -> None:
    camera = rig(distortion=distortion).camera
    points = np.random.default_rng(0).uniform((-400, -300, 800), (400, 300, 3000), (50, 3))
    matrix = np.array(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]], float
    )
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    u, v = forward_project(points, camera)
    assert np.allclose(np.stack([u, v], axis=1), expected[:, 0], atol=1e-9)


def test_skew_leans_by_rows() -> None:
    """In closed form: skew adds fx skew yd to u, and nothing to v."""
    points = np.array([[100.0, 200.0, 1000.0], [-50.0, -300.0, 1500.0]])
    plain = forward_project(points, rig().camera)
    leaning = forward_project(points, rig(skew=0.01).camera)
    assert leaning[0] - plain[0] == pytest.approx([760 * 0.01 * 0.2, 760 * 0.01 * -0.2])
    assert np.array_equal(leaning[1], plain[1])


# -- rays and shapes ------------------------------------------------------------------------------

SHAPES = [
    ROOM,
    Box((500.0, -300.0, -400.0), (900.0, 300.0, 200.0)),
    Sphere((600.0, 100.0, 50.0), 250.0),
    Pillar(700.0, -100.0, 150.0),
]


def outside_by_mm(shape: object, points: np.ndarray) -> np.ndarray:
    """How far points are from the surface, written down apart from the intersections."""
    if isinstance(shape, Walls | Box):
        low, high = np.array(shape.low_mm), np.array(shape.high_mm)
        return np.max(np.maximum(low - points, points - high), axis=1)
    if isinstance(shape, Sphere):
        return np.linalg.norm(points - np.array(shape.centre_mm), axis=1) - shape.radius_mm
    assert isinstance(shape, Pillar)
    return np.hypot(points[:, 0] - shape.x_mm, points[:, 1] - shape.y_mm) - shape.radius_mm


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_rays_end_on_the_surface_and_meet_nothing_before(shape: Box) -> None:
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    origin = np.array([10.0, 20.0, -30.0])
    t, face = shape.hit(np.broadcast_to(origin, direction.shape), direction)
    met = np.isfinite(t)
    assert met.all() if isinstance(shape, Walls) else 20 < met.sum() < 2000
    points = origin + t[met, None] * direction[met]
    assert np.abs(outside_by_mm(shape, points)).max() < 1e-9
    normal = shape.normal(points, face[met])
    assert np.allclose(np.linalg.norm(normal, axis=1), 1.0)
    assert ((normal * direction[met]).sum(axis=1) < 0).all(), "normals look against the ray"
    # March along all rays: outside of the shape (inside of the room) up to the hit, or all the way.
    reach = np.where(met, t, 5000.0)
    for part in np.linspace(0.0, 0.999, 400):
        gap = outside_by_mm(shape, origin + (part * reach)[:, None] * direction)
        assert (gap < 1e-9 if isinstance(shape, Walls) else gap > -1e-9).all()


AXES = np.concatenate([np.eye(3), -np.eye(3)])


def test_rays_along_the_axes() -> None:
    """A direction of zero divides by zero in the slabs; -0.0 does it with the other sign."""
    box = Box((1.0, -1.0, -1.0), (3.0, 1.0, 1.0))
    walls = Walls((-5.0, -6.0, -7.0), (8.0, 9.0, 10.0))
    for direction in (AXES, np.where(AXES == 0, -0.0, AXES)):
        t, face = box.hit(np.zeros((6, 3)), direction)
        assert t.tolist() == [2.0 - 1.0] + [math.inf] * 5
        assert face[0] == 0
        t, face = walls.hit(np.zeros((6, 3)), direction)
        assert t.tolist() == [8.0, 9.0, 10.0, 5.0, 6.0, 7.0]
        assert face.tolist() == [1, 3, 5, 0, 2, 4]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_rays_on_the_very_face_of_a_slab(axis: int, side: float) -> None:
    """Along a face, 0 / 0: the ray grazes the box, and in a room it reaches the wall ahead."""
    low, high = (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)
    for along in {0, 1, 2} - {axis}:
        for sign in (1.0, -1.0):
            origin, direction = np.zeros((1, 3)), np.zeros((1, 3))
            origin[0, axis], direction[0, along] = side * 2.0, sign
            t, face = Walls(low, high).hit(origin, direction)
            assert (t[0], face[0]) == (2.0, along * 2 + (sign > 0))
            origin[0, along] = -5.0 * sign
            t, face = Box(low, high).hit(origin, direction)
            assert (t[0], face[0]) == (3.0, along * 2 + (sign < 0))
            origin[0, axis] = side * 2.001
            assert Box(low, high).hit(origin, direction)[0][0] == math.inf


def test_a_vertical_ray_misses_a_vertical_pillar() -> None:
    for x in (0.0, 100.0):
        t, _ = Pillar(100.0, 0.0, 20.0).hit(np.array([[x, 50.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]))
        assert t[0] == math.inf


def test_what_lies_behind_is_not_hit() -> None:
    direction = np.array([[-1.0, 0.0, 0.0]])
    for shape in (
        Box((1.0, -1.0, -1.0), (3.0, 1.0, 1.0)),
        Sphere((5.0, 0, 0), 1.0),
        Pillar(5.0, 0, 1.0),
    ):
        assert shape.hit(np.zeros((1, 3)), direction)[0][0] == math.inf
    assert Scene([]).cast(np.zeros(3), direction).surface.tolist() == [-1]


# -- truth ----------------------------------------------------------------------------------------


def test_a_plain_wall_in_closed_form() -> None:
    """Laser plane n.P = h and wall Z = 2000: X is one number, so the stripe is a straight column."""
    a = rig()
    truth = truth_of(wall(2000.0), a)
    n, h = a.plane.normal, a.plane.distance_mm
    x = (h - n[2] * 2000.0) / n[0]
    assert np.array_equal(truth.row, np.arange(480))
    assert truth.u_px == pytest.approx(np.full(480, 760.0 * x / 2000.0 + 318.5), abs=1e-9)
    z_up = -(np.arange(480) - 241.25) / 760.0 * 2000.0
    expected = np.stack([np.full(480, x), np.full(480, 2000.0), z_up], axis=1)
    assert np.abs(truth.points_mm - expected).max() < 1e-6
    assert truth.range_mm == pytest.approx(np.linalg.norm(expected, axis=1))
    # Lambert's cosine over the distance from the laser, which stands at (300, 0, 0).
    beam = expected - np.array([300.0, 0.0, 0.0])
    reach = np.linalg.norm(beam, axis=1)
    assert truth.amplitude_dn == pytest.approx(900.0 * 0.8 * (2000.0 / reach) * 1000.0 / reach)


def test_a_ball_in_closed_form() -> None:
    """Where the laser plane cuts a ball it draws a circle; the truth lies on both."""
    a = rig(distortion=LENS)
    centre, radius = np.array([0.0, 1200.0, 40.0]), 250.0
    truth = truth_of(Scene([Sphere(tuple(centre), radius)]), a)
    assert len(truth.row) > 150
    assert np.linalg.norm(truth.points_mm - centre, axis=1) == pytest.approx(radius, abs=1e-9)
    camera_space = a.pose(0.0).to_camera(truth.points_mm)
    assert camera_space @ np.array(a.plane.normal) == pytest.approx(a.plane.distance_mm, abs=1e-9)
    # Only the near side is lit and seen.
    towards = -truth.points_mm / truth.range_mm[:, None]
    assert ((truth.points_mm - centre) * towards).sum(axis=1).min() > 0


CAMERAS = [rig(), rig(distortion=LENS), rig(distortion=LENS, skew=0.003)]


@pytest.mark.parametrize("a", CAMERAS, ids=["ideal", "lens", "lens and skew"])
@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5])
def test_truth_stands_in_the_middle_of_its_rows(a: SimulatedRig, angle: float) -> None:
    scene = Scene([ROOM, Sphere((200.0, 1400.0, 0.0), 300.0), Box((-900, 800, -1200), (-300, 1300, 0))])
    truth = truth_of(scene, a, angle)
    assert truth.row.dtype == np.int64
    assert len(truth.row) > 200
    u, v = forward_project(a.pose(angle).to_camera(truth.points_mm), a.camera)
    assert np.abs(v - truth.row).max() < 1e-9
    assert np.abs(u - truth.u_px).max() < 1e-9
    # No point stands twice.
    same_row = np.diff(truth.row) == 0
    assert (np.diff(truth.u_px)[same_row] > 1e-3).all()


def test_a_ray_in_the_very_middle_of_a_row_counts_once() -> None:
    v = np.array([0.0, 1.0, 2.5, 1.0, 0.5, 7.0, 8.0])
    surface = np.array([0, 0, 0, 0, 0, 8, 8])
    left, right, row = _crossings(surface, v, 8)
    # Up and down again, not across the edge between two surfaces, and not below the picture.
    assert row.tolist() == [1, 2, 2, 1]
    assert left.tolist() == [0, 1, 2, 3]
    assert right.tolist() == [1, 2, 3, 4]


def stripes_of(truth: Truth, angle: float) -> dict[str, np.ndarray]:
    n = len(truth.row)
    return {
        "frame": np.zeros(n, np.uint32),
        "laser": np.zeros(n, np.uint8),
        "row": truth.row,
        "angle_rad": np.full(n, angle),
        "u_px": truth.u_px,
        "sigma_u_px": np.full(n, 0.05),
        "amplitude_dn": truth.amplitude_dn,
        "width_px": np.full(n, 1.8),
        "flags": np.zeros(n, np.uint16),
    }


@pytest.mark.parametrize("a", CAMERAS, ids=["ideal", "lens", "lens and skew"])
@pytest.mark.parametrize("angle", [0.0, 0.8, -2.5])
def test_processing_gives_the_truth_back(a: SimulatedRig, angle: float) -> None:
    """Two implementations, written apart, agree to a nanometre."""
    truth = truth_of(Scene([ROOM, Sphere((200.0, 1400.0, 0.0), 300.0)]), a, angle)
    chain = PointChain(BUILT_IN["default"], a.calibration)
    found = chain.points(stripes_of(truth, angle))
    assert chain.dropped == 0
    points = np.stack([found["x_mm"], found["y_mm"], found["z_mm"]], axis=1)
    assert np.abs(points - truth.points_mm).max() < 1e-6
    assert np.abs(found["range_mm"] - truth.range_mm).max() < 1e-6


@pytest.mark.parametrize("head", ["rotates", "fixed"])
@pytest.mark.parametrize("turn", ["clockwise", "counterclockwise"])
def test_any_axis_gives_the_truth_back(head: str, turn: str) -> None:
    """A leaning turntable, seen from above, turning either way."""
    calibration = Calibration(
        rig="leaning",
        camera=Intrinsics(
            width_px=640, height_px=480, fx_px=900, fy_px=890, cx_px=320, cy_px=240, distortion=LENS
        ),
        lasers=(LaserPlane(laser=0, normal=(0.8, 0.06, 0.597), distance_mm=260.0),),
        turntable=TurntableAxis(
            point_mm=(5.0, 60.0, 430.0), direction=(0.02, -0.85, -0.5264), head=head, positive_turn=turn
        ),
    )
    a = SimulatedRig(calibration)
    scene = Scene([Box((-60.0, -50.0, -200.0), (70.0, 40.0, 90.0)), Sphere((0, 0, 120), 40.0)])
    for angle in (0.0, 0.9):
        truth = truth_of(scene, a, angle)
        assert len(truth.row) > 50
        found = PointChain(BUILT_IN["default"], calibration).points(stripes_of(truth, angle))
        points = np.stack([found["x_mm"], found["y_mm"], found["z_mm"]], axis=1)
        assert np.abs(points - truth.points_mm).max() < 1e-6


def test_a_turning_head_sees_one_room() -> None:
    """Points on the walls at all angles lie on the same walls, and the sweeps overlap."""
    a = rig(distortion=LENS)
    points = np.concatenate([truth_of(Scene([ROOM]), a, k * 0.3).points_mm for k in range(21)])
    assert np.abs(outside_by_mm(ROOM, points)).max() < 1e-9
    for axis in (0, 1):
        for limit in (ROOM.low_mm[axis], ROOM.high_mm[axis]):
            assert (np.abs(points[:, axis] - limit) < 1e-6).sum() > 400
    # A full turn comes back to the same frame.
    once, again = truth_of(Scene([ROOM]), a, 0.4), truth_of(Scene([ROOM]), a, 0.4 + 2 * math.pi)
    assert np.abs(once.points_mm - again.points_mm).max() < 1e-6


def test_one_wall_point_seen_at_two_angles_has_one_place() -> None:
    """The level line of the wall x = 4000, from two angles: where they overlap they are one line."""
    a = rig()
    scene = Scene([ROOM])
    seen = [truth_of(scene, a, angle) for angle in (1.3, 1.32)]
    for truth in seen:
        assert len(truth.row) > 300
    nearest = np.linalg.norm(seen[0].points_mm[:, None] - seen[1].points_mm[None], axis=2).min()
    assert nearest < 100.0
    for angle, truth in zip((1.3, 1.32), seen, strict=True):
        measured, true = range_errors_mm(scene, a, angle, truth.points_mm)
        assert np.abs(measured).max() < 1e-6
        assert true == pytest.approx(truth.range_mm)


# -- shadows --------------------------------------------------------------------------------------


def rows_at(truth: Truth, *, y_mm: float) -> set[int]:
    return set(truth.row[np.abs(truth.points_mm[:, 1] - y_mm) < 1e-6].tolist())


def test_a_box_before_the_laser_shadows_the_wall() -> None:
    """A box that only the laser sees: the wall's stripe has a gap of the height in closed form."""
    a = rig()
    emitter = np.array([300.0, 0.0, 0.0])
    lit = truth_of(wall(), a).points_mm[0]
    # Half way from the laser to the wall, on the beam, and outside of the camera's view.
    x, y = ((emitter + lit) / 2)[:2]
    box = Box((x - 20.0, y - 20.0, -100.0), (x + 20.0, y + 20.0, 100.0))
    truth = truth_of(Scene([*wall().shapes, box]), a)
    on_wall = rows_at(truth, y_mm=2000.0)
    gap = sorted(set(range(480)) - on_wall)
    assert gap == list(range(gap[0], gap[-1] + 1)), "one gap"
    # The beam passes over the edge that is nearer to the laser: level distances in the laser plane.
    reach = np.hypot(*(lit - emitter)[:2])
    along = (lit - emitter)[:2] / reach
    edge = min(
        t
        for t in ((x - 20 - 300) / along[0], (x + 20 - 300) / along[0], (y - 20) / along[1])
        if t > 0 and abs(300 + t * along[0] - x) <= 20 + 1e-9 and abs(t * along[1] - y) <= 20 + 1e-9
    )
    half_height = 100.0 * reach / edge * 760.0 / 2000.0
    # The row at the edge may be the one between two rays of the fan.
    assert gap[0] - math.ceil(241.25 - half_height) in (-1, 0)
    assert gap[-1] - math.floor(241.25 + half_height) in (0, 1)


def test_what_the_laser_sees_and_the_camera_does_not_is_not_in_the_picture() -> None:
    """A screen between camera and wall, clear of the laser: its rows are dark, not misplaced."""
    a = rig()
    free = truth_of(wall(), a)
    lit = free.points_mm[0]
    x = lit[0] / 2
    screen = Box((x - 30.0, 990.0, -50.0), (x + 30.0, 1000.0, 80.0))
    rendered = render(Scene([*wall().shapes, screen]), a, 0.0, seed=0, light=DARK)
    gap = sorted(set(range(480)) - rows_at(rendered.truth, y_mm=2000.0))
    # The camera looks past the front edges at 990 mm.
    assert gap[0] == math.ceil(241.25 - 80.0 / 990.0 * 760.0)
    assert gap[-1] == math.floor(241.25 + 50.0 / 990.0 * 760.0)
    assert not set(gap) & set(rendered.truth.row.tolist()), "the screen itself is not lit"
    assert rendered.image[gap].max() == 0
    assert rendered.image[[gap[0] - 1, gap[-1] + 1]].max() > 0


def test_a_box_in_the_stripe_is_seen_before_the_wall() -> None:
    a = rig()
    lit = truth_of(wall(), a).points_mm[240]
    box = Box((lit[0] - 400.0, 1500.0, -100.0), (lit[0] + 400.0, 1600.0, 100.0))
    truth = truth_of(Scene([*wall().shapes, box]), a)
    front = rows_at(truth, y_mm=1500.0)
    half_height = 100.0 / 1500.0 * 760.0
    first, last = math.ceil(241.25 - half_height), math.floor(241.25 + half_height)
    assert front <= set(range(first, last + 1))
    assert len(front) >= last - first - 1
    assert not front & rows_at(truth, y_mm=2000.0)


# -- pictures -------------------------------------------------------------------------------------


def test_equal_arguments_give_equal_frames() -> None:
    a, scene = rig(distortion=LENS), Scene([ROOM])
    one, two = (render(scene, a, 0.3, seed=5, light=Light(impulses=0.01)) for _ in range(2))
    assert np.array_equal(one.image, two.image)
    assert np.array_equal(one.truth.u_px, two.truth.u_px)
    other = render(scene, a, 0.3, seed=6, light=Light(impulses=0.01))
    assert not np.array_equal(one.image, other.image)
    assert np.array_equal(one.truth.u_px, other.truth.u_px), "noise is no truth"


def dark_part(made: Rendered) -> np.ndarray:
    """Pixels far from any stripe."""
    far = np.ones(made.image.shape, bool)
    for row, u in zip(made.truth.row, made.truth.u_px, strict=True):
        far[row, max(0, int(u) - 20) : int(u) + 21] = False
    return made.image[far].astype(float)


def test_ambient_and_noise_are_what_they_say() -> None:
    light = Light(ambient_dn=40.0, noise_dn=3.0, shot_dn_per_dn=0.1)
    dark = dark_part(render(wall(), rig(), 0.0, seed=1, light=light))
    assert dark.mean() == pytest.approx(40.0, abs=0.05)
    # Read noise, shot noise, and rounding to whole values.
    assert dark.std() == pytest.approx(math.sqrt(9.0 + 4.0 + 1 / 12), rel=0.01)


def test_impulses_are_as_frequent_as_they_say() -> None:
    light = Light(ambient_dn=100.0, noise_dn=1.0, impulses=0.02)
    dark = dark_part(render(wall(), rig(), 0.0, seed=1, light=light))
    struck = (dark == 0) | (dark == 255)
    assert struck.mean() == pytest.approx(0.02, rel=0.1)
    assert (dark[struck] == 255).mean() == pytest.approx(0.5, abs=0.05)


def test_a_stripe_has_the_light_and_width_that_it_says() -> None:
    light = Light(ambient_dn=0, noise_dn=0, shot_dn_per_dn=0, width_px=2.5, stripe_dn_at_1m=400.0)
    made = render(wall(), rig(), 0.0, seed=0, light=light)
    image = made.image.astype(float)
    sums = image.sum(axis=1)
    assert sums == pytest.approx(made.truth.amplitude_dn * 2.5 * math.sqrt(2 * math.pi), rel=0.01)
    centre = (image * np.arange(640)).sum(axis=1) / sums
    assert np.abs(centre - made.truth.u_px).max() < 0.02
    variance = (image * (np.arange(640) - centre[:, None]) ** 2).sum(axis=1) / sums
    # A pixel collects over its own width: 1/12 on top.
    assert np.sqrt(variance - 1 / 12) == pytest.approx(2.5, rel=0.03)


@pytest.mark.parametrize("method", ["varied-boundary", "centroid"])
def test_extraction_finds_the_wall(method: str) -> None:
    a = rig(distortion=LENS)
    made = render(wall(), a, 0.0, seed=3, light=Light(stripe_dn_at_1m=450.0))
    found = extract_stripe(made.image, method)
    at = dict(zip(made.truth.row.tolist(), made.truth.u_px.tolist(), strict=True))
    error = np.array([p["u_px"] - at[int(p["row"])] for p in found])
    assert len(error) == 480
    rms = math.sqrt((error**2).mean())
    print(f"{method}: rms {rms:.4f} px over {len(error)} rows")
    assert rms < 0.05
    assert abs(error.mean()) < 0.01


def test_a_laser_above_the_camera_is_refused() -> None:
    plane = LaserPlane(laser=0, normal=(0.0, 0.6, 0.8), distance_mm=100.0)
    calibration = rig().calibration.model_copy(update={"lasers": (plane,)})
    with pytest.raises(CalibrationError, match="plane of laser 0 hardly meets the camera's X axis"):
        SimulatedRig(calibration).emitter_mm()


# -- the demo -------------------------------------------------------------------------------------


def test_demo_files(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    made = write_demo_frames(
        tmp_path / "demo", frames=3, step_deg=120.0, advance=lambda i, n: seen.append((i, n))
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]
    with made.angles.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["file"], float(r["angle_deg"])) for r in rows] == [
        ("frame0000.png", 0.0),
        ("frame0001.png", 120.0),
        ("frame0002.png", 240.0),
    ]
    read_back = parse_calibration(made.calibration.read_bytes(), where="demo")
    assert read_back.sha256() == demo_calibration().sha256()
    a = SimulatedRig(demo_calibration())
    for i, truth in enumerate(made.truth):
        again = render(demo_scene(), a, math.radians(120.0 * i), seed=1 + i)
        written = cv2.imread(str(made.frames / f"frame{i:04d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(written, again.image)
        assert np.array_equal(truth.u_px, again.truth.u_px)
        error, true = range_errors_mm(demo_scene(), a, math.radians(120.0 * i), truth.points_mm)
        assert np.abs(error).max() < 1e-6
        assert true.min() > 300.0


def test_demo_files_where_they_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(StorageError, match="cannot write the demo's frames to "):
        write_demo_frames(tmp_path / "taken", frames=1)


def test_rendering_is_a_small_multiple_of_its_noise() -> None:
    """Printed, not judged by the clock: the demo renders 180 frames."""
    a, scene = SimulatedRig(demo_calibration()), demo_scene()
    rng = np.random.default_rng(0)
    best = {"render": math.inf, "noise": math.inf}
    for k in range(5):
        begun = time.process_time()
        render(scene, a, 0.4 * k, seed=k)
        between = time.process_time()
        rng.standard_normal((480, 640))
        best["render"] = min(best["render"], between - begun)
        best["noise"] = min(best["noise"], time.process_time() - between)
    ratio = best["render"] / best["noise"]
    print(f"render a frame / draw its noise: {ratio:.1f}")
    assert ratio < 40
