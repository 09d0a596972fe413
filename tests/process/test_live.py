"""Extraction in a process of its own: equal to what is derived later, and harmless when it dies."""

from __future__ import annotations

import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from turnscan.process.live import LiveExtraction
from turnscan.process.pipeline import LiveStart, derive
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.schemas.recipe import BUILT_IN, Extract, Recipe, Triangulate
from turnscan.store import Archive
from turnscan.store.drafts import ScanDraft
from turnscan.store.log_writer import LogWriter

RECIPE = BUILT_IN["default"]


def calibration(width_px: int = 64, h: float = 150.0) -> Calibration:
    return Calibration(
        rig="r1",
        camera=Intrinsics(
            width_px=width_px, height_px=48, fx_px=300.0, fy_px=300.0, cx_px=32.0, cy_px=24.0
        ),
        lasers=(LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=h),),
        turntable=TurntableAxis(point_mm=(0, 0, 180), direction=(0, -1, 0)),
    )


@pytest.fixture
def lab(tmp_path: Path) -> Archive:
    return Archive.init(tmp_path / "lab")


class Growing:
    """A log written by hand, as a recorder does."""

    def __init__(self, draft: ScanDraft) -> None:
        self.writer = LogWriter(draft.part)
        self.count = 0
        start = ScanStart(
            t_ns=5, scan=draft.scan, rig="r1", source="test", time_source="clock", software="t"
        )
        self.writer.write_event(start)
        self.writer.write_calibration(calibration(), 5)

    def frame(self) -> None:
        n, self.count = self.count, self.count + 1
        moving = True if n % 3 else None
        angle = TurntableAngle(
            t_ns=10 * n + 10, commanded_rad=1.0, reported_rad=0.02 * n, moving=moving
        )
        self.writer.write_event(angle)
        x, row = np.arange(64), np.arange(48)[:, None]
        stripe = 12 + 180 * np.exp(-((x - 25 - n % 20 - 0.05 * row) ** 2) / 4.5)
        image = np.rint(stripe).astype(np.uint8)
        self.writer.write_image(Exposure(t_ns=10 * n + 14, frame=n, lasers_on=(0,)), image)
        self.writer.flush()

    def end(self) -> None:
        self.writer.write_event(TurntableAngle(t_ns=10**5, commanded_rad=1.0, reported_rad=1.0))
        self.writer.write_event(ScanEnd(t_ns=10**6, ended="complete", frames=self.count))
        self.writer.finish()


def live_on(lab: Archive, draft: ScanDraft, recipe: Recipe = RECIPE, **more: object) -> LiveExtraction:
    start = LiveStart(draft.scan, "0", recipe, calibration(**more), 64, 48)  # type: ignore[arg-type]
    live = LiveExtraction(lab.root, start)
    live.begin(draft.part)
    return live


def test_it_keeps_up_and_equals_what_is_derived_later(lab: Archive) -> None:
    with lab.new_scan() as draft:
        log = Growing(draft)
        live = live_on(lab, draft)
        for _ in range(30):
            log.frame()
        until = time.monotonic() + 60
        while live.look().frames < 20 and time.monotonic() < until:
            log.frame()
            time.sleep(0.02)
        assert live.look().frames >= 20, "it works while the log grows"
        assert live.look().coverage == 1.0
        log.end()
        found = live.finish()
        assert found is not None
        assert found[0] == draft.examine()
        lab.seal(draft, *found)
        outcome = live.sealed()
    assert live.failure is None
    assert outcome is not None
    assert (outcome.derived, outcome.frames) == (("stripes", "points"), log.count)
    archive = Archive.open(lab.root)
    made = {m.path: (lab.root / m.path).read_bytes() for m in archive.derivations()}
    assert len(made) == 2
    shutil.rmtree(lab.root / "derived")
    (lab.root / "catalog.sqlite").unlink()
    again = Archive.open(lab.root)
    assert [o.error for o in derive(again, again.scans(), RECIPE)] == [None]
    assert {m.path: (lab.root / m.path).read_bytes() for m in again.derivations()} == made


def test_if_it_is_killed_the_recording_goes_on(lab: Archive) -> None:
    with lab.new_scan() as draft:
        log = Growing(draft)
        live = live_on(lab, draft)
        log.frame()
        os.kill(live._process.pid, signal.SIGKILL)
        for _ in range(3):
            log.frame()
            live.look()
        log.end()
        assert live.finish() is None
        assert live.failure is not None
        assert "ended unexpectedly" in str(live.failure)
        lab.seal(draft, draft.examine())
        assert live.sealed() is None
    assert [o.error for o in derive(lab, lab.scans(), RECIPE)] == [None]


def test_a_recipe_that_fails_is_reported_and_stops_nothing(lab: Archive) -> None:
    wants_off = Recipe(name="off", stages=(Extract(background="off-frame"), Triangulate()))
    with lab.new_scan() as draft:
        log = Growing(draft)
        live = live_on(lab, draft, wants_off)
        for _ in range(5):
            log.frame()
        log.end()
        assert live.finish() is None
        assert "laser-off frame" in str(live.failure)
        lab.seal(draft, draft.examine())
    assert lab.derivations() == []


def test_another_calibration_than_the_one_it_began_with_is_not_published(lab: Archive) -> None:
    """Only where the frame stages use it: the paper undistorts frames."""
    with lab.new_scan() as draft:
        log = Growing(draft)
        begun = calibration().model_copy(update={"rig": "r1"})
        assert begun.camera is not None
        other = begun.model_copy(update={"camera": begun.camera.model_copy(update={"fx_px": 301.0})})
        live = LiveExtraction(lab.root, LiveStart(draft.scan, "0", BUILT_IN["paper"], other, 64, 48))
        live.begin(draft.part)
        for _ in range(3):
            log.frame()
        log.end()
        found = live.finish()
        assert found is not None
        lab.seal(draft, *found)
        assert live.sealed() is None
    assert "another calibration holds" in str(live.failure)
    assert Archive.open(lab.root).derivations() == []
    assert lab.store.list("staging") == []


def test_if_the_recorder_is_gone_it_ends_and_leaves_nothing(lab: Archive) -> None:
    with lab.new_scan() as draft:
        log = Growing(draft)
        live = live_on(lab, draft)
        process = live._process
        for _ in range(3):
            log.frame()
        until = time.monotonic() + 60
        while live.look().frames < 1 and time.monotonic() < until:
            time.sleep(0.01)
        assert live._pipe is not None
        live._pipe.close()
        process.join(20)
        assert process.exitcode == 0
        log.writer.abandon()
    assert lab.store.list("staging") == []
