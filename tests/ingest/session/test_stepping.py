"""Step-and-shoot on the emulated controllers: order of events, retries, skips, faults, interrupts."""

from __future__ import annotations

import math
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from turnscan.ingest.devices.contracts import Shot
from turnscan.ingest.session.interrupts import InterruptedSession
from turnscan.ingest.session.order import Devices
from turnscan.schemas.errors import CalibrationError, ConflictError, DeviceError
from turnscan.schemas.events import (
    DeviceLine,
    Exposure,
    LaserState,
    LogLine,
    ScanEnd,
    StripeTruth,
    TurntableAngle,
)
from turnscan.store import Archive

from .rigs import order_of, rig, run

DIALECTS = ("turnscan", "horus", "grbl")


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_scan_is_recorded_whole(lab: Archive, tmp_path: Path, dialect: str) -> None:
    ran = run(lab, rig(tmp_path, dialect=dialect))
    assert ran.error is None
    assert ran.result is not None
    assert ran.result.error is None
    assert ran.result.scan is not None
    assert (ran.result.scan.ended, ran.result.scan.frames) == ("complete", 4)
    items = ran.items()
    angles = [i for i in items if isinstance(i, TurntableAngle)]
    assert [round(math.degrees(a.commanded_rad), 6) for a in angles] == [0, 10, 20, 30]
    for angle in angles:
        assert angle.reported_rad == pytest.approx(angle.commanded_rad, abs=math.radians(0.05))
    truth = [i for i in items if isinstance(i, StripeTruth)]
    assert [t.frame for t in truth] == [0, 1, 2, 3]
    for told, angle in zip(truth, angles, strict=True):
        assert told.angle_rad == pytest.approx(angle.reported_rad, abs=1e-4)
    assert any(isinstance(i, DeviceLine) and i.direction == "sent" for i in items)
    assert any(isinstance(i, DeviceLine) and i.direction == "received" for i in items)
    assert ran.shown[-1].done == ran.shown[-1].total == 4


def test_every_frame_was_lit_as_its_exposure_says(lab: Archive, tmp_path: Path) -> None:
    """Two lasers, off frames, two exposures: what the emulator's lasers did is what the log says."""
    document = rig(
        tmp_path, lasers=2, to_deg=10, off_frame=True, exposures_us=(1000, 4000), frames_per_pose=1
    )
    ran = run(lab, document)
    assert ran.error is None
    exposures = [i for i in ran.items() if isinstance(i, Exposure)]
    assert [(e.lasers_on, e.exposure_ns) for e in exposures[:6]] == [
        ((), 1_000_000),
        ((0,), 1_000_000),
        ((1,), 1_000_000),
        ((), 4_000_000),
        ((0,), 4_000_000),
        ((1,), 4_000_000),
    ]
    emulator = ran.built.emulator
    assert emulator is not None
    for exposure in exposures:
        lit = emulator.body.state(exposure.t_ns).outputs_lit
        assert lit == {n + 1 for n in exposure.lasers_on}
    told: dict[int, bool] = {}
    for item in ran.items():
        if isinstance(item, LaserState):
            told[item.laser] = item.on
        elif isinstance(item, Exposure):
            assert tuple(n for n, on in sorted(told.items()) if on) == item.lasers_on
    assert not any(told.values())


def test_both_lasers_together(lab: Archive, tmp_path: Path) -> None:
    document = rig(tmp_path, lasers=2)
    scan = document.scan.model_copy(update={"lasers": "together"})
    ran = run(lab, document.model_copy(update={"scan": scan}))
    assert {f.lasers_on for f in ran.frames()} == {(0, 1)}


class FailingCamera:
    """The simulated camera, whose cable comes off at some shots."""

    def __init__(self, camera: Any, fails: set[int]) -> None:
        self._camera = camera
        self._fails = fails
        self.asked = 0

    def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
        self.asked += 1
        if self.asked in self._fails:
            raise DeviceError("the camera does not answer", hint="is it plugged in?")
        return self._camera.shoot(after_ns, exposure_us)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


def failing(*shots: int) -> Any:
    def wrap(devices: Devices) -> Devices:
        return replace(devices, camera=FailingCamera(devices.camera, set(shots)))

    return wrap


def test_a_pose_that_fails_is_tried_again_without_the_shots_it_has(
    lab: Archive, tmp_path: Path
) -> None:
    document = rig(tmp_path, lasers=2, to_deg=10, retries=2)
    ran = run(lab, document, wrap=failing(2, 3))
    assert ran.result is not None
    assert (ran.result.retried, ran.result.missed, ran.result.error) == (2, [], None)
    assert [f.lasers_on for f in ran.frames()] == [(0,), (1,), (0,), (1,)]
    remarks = [i.message for i in ran.items() if isinstance(i, LogLine) and i.level == "warning"]
    assert len(remarks) == 2
    assert all("does not answer" in m for m in remarks)


def test_a_pose_that_keeps_failing_is_skipped_and_reported(lab: Archive, tmp_path: Path) -> None:
    ran = run(lab, rig(tmp_path, retries=1, on_failure="skip"), wrap=failing(2, 3))
    assert ran.result is not None
    assert [round(math.degrees(m.angle_rad)) for m in ran.result.missed] == [10]
    assert ran.result.scan is not None
    assert (ran.result.scan.frames, ran.result.scan.ended) == (3, "complete")
    (end,) = [i for i in ran.items() if isinstance(i, ScanEnd)]
    assert "1 poses skipped (deg): 10" in end.note


def test_a_pose_that_keeps_failing_ends_the_scan_if_the_rig_file_says_so(
    lab: Archive, tmp_path: Path
) -> None:
    ran = run(lab, rig(tmp_path, retries=0, on_failure="stop"), wrap=failing(3))
    assert ran.result is not None
    assert isinstance(ran.result.error, DeviceError)
    assert ran.result.scan is not None
    assert (ran.result.scan.frames, ran.result.scan.ended) == (2, "interrupted")


def test_three_poses_in_a_row_are_no_accident(lab: Archive, tmp_path: Path) -> None:
    document = rig(tmp_path, to_deg=100, retries=0, on_failure="skip")
    ran = run(lab, document, wrap=failing(*range(3, 99)))
    assert ran.result is not None
    assert "3 poses in a row failed" in str(ran.result.error)
    assert ran.result.frames == 2


def test_without_a_frame_nothing_is_left_behind(lab: Archive, tmp_path: Path) -> None:
    ran = run(lab, rig(tmp_path, retries=0), wrap=failing(*range(1, 99)))
    assert isinstance(ran.error, DeviceError)
    assert lab.store.list("scans") == []
    assert lab.store.list("staging") == []


FAULTS = [
    {"kind": "delay", "delay_s": 0.2, "on": "move", "at": 3},
    {"kind": "delay", "delay_s": 1, "on": "any", "at": 20, "count": 3},
    {"kind": "garbage", "at": 15, "count": 2},
    {"kind": "lost-command", "on": "laser", "at": 3},
    {"kind": "lost-command", "on": "move", "at": 3},
    {"kind": "lost-reply", "on": "laser", "at": 4},
    {"kind": "lost-reply", "on": "move", "at": 3},
    {"kind": "nak", "on": "laser", "at": 3},
    {"kind": "nak", "on": "move", "at": 2},
    {"kind": "stall", "on": "move", "at": 3},
    {"kind": "missed-steps", "on": "move", "at": 3, "steps": 3000},
    {"kind": "hang-up", "at": 25},
]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f"{f['kind']}-{f.get('on', 'any')}")
@pytest.mark.parametrize("dialect", DIALECTS)
def test_faults_are_survived_or_said_and_never_give_a_wrong_angle(
    lab: Archive, tmp_path: Path, dialect: str, fault: dict[str, Any]
) -> None:
    document = rig(
        tmp_path,
        dialect=dialect,
        faults=(fault,),
        turntable={"watchdog_s": 0.5},
        retries=1,
        on_failure="skip",
    )
    # Over a cable that is off nobody can release a motor; lasers go off by the watchdog.
    ran = run(lab, document, cable_off_s=1.0 if fault["kind"] == "hang-up" else None)
    if ran.error is not None:
        assert isinstance(ran.error, DeviceError)
        assert ran.error.hint
        return
    result = ran.result
    assert result is not None
    if result.error is not None:
        assert isinstance(result.error, DeviceError)
    if result.scan is None:
        return
    angle: TurntableAngle | None = None
    wrong_without_encoder = fault["kind"] == "missed-steps" and dialect != "turnscan"
    for item in ran.items():
        if isinstance(item, TurntableAngle):
            angle = item
        elif isinstance(item, StripeTruth) and not wrong_without_encoder:
            assert angle is not None
            assert item.angle_rad == pytest.approx(angle.reported_rad, abs=math.radians(0.05))
    whole = result.scan.frames == 4
    assert whole or result.missed or result.error is not None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_well_and_a_second_one_changes_nothing(
    lab: Archive, tmp_path: Path, number: signal.Signals
) -> None:
    document = rig(tmp_path, to_deg=300, step_deg=1)

    def interrupt(progress: Any) -> None:
        if progress.frames >= 3 and not timers:
            for delay in (0.0, 0.005, 0.01, 0.02, 0.05):
                timers.append(threading.Timer(delay, os.kill, (os.getpid(), number)))
                timers[-1].start()

    timers: list[threading.Timer] = []
    # What comes when the session is over already goes to nobody.
    before = signal.signal(number, lambda *_: None)
    try:
        ran = run(lab, document, order=order_of(document), show_also=interrupt)
        for timer in timers:
            timer.join()
    finally:
        signal.signal(number, before)
    assert ran.error is None
    assert ran.result is not None
    assert ran.result.interrupted
    assert ran.result.scan is not None
    assert ran.result.scan.ended == "interrupted"
    assert 3 <= ran.result.scan.frames < 300
    lit = [i for i in ran.items() if isinstance(i, LaserState)]
    assert not lit[-1].on, "the log says that the laser went off"


def test_interrupted_before_the_first_frame_leaves_nothing(lab: Archive, tmp_path: Path) -> None:
    class Slow(FailingCamera):
        def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
            os.kill(os.getpid(), signal.SIGINT)
            return self._camera.shoot(after_ns, exposure_us)

    ran = run(lab, rig(tmp_path), wrap=lambda d: replace(d, camera=Slow(d.camera, set())))
    assert isinstance(ran.error, InterruptedSession)
    assert lab.store.list("scans") == []


def test_a_calibration_of_another_size_is_refused_before_anything_moves(
    lab: Archive, tmp_path: Path
) -> None:
    document = rig(tmp_path)
    order = order_of(document)
    assert order.calibration is not None
    assert order.calibration.camera is not None
    camera = order.calibration.camera.model_copy(update={"width_px": 320})
    other = order.calibration.model_copy(update={"camera": camera})
    ran = run(lab, document, order=replace(order, calibration=other))
    assert isinstance(ran.error, CalibrationError)
    assert "gives 160 x 120" in str(ran.error)


def test_an_exception_that_is_a_bug_still_puts_everything_to_rest(lab: Archive, tmp_path: Path) -> None:
    class Broken(FailingCamera):
        def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
            self.asked += 1
            if self.asked == 3:
                raise ZeroDivisionError
            return self._camera.shoot(after_ns, exposure_us)

    ran = run(lab, rig(tmp_path), wrap=lambda d: replace(d, camera=Broken(d.camera, set())))
    assert isinstance(ran.error, ZeroDivisionError)
    (scan,) = lab.store.list("scans")
    assert lab.store.list(f"scans/{scan}") == ["scan.mcap.part"], "two frames are there to be salvaged"


def test_nothing_missing_is_said(lab: Archive, tmp_path: Path) -> None:
    from turnscan.ingest.session.earlier import read_earlier

    document = rig(tmp_path)
    ran = run(lab, document)
    assert ran.result is not None
    assert ran.result.scan is not None
    earlier, plan = read_earlier(lab, [ran.result.scan])
    assert plan == document.scan
    again = run(lab, document, order=order_of(document, earlier=earlier))
    assert isinstance(again.error, ConflictError)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_scan_does_not_go_on_in_other_angles(lab: Archive, tmp_path: Path, dialect: str) -> None:
    """The controller was switched off in between: its zero is wherever the table stands now."""
    from turnscan.ingest.session.earlier import read_earlier

    document = rig(tmp_path, dialect=dialect, retries=0)
    first = run(lab, document, wrap=failing(3))
    assert first.result is not None
    assert first.result.scan is not None
    earlier, _ = read_earlier(lab, [first.result.scan])
    order = order_of(document, earlier=earlier)
    refused = run(lab, document, order=replace(order, at_zero=False))
    assert isinstance(refused.error, ConflictError)
    assert "--at-zero" in str(refused.error.hint)
    rest = run(lab, document, order=order)
    assert rest.result is not None
    assert rest.result.scan is not None
    assert (rest.result.scan.frames, rest.result.scan.continues) == (2, first.result.scan.scan)
