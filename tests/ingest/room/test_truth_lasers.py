"""Where lasers may stand, and what shadows they leave."""

from __future__ import annotations

import math

import numpy as np
import pytest

from turnscan.ingest.room.render import Truth, render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.schemas.calibration import LaserPlane
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.scene import Emitter, Light, Plane

from .rigs import DARK, LENS, QUIET, ball, box, rig, truth_of, wall, with_planes


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
