"""Calibrations are named by their content, certified, withdrawn, lost and found again."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from turnscan.process.pipeline import derive
from turnscan.schemas.errors import (
    CalibrationError,
    DamageError,
    NotFoundError,
)
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.repair import repair
from turnscan.store.verify import verify

from .scans import calibration, import_scan


def test_calibrations_are_content_addressed(lab: Archive) -> None:
    c = calibration(h=200.0)
    name = lab.add_calibration(c)
    assert name == c.calibration_id() == lab.add_calibration(c)
    assert lab.calibration(name[:6]) == c
    with pytest.raises(NotFoundError, match="no calibration"):
        lab.calibration("c-000000000000")


def test_the_effective_calibration(lab: Archive) -> None:
    scan = lab.scan("latest")
    recorded = scan.calibration
    start = scan.started_ns
    assert lab.effective(scan).calibration.calibration_id() == recorded
    a, b = (lab.add_calibration(calibration(h=h)) for h in (201.0, 202.0))
    lab.certify(a)
    assert lab.effective(scan).calibration.calibration_id() == a
    lab.certify(b, from_ns=start + 1)
    lab.certify(b, to_ns=start)
    lab.certify(b, rig="another", reason="its scans come tomorrow")
    assert lab.effective(scan).calibration.calibration_id() == a, "none of b's ranges covers it"
    lab.certify(b, from_ns=start, to_ns=start + 1)
    assert lab.effective(scan).calibration.calibration_id() == b
    assert lab.effective(scan, "recorded").calibration.calibration_id() == recorded
    assert lab.effective(scan, a).calibration.calibration_id() == a
    lab.withdraw(b)
    assert lab.effective(scan).calibration.calibration_id() == a
    lab.withdraw(a)
    assert lab.effective(scan).calibration.calibration_id() == recorded
    with pytest.raises(CalibrationError, match="is not certified"):
        lab.withdraw(a)
    assert Archive.open(lab.root).effective(scan).calibration.calibration_id() == recorded


def test_events_are_ordered_though_the_clock_steps_back(
    lab: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    from turnscan.schemas import ids
    from turnscan.store import archive as module

    old = ids.new_ulid(1_000_000_000)
    a, b = (lab.add_calibration(calibration(h=h)) for h in (201.0, 202.0))
    lab.certify(a)
    monkeypatch.setattr(module, "new_ulid", lambda: old)
    lab.certify(b)
    names = sorted(os.listdir(lab.root / "events"))
    assert json.loads((lab.root / "events" / names[-1]).read_text())["calibration"] == b
    assert lab.effective(lab.scan("latest")).calibration.calibration_id() == b


def test_an_edited_calibration_is_noticed(lab: Archive) -> None:
    path = next((lab.root / "calibrations").iterdir())
    path.write_text(path.read_text().replace('"fx_px": 300.0', '"fx_px": 301.0'))
    with pytest.raises(DamageError, match="the file was changed"):
        lab.calibration(path.stem)
    assert any("the file was changed" in f.what for f in verify(lab))


def test_a_lost_calibration_is_found_and_comes_back_from_the_log(lab: Archive, source: Path) -> None:
    name = lab.scan("latest").calibration
    other = import_scan(lab, source, step=12.0, c=calibration(h=160.0))
    (lab.root / "calibrations" / f"{name}.json").unlink()
    again = Archive.open(lab.root)
    found = verify(again)
    assert any(name in f.path and "is missing" in f.what for f in found), found
    a, b = derive(again, again.scans(), BUILT_IN["paper"])
    assert isinstance(a.error, DamageError)
    assert (b.scan, b.error) == (other.scan, None), "one scan's damage stops no other"
    assert any("restored from the log" in r.did for r in repair(again))
    again = Archive.open(lab.root)
    assert verify(again) == []
    assert [o.error for o in derive(again, again.scans(), BUILT_IN["paper"])] == [None, None]


def test_the_calibrations_size_is_checked_without_an_undistort_stage(lab: Archive) -> None:
    from turnscan.schemas.recipe import Extract, Recipe, Triangulate

    wrong = calibration().model_copy(
        update={"camera": calibration().camera.model_copy(update={"width_px": 640})}
    )
    name = lab.add_calibration(wrong)
    recipe = Recipe(name="bare", stages=(Extract(), Triangulate()))
    (outcome,) = derive(lab, lab.scans(), recipe, name)
    assert isinstance(outcome.error, CalibrationError)
    assert "frames are 64 x 48, the calibration is for 640 x 48" in str(outcome.error)
