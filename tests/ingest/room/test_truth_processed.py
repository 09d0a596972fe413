"""Truth of any camera, laser and axis, and processing that gives it back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from turnscan.ingest.room.render import Truth, render
from turnscan.ingest.room.rig import SimulatedRig, forward_project
from turnscan.ingest.room.scene import Scene
from turnscan.ingest.room.truth import range_errors_mm
from turnscan.process.stages import PointChain
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.recipe import BUILT_IN
from turnscan.schemas.scene import Box, Cylinder

from .rigs import DARK, LENS, QUIET, ROOM, ball, box, rig, truth_of
from .test_rays import outside_by_mm

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
