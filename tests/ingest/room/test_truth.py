"""Truth is exact: closed forms for wall and ball, shadows to the row, and processing gives it back."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.render import Truth, render
from turnscan.ingest.room.rig import SimulatedRig, forward_project, lens, unproject_all
from turnscan.ingest.room.scene import Scene
from turnscan.ingest.room.truth import range_errors_mm
from turnscan.process.stages import PointChain
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.recipe import BUILT_IN
from turnscan.schemas.scene import Box, Cylinder, Emitter, Light, Mesh, Plane

from .rigs import DARK, LENS, QUIET, ROOM, ball, box, rig, truth_of, wall, with_planes
from .test_rays import ball_mesh, outside_by_mm

# -- the camera -----------------------------------------------------------------------------------

LENSES = st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.003, 0.003)] * 2, st.floats(-0.1, 0.1))


@settings(max_examples=50, deadline=None)
@given(LENSES)
def test_projection_is_opencvs(distortion: tuple[float, ...]) -> None:
    camera = rig().camera.model_copy(update={"distortion": distortion})
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


@settings(max_examples=50, deadline=None)
@given(LENSES, st.floats(-0.01, 0.01))
def test_unprojection_is_the_inverse(distortion: tuple[float, ...], skew: float) -> None:
    camera = rig().camera.model_copy(update={"distortion": distortion, "skew": skew})
    grid = np.stack(np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.2, 0.2, 9)), -1)
    rays = np.column_stack([grid.reshape(-1, 2), np.ones(81)])
    u, v = forward_project(rays, camera)
    back = unproject_all(lens(camera), np.stack([u, v], axis=1))
    assert np.abs(back - rays[:, :2]).max() < 1e-13


def test_a_lens_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(CalibrationError, match="folds the picture over inside the frame"):
        rig(distortion=(-3.0, 0.0, 0.0, 0.0, 0.0))


# -- closed forms ---------------------------------------------------------------------------------


def test_a_plain_wall_in_closed_form() -> None:
    """Laser plane n.P = h and wall Z = 2000: X is one number, so the stripe is a straight column."""
    a = rig()
    truth = truth_of(wall(2000.0), a)
    n, h = a.plane().normal, a.plane().distance_mm
    x = (h - n[2] * 2000.0) / n[0]
    assert np.array_equal(truth.row, np.arange(480))
    assert truth.u_px == pytest.approx(np.full(480, 760.0 * x / 2000.0 + 318.5), abs=1e-9)
    z_up = -(np.arange(480) - 241.25) / 760.0 * 2000.0
    expected = np.stack([np.full(480, x), np.full(480, 2000.0), z_up], axis=1)
    assert np.abs(truth.points_mm - expected).max() < 1e-6
    assert truth.range_mm == pytest.approx(np.linalg.norm(expected, axis=1))
    # Lambert's cosine over the distance from the laser, which stands at (300, 0, 0).
    reach = np.linalg.norm(expected - np.array([300.0, 0.0, 0.0]), axis=1)
    assert truth.amplitude_dn == pytest.approx(900.0 * 0.7 * (2000.0 / reach) * 1000.0 / reach)
    assert truth.width_px == pytest.approx(np.full(480, 1.8))


@pytest.mark.parametrize("mesh", [False, True], ids=["sphere", "mesh of 80000 triangles"])
def test_a_ball_in_closed_form(*, mesh: bool) -> None:
    """Where the laser plane cuts a ball it draws a circle; the truth lies on both."""
    a = rig(distortion=LENS)
    centre, radius = np.array([0.0, 1200.0, 40.0]), 250.0
    shape = ball(tuple(centre), radius)
    # The middle of a facet lies inside of the ball: r (1 - cos(half a facet)).
    off = 1e-9
    if mesh:
        vertices, triangles = ball_mesh(radius, 200)
        off = radius * 1.5 * (math.pi / 200) ** 2
        shape = Mesh(
            kind="mesh",
            at_mm=tuple(centre),
            vertices_mm=tuple(tuple(v) for v in vertices.tolist()),
            triangles=tuple(tuple(t) for t in triangles.tolist()),
        )
    truth = truth_of(Scene([shape]), a)
    assert len(truth.row) > 150
    distance = np.linalg.norm(truth.points_mm - centre, axis=1)
    assert np.abs(distance - radius).max() < off
    camera_space = a.pose(0.0).to_camera(truth.points_mm)
    plane = a.plane()
    assert camera_space @ np.array(plane.normal) == pytest.approx(plane.distance_mm, abs=1e-9)
    # Only the near side is lit and seen.
    towards = -truth.points_mm / truth.range_mm[:, None]
    assert ((truth.points_mm - centre) * towards).sum(axis=1).min() > -off
    # No row between the first and the last is left out: both ends are silhouettes.
    exact = truth_of(Scene([ball(tuple(centre), radius)]), a)
    assert np.array_equal(np.unique(truth.row), np.arange(truth.row.min(), truth.row.max() + 1))
    assert abs(truth.row.min() - exact.row.min()) <= 1
    assert abs(truth.row.max() - exact.row.max()) <= 1


def test_a_leaning_board_in_closed_form() -> None:
    """A finite plane, turned: its truth is the line where it meets the laser's plane, to its edges."""
    a = rig()
    board = Plane(kind="plane", at_mm=(0, 1500, 0), turn_deg=(60, 10, 0), size_mm=(900, 700))
    truth = truth_of(Scene([board]), a)
    from .test_rays import rotation

    turn = rotation(board.turn_deg)
    local = (truth.points_mm - np.array(board.at_mm)) @ turn
    assert np.abs(local[:, 2]).max() < 1e-9
    assert np.abs(local[:, 1]).max() == pytest.approx(350, abs=3)
    # n.P = h and m.P = d meet in a line; where it meets the edges y = +-350, rows begin and end.
    n = np.array(a.plane().normal) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    ends = []
    for y in (-350.0, 350.0):
        edge = np.array(board.at_mm) + turn @ np.array([0, y, 0.0])
        t = (a.plane().distance_mm - n @ edge) / (n @ turn[:, 0])
        _, v = forward_project(a.pose(0.0).to_camera((edge + t * turn[:, 0])[None]), a.camera)
        ends.append(float(v[0]))
    assert truth.row.min() == math.ceil(min(ends))
    assert truth.row.max() == math.floor(max(ends))


@pytest.mark.parametrize("f", [0.5, 1.0])
def test_two_sides_of_one_sheet(f: float) -> None:
    """A thin board between laser and camera is lit on its far side: nothing is seen of it."""
    a = rig()
    # From (300, 0) the laser goes to the left; this board stands along the view, lit from its right.
    board = Plane(kind="plane", at_mm=(100, 900, 0), turn_deg=(0, 90, 0), size_mm=(100, 1400))
    lit = truth_of(Scene([board]), a)
    assert len(lit.row) == 0
    # Beyond the middle of the view the camera sees the side that is lit.
    seen = board.model_copy(update={"at_mm": (-200.0 * f, 1200.0, 0.0)})
    assert len(truth_of(Scene([seen]), a).row) > 5


# -- any camera, any laser, any axis --------------------------------------------------------------

CAMERAS = [rig(), rig(distortion=LENS), rig(distortion=LENS, skew=0.003)]
THINGS = Scene(
    [
        ROOM,
        ball((200.0, 1400.0, 0.0), 300.0),
        box((-900, 800, -1200), (-300, 1300, 0)),
        Box(kind="box", at_mm=(400, 900, -300), size_mm=(300, 200, 250), turn_deg=(10, 20, 30)),
        Cylinder(
            kind="cylinder", at_mm=(-200, 700, 200), radius_mm=60, height_mm=300, turn_deg=(70, 0, 20)
        ),
    ]
)


@pytest.mark.parametrize("a", CAMERAS, ids=["ideal", "lens", "lens and skew"])
@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5])
def test_truth_stands_in_the_middle_of_its_rows(a: SimulatedRig, angle: float) -> None:
    truth = truth_of(THINGS, a, angle)
    assert truth.row.dtype == np.int64
    assert len(truth.row) > 80
    u, v = forward_project(a.pose(angle).to_camera(truth.points_mm), a.camera)
    assert np.abs(v - truth.row).max() < 1e-9
    assert np.abs(u - truth.u_px).max() < 1e-9
    for n, shape in enumerate(THINGS.shapes):
        mine = truth.surface == n
        if mine.any():
            assert np.abs(outside_by_mm(shape, truth.points_mm[mine])).max() < 1e-9
    # No point stands twice.
    same_row = np.diff(truth.row) == 0
    assert (np.diff(truth.u_px)[same_row] > 1e-3).all()


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.2])
def test_no_row_is_left_out(angle: float) -> None:
    """Against a search of its own: the sheet is walked in fine steps, every crossing seen is listed."""
    a = rig(distortion=LENS)
    truth = truth_of(THINGS, a, angle)
    fan, pose = a.fan(0), a.pose(angle)
    angles = np.linspace(fan.first_rad, fan.last_rad, 120_001)
    emitter = pose.to_scene(fan.emitter_mm[None])[0]
    hits = THINGS.cast(emitter, fan.directions(angles) @ pose.scene_from_camera.T)
    u, v = forward_project(pose.to_camera(hits.points_mm), a.camera)
    away = hits.points_mm - pose.camera_mm
    far = np.linalg.norm(away, axis=1)
    seen = THINGS.cast(pose.camera_mm, away / far[:, None]).distance_mm > far - 1e-5
    seen &= (u > -0.5) & (u < 639.5) & (v > -0.5) & (v < 479.5)
    both = (
        seen[1:] & seen[:-1] & (hits.shape[1:] == hits.shape[:-1]) & (hits.face[1:] == hits.face[:-1])
    )
    crossed = both & (np.floor(v[1:]) != np.floor(v[:-1])) & (np.abs(np.diff(v)) < 0.5)
    rows = np.maximum(np.floor(v[1:]), np.floor(v[:-1]))[crossed].astype(int)
    listed = {(r, round(x)) for r, x in zip(truth.row.tolist(), truth.u_px.tolist(), strict=True)}
    near = np.round(u[1:][crossed]).astype(int)
    for r, x in zip(rows.tolist(), near.tolist(), strict=True):
        assert {(r, x - 1), (r, x), (r, x + 1)} & listed, (r, x)
    assert abs(len(rows) - len(truth.row)) <= 4, "and hardly any more: edges lie between the steps"


def stripes_of(truth: Truth, angle: float) -> dict[str, np.ndarray]:
    n = len(truth.row)
    return {
        "frame": np.zeros(n, np.uint32),
        "laser": np.full(n, truth.laser, np.uint8),
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
    truth = truth_of(THINGS, a, angle)
    chain = PointChain(BUILT_IN["default"], a.calibration)
    found = chain.points(stripes_of(truth, angle))
    assert chain.dropped == 0
    points = np.stack([found["x_mm"], found["y_mm"], found["z_mm"]], axis=1)
    assert np.abs(points - truth.points_mm).max() < 1e-6
    assert np.abs(found["range_mm"] - truth.range_mm).max() < 1e-6


@pytest.mark.parametrize("head", ["rotates", "fixed"])
@pytest.mark.parametrize("turn", ["clockwise", "counterclockwise"])
def test_any_axis_gives_the_truth_back(head: str, turn: str) -> None:
    """A leaning turntable, seen from above, turning either way; two lasers, one on each side."""
    calibration = Calibration(
        rig="leaning",
        camera=Intrinsics(
            width_px=640, height_px=480, fx_px=900, fy_px=890, cx_px=320, cy_px=240, distortion=LENS
        ),
        lasers=(
            LaserPlane(laser=0, normal=(0.8, 0.06, 0.597), distance_mm=260.0),
            LaserPlane(laser=3, normal=(-0.8, 0.03, 0.599), distance_mm=255.0),
        ),
        turntable=TurntableAxis(
            point_mm=(5.0, 60.0, 430.0), direction=(0.02, -0.85, -0.5264), head=head, positive_turn=turn
        ),
    )
    a = SimulatedRig(calibration)
    scene = Scene([box((-60.0, -50.0, -200.0), (70.0, 40.0, 90.0)), ball((0, 0, 120), 40.0)])
    for angle in (0.0, 0.9):
        made = render(scene, a, angle, seed=0, light=DARK, sensor=QUIET)
        assert sorted(made.truth) == [0, 3]
        for truth in made.truth.values():
            assert len(truth.row) > 50
            found = PointChain(BUILT_IN["default"], calibration).points(stripes_of(truth, angle))
            points = np.stack([found["x_mm"], found["y_mm"], found["z_mm"]], axis=1)
            assert np.abs(points - truth.points_mm).max() < 1e-6


def test_a_turning_head_sees_one_room() -> None:
    """Points on the walls at all angles lie on the same walls, and the sweeps overlap."""
    a = rig(distortion=LENS)
    points = np.concatenate([truth_of(Scene([ROOM]), a, k * 0.3).points_mm for k in range(21)])
    assert np.abs(outside_by_mm(ROOM, points)).max() < 1e-9
    for axis, (low, high) in enumerate(((-3000, 4000), (-2000, 2500))):
        for limit in (low, high):
            assert (np.abs(points[:, axis] - limit) < 1e-6).sum() > 400
    # A full turn comes back to the same frame.
    once, again = truth_of(Scene([ROOM]), a, 0.4), truth_of(Scene([ROOM]), a, 0.4 + 2 * math.pi)
    assert np.abs(once.points_mm - again.points_mm).max() < 1e-6


def test_range_errors_of_exact_points_are_nothing() -> None:
    a, scene = rig(), Scene([ROOM])
    for angle in (1.3, 1.32):
        truth = truth_of(scene, a, angle)
        assert len(truth.row) > 300
        measured, true = range_errors_mm(scene, a, angle, truth.points_mm)
        assert np.abs(measured).max() < 1e-6
        assert true == pytest.approx(truth.range_mm)
        farther = truth.points_mm + 2.0 * (truth.points_mm / truth.range_mm[:, None])
        measured, _ = range_errors_mm(scene, a, angle, farther)
        assert measured == pytest.approx(np.full(len(farther), 2.0), abs=1e-6)


# -- where lasers stand ---------------------------------------------------------------------------


def test_a_horizontal_stripe_is_a_vertical_one_lying_down() -> None:
    """The same rig turned by a quarter about its view: columns for rows, and the same numbers."""
    sin, cos = math.sin(1.2), math.cos(1.2)
    upright = LaserPlane(laser=0, normal=(sin, 0.0, cos), distance_mm=300.0 * sin)
    lying = LaserPlane(laser=0, normal=(0.0, sin, cos), distance_mm=300.0 * sin)
    square = {"width_px": 480, "height_px": 480, "cx_px": 239.5, "cy_px": 239.5, "distortion": LENS}
    # A quarter turn maps (x, y) to (-y, x): tangential terms change places with it.
    k1, k2, p1, p2, k3 = LENS
    turned = {**square, "distortion": (k1, k2, p2, -p1, k3)}
    a = with_planes(upright)
    b = with_planes(lying)
    camera = a.intrinsics_or_fail()
    one = SimulatedRig(a.model_copy(update={"camera": camera.model_copy(update=square)}))
    two = SimulatedRig(b.model_copy(update={"camera": camera.model_copy(update=turned)}))
    assert (one.fan(0).stripe, two.fan(0).stripe) == ("vertical", "horizontal")
    # Scene space has x right, y ahead, z up: the quarter turn of the view is one about y.
    scene = [
        Plane(kind="plane", at_mm=(0, 2000, 0), turn_deg=(90, 0, 0)),
        ball((50.0, 1000.0, 20.0), 200.0),
    ]
    quarter = [scene[0], ball((20.0, 1000.0, -50.0), 200.0)]
    first, second = truth_of(Scene(scene), one), truth_of(Scene(quarter), two)
    assert len(first.row) > 400
    # (u, v) became (-v, u): a row is now a column counted backwards.
    order = np.lexsort((first.u_px, -first.row))
    assert np.array_equal(second.row, 479 - first.row[order])
    assert second.u_px == pytest.approx(first.u_px[order], abs=1e-8)
    assert second.amplitude_dn == pytest.approx(first.amplitude_dn[order])
    light = Light(ambient_dn=0, stripe_sigma_px=1.5)
    image = render(Scene(quarter), two, 0.0, seed=0, light=light, sensor=QUIET, exposure_us=1000).image
    single = np.bincount(second.row, minlength=480) == 1
    peaks = image.argmax(axis=0)[single]
    at = dict(zip(second.row.tolist(), second.u_px.tolist(), strict=True))
    true = np.array([at[c] for c in np.flatnonzero(single)])
    assert np.abs(peaks - true).max() < 1.0


def test_an_emitter_may_stand_anywhere_in_its_plane() -> None:
    """What is lit moves with it only by shadows; brightness is counted from where it stands."""
    plain = rig()
    n = np.array(plain.plane().normal)
    along = np.cross(n, [0.0, 1.0, 0.0])
    at = np.array([300.0, 0.0, 0.0]) + 120.0 * np.array([0.0, 1.0, 0.0]) + 50.0 * along
    moved = SimulatedRig(plain.calibration, emitters=[Emitter(laser=0, emitter_mm=tuple(at.tolist()))])
    one, two = truth_of(wall(), plain), truth_of(wall(), moved)
    assert np.array_equal(one.row, two.row)
    assert np.abs(one.points_mm - two.points_mm).max() < 1e-7
    emitter = np.array([at[0], at[2], -at[1]])
    beam = two.points_mm - emitter
    reach = np.linalg.norm(beam, axis=1)
    assert two.amplitude_dn == pytest.approx(900 * 0.7 * (beam[:, 1] / reach) * 1000 / reach)


def test_a_narrow_fan_ends_where_it_ends() -> None:
    a = SimulatedRig(rig().calibration, emitters=[Emitter(laser=0, fan_deg=10.0)])
    truth = truth_of(wall(), a)
    beam = truth.points_mm - np.array([300.0, 0.0, 0.0])
    up = np.arctan2(beam[:, 2], np.hypot(beam[:, 0], beam[:, 1]))
    assert np.degrees(np.abs(up)).max() < 5.0
    assert len(truth.row) == pytest.approx(
        2 * math.tan(math.radians(5)) * np.hypot(*beam[0, :2]) / 2000 * 760, abs=2
    )
    aimed = SimulatedRig(
        rig().calibration, emitters=[Emitter(laser=0, fan_deg=10.0, aim=(0.0, -0.15, 1.0))]
    )
    assert truth_of(wall(), aimed).row.max() < truth.row.min() + 20, "aimed up, in the rows above"


def test_lasers_that_do_not_fit_are_refused() -> None:
    across = LaserPlane(laser=0, normal=(0.0, 0.0, 1.0), distance_mm=900.0)
    with pytest.raises(CalibrationError, match="plane of laser 0 hardly meets the camera's X and Y"):
        SimulatedRig(with_planes(across))
    with pytest.raises(CalibrationError, match="its aim is square to its plane"):
        SimulatedRig(with_planes(across), emitters=[Emitter(laser=0, emitter_mm=(0.0, -100.0, 900.0))])
    off = Emitter(laser=0, emitter_mm=(301.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match=r"lies 0\.932 mm off that laser's plane"):
        SimulatedRig(rig().calibration, emitters=[off])
    with pytest.raises(
        CalibrationError, match=r"laser 4 is lit, but the simulated rig has lasers \[0\]"
    ):
        render(wall(), rig(), 0.0, seed=0, lasers=[4])


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
    block = box((x - 20.0, y - 20.0, -100.0), (x + 20.0, y + 20.0, 100.0))
    truth = truth_of(wall(2000.0, block), a)
    gap = sorted(set(range(480)) - rows_at(truth, y_mm=2000.0))
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
    assert gap[0] == math.ceil(241.25 - half_height)
    assert gap[-1] == math.floor(241.25 + half_height)


def test_what_the_laser_sees_and_the_camera_does_not_is_not_in_the_picture() -> None:
    """A screen between camera and wall, clear of the laser: its rows are dark, not misplaced."""
    a = rig()
    lit = truth_of(wall(), a).points_mm[0]
    x = lit[0] / 2
    screen = box((x - 30.0, 990.0, -50.0), (x + 30.0, 1000.0, 80.0))
    rendered = render(wall(2000.0, screen), a, 0.0, seed=0, light=DARK, sensor=QUIET)
    gap = sorted(set(range(480)) - rows_at(rendered.truth[0], y_mm=2000.0))
    # The camera looks past the front edges at 990 mm.
    assert gap[0] == math.ceil(241.25 - 80.0 / 990.0 * 760.0)
    assert gap[-1] == math.floor(241.25 + 50.0 / 990.0 * 760.0)
    assert not set(gap) & set(rendered.truth[0].row.tolist()), "the screen itself is not lit"
    assert rendered.image[gap].max() == 0
    assert rendered.image[[gap[0] - 1, gap[-1] + 1]].max() > 0


def test_a_box_in_the_stripe_is_seen_before_the_wall() -> None:
    a = rig()
    lit = truth_of(wall(), a).points_mm[240]
    block = box((lit[0] - 400.0, 1500.0, -100.0), (lit[0] + 400.0, 1600.0, 100.0))
    truth = truth_of(wall(2000.0, block), a)
    front = rows_at(truth, y_mm=1500.0)
    half_height = 100.0 / 1500.0 * 760.0
    first, last = math.ceil(241.25 - half_height), math.floor(241.25 + half_height)
    assert front == set(range(first, last + 1)), "to the very edge"
    assert not front & rows_at(truth, y_mm=2000.0)
