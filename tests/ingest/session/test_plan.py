"""Poses, shots and what is missing of them, as closed forms say."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.session.plan import (
    ShotPlan,
    Sweep,
    Taken,
    frames_of,
    pose_angles,
    shots_of_pose,
    sweeps_of,
    work_of,
)
from turnscan.schemas.rig import ScanSettings


def degrees(scan: ScanSettings) -> list[float]:
    return [round(math.degrees(a), 9) for a in pose_angles(scan)]


def test_the_end_is_a_pose_unless_it_closes_the_turn() -> None:
    assert degrees(ScanSettings(from_deg=0, to_deg=30, step_deg=10)) == [0, 10, 20, 30]
    assert degrees(ScanSettings(from_deg=0, to_deg=25, step_deg=10)) == [0, 10, 20]
    whole = degrees(ScanSettings(from_deg=0, to_deg=360, step_deg=90))
    assert whole == [0, 90, 180, 270]
    assert degrees(ScanSettings(from_deg=0, to_deg=360, step_deg=80)) == [0, 80, 160, 240, 320]


def test_it_turns_backwards_as_well() -> None:
    assert degrees(ScanSettings(from_deg=30, to_deg=0, step_deg=15)) == [30, 15, 0]
    assert degrees(ScanSettings(from_deg=0, to_deg=-360, step_deg=90)) == [0, -90, -180, -270]


@given(st.floats(-300, 300), st.integers(2, 400), st.floats(0.01, 5), st.sampled_from([1.0, -1.0]))
def test_every_step_is_taken_exactly_once(first: float, count: int, step: float, sign: float) -> None:
    span = count * step
    if abs(span / 360 - round(span / 360)) < 1e-6:
        return
    scan = ScanSettings(from_deg=first, to_deg=first + sign * span, step_deg=step)
    angles = degrees(scan)
    assert len(angles) == count + 1
    assert angles[-1] == pytest.approx(scan.to_deg, abs=1e-6)


def test_each_exposure_has_its_own_off_frame_before_its_lit_ones() -> None:
    scan = ScanSettings(off_frame=True, exposures_us=(100, 1000), frames_per_pose=2)
    assert shots_of_pose(scan, (0, 3)) == (
        ShotPlan((), 100),
        ShotPlan((0,), 100),
        ShotPlan((0,), 100),
        ShotPlan((3,), 100),
        ShotPlan((3,), 100),
        ShotPlan((), 1000),
        ShotPlan((0,), 1000),
        ShotPlan((0,), 1000),
        ShotPlan((3,), 1000),
        ShotPlan((3,), 1000),
    )
    together = ScanSettings(lasers="together")
    assert shots_of_pose(together, (0, 3)) == (ShotPlan((0, 3)),)


PLANS = st.builds(
    ScanSettings,
    to_deg=st.just(40.0),
    step_deg=st.just(10.0),
    off_frame=st.booleans(),
    exposures_us=st.sampled_from([(), (100.0,), (100.0, 2000.0)]),
    frames_per_pose=st.integers(1, 3),
    lasers=st.sampled_from(["one-by-one", "together"]),
)


@given(PLANS, st.integers(0, 60))
def test_what_was_taken_and_what_is_missing_make_the_whole(scan: ScanSettings, cut: int) -> None:
    """Cut anywhere, the lit shots of both parts are those of the plan, none twice."""
    lasers = (0, 1)
    everything = [(w.angle_rad, s) for w in work_of(scan, lasers) for s in w.shots]
    done = everything[:cut]
    taken = [Taken(angle + 1e-9, s.lasers, s.exposure_us) for angle, s in done]
    rest = [(w.angle_rad, s) for w in work_of(scan, lasers, taken) for s in w.shots]
    lit = [x for x in everything if x[1].lasers]
    assert [x for x in [*done, *rest] if x[1].lasers] == lit
    if scan.off_frame:
        for angle, shot in rest:
            assert not shot.lasers or (angle, ShotPlan((), shot.exposure_us)) in rest


def test_an_exposure_that_the_camera_rounded_is_known_again() -> None:
    scan = ScanSettings(to_deg=10, step_deg=10, exposures_us=(100, 2000))
    taken = [Taken(0.0, (0,), 103.7), Taken(0.0, (0,), 1985.0), Taken(math.radians(10), (0,), 103.7)]
    (left,) = work_of(scan, (0,), taken)
    assert left.shots == (ShotPlan((0,), 2000),)


def test_sweeps_go_on_where_they_were_cut() -> None:
    scan = ScanSettings(mode="continuous", from_deg=0, to_deg=90, speed_deg_s=9)
    full = sweeps_of(scan, (0, 1))
    assert full == (Sweep(0.0, math.pi / 2, (0,)), Sweep(0.0, math.pi / 2, (1,)))
    assert frames_of(scan, (), full, 30.0) == pytest.approx(2 * 10 * 30, abs=3)
    rest = sweeps_of(scan, (0, 1), {(0,): math.pi / 2, (1,): 1.0})
    assert rest == (Sweep(1.0, math.pi / 2, (1,)),)
    assert sweeps_of(scan, (0,), {(0,): math.pi / 2}) == ()
