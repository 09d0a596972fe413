"""``turnscan record`` as users run it: whole scans, Ctrl-C, going on, bad input."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from console import Console
from recordings import archive_of, begin, points_of, wait_for_frames

from turnscan.process.pipeline import derive
from turnscan.schemas.events import DeviceLine, LaserState, ScanEnd
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.verify import verify


def test_a_scan_is_recorded_extracted_and_sealed(lab: Console) -> None:
    row = lab.json("record", "--label", "bust", "--tag", "owner=lab2")
    assert (row["ended"], row["frames"], row["dropped"], row["label"]) == ("complete", 16, 0, "bust")
    assert row["points"] > 16 * 60
    archive = archive_of(lab)
    assert verify(archive) == []
    shown = lab.json("scan", "show", "bust")
    assert (shown["source"], shown["tags"]) == ("simulated", {"owner": "lab2"})
    assert {d["table"] for d in shown["derivations"]} == {"stripes", "points"}
    assert lab.json("status") == []
    lab("export", "bust", "cloud.ply")


def test_live_tables_are_byte_for_byte_those_that_process_derives(lab: Console) -> None:
    lab("record", "--to-deg", "60")
    archive = archive_of(lab)
    made = {m.path: (archive.root / m.path).read_bytes() for m in archive.derivations()}
    assert len(made) == 2
    shutil.rmtree(archive.root / "derived")
    (archive.root / "catalog.sqlite").unlink()
    again = Archive.open(archive.root)
    (outcome,) = derive(again, again.scans(), BUILT_IN["default"])
    assert outcome.derived == ("stripes", "points")
    assert {m.path: (archive.root / m.path).read_bytes() for m in again.derivations()} == made


def test_the_paper_recipe_runs_beside_as_well(lab: Console) -> None:
    assert lab.json("record", "--recipe", "paper", "--to-deg", "10")["points"] > 0
    assert lab.json("status", "--recipe", "paper") == []


def test_without_extraction_process_does_it_later(lab: Console) -> None:
    done = lab("record", "--no-extract", "--to-deg", "6")
    assert "no points yet: turnscan process" in done.stderr
    assert [row["table"] for row in lab.json("status")] == ["stripes and points"]
    lab("process", "latest")
    assert lab.json("status") == []


def test_a_failing_extraction_leaves_the_recording_whole_and_says_so(lab: Console) -> None:
    (lab.cwd / "off.toml").write_text(
        'name = "off"\n[[stages]]\nstage = "extract"\nbackground = "off-frame"\n'
        '[[stages]]\nstage = "triangulate"\n'
    )
    done = lab("record", "--recipe", "off.toml", "--to-deg", "10", "--json")
    assert "extraction beside the recording failed" in done.stderr
    assert "laser-off frame" in done.stderr
    assert json.loads(done.stdout)["frames"] == 6
    assert verify(archive_of(lab)) == []
    lab("process", "latest")


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_seals_what_there_is_and_resume_takes_the_rest(lab: Console, number: int) -> None:
    whole = lab.json("record", "--to-deg", "200", "--label", "whole")
    process = begin(lab, "--to-deg", "200", "--label", "cut")
    assert lab.archive is not None
    wait_for_frames(lab.archive, 5, process)
    process.send_signal(number)
    out, err = process.communicate(timeout=150)
    assert process.returncode == 130, (out, err)
    assert "Traceback" not in err
    assert "to go on with what is missing: turnscan record --rig rig.toml --resume" in err
    archive = archive_of(lab)
    cut = archive.scan("cut")
    assert cut.ended == "interrupted"
    assert 0 < cut.frames < 101
    items = list(archive.log(cut.scan).items())
    last = [i for i in items if isinstance(i, LaserState)][-1]
    assert not last.on
    assert any(isinstance(i, DeviceLine) for i in items[-8:]), "the last words to the controller"
    (end,) = [i for i in items if isinstance(i, ScanEnd)]
    assert (end.ended, end.frames) == ("interrupted", cut.frames)

    rest = lab.json("record", "--resume", "cut")
    assert (rest["continues"], rest["label"]) == (cut.scan, "cut")
    assert cut.frames + rest["frames"] == whole["frames"] == 101
    assert points_of(archive, [cut.scan, rest["scan"]]).equals(points_of(archive, [whole["scan"]]))


def test_a_resumed_scan_is_shown_processed_and_exported_as_one(lab: Console) -> None:
    process = begin(lab, "--to-deg", "200", "--label", "cut")
    assert lab.archive is not None
    wait_for_frames(lab.archive, 5, process)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=150)
    second = lab.json("record", "--resume", "cut")
    first = second["continues"]
    for word in ("cut", first, second["scan"], "latest"):
        shown = lab.json("scan", "show", word)
        assert [log["scan"] for log in shown["logs"]] == [first, second["scan"]]
        assert {d["scan"] for d in shown["derivations"]} == {first, second["scan"]}
    text = lab("scan", "show", "cut").stdout
    assert "101, of them 0" in text
    assert "0 to 200" in text
    lab("export", "cut", "both.csv")
    rows = pl.read_csv(lab.cwd / "both.csv", infer_schema_length=None)
    assert rows.height == sum(d["rows"] for d in shown["derivations"] if d["table"] == "points")
    assert len(lab.json("process", "cut", "--recipe", "paper")) == 2
    lab("scan", "tag", "cut", "part=both")
    assert all(r["tags"] == {"part": "both"} for r in lab.json("scan", "list"))
    error = lab.fails("record", "--resume", "latest")
    assert "no pose" in error


@pytest.mark.parametrize(
    ("words", "said", "code"),
    [
        (("--rig", "none.toml"), "none.toml", 1),
        (("--to-deg", "0"), "nothing to scan", 1),
        (("--to-deg", "9000"), "the scan turns from", 1),
        (("--resume", "nobody"), "no scan 'nobody'", 1),
        (("--resume", "x", "--to-deg", "5"), "--resume goes on with the plan", 2),
        (("--resume", "x", "--label", "y"), "--resume goes on with the plan", 2),
    ],
)
def test_bad_input_is_one_clear_error(lab: Console, words: Any, said: str, code: int) -> None:
    assert said in lab.fails("record", *words, code=code)


def test_another_rig_cannot_go_on_with_a_scan(lab: Console) -> None:
    lab("record", "--to-deg", "6", "--no-extract")
    rig = lab.cwd / "rig.toml"
    rig.write_text(rig.read_text().replace('name = "sim"', 'name = "other"'))
    assert "is of rig 'sim'" in lab.fails("record", "--resume", "latest")


def test_an_imported_scan_has_no_plan_to_go_on_with(lab: Console, tiny_files: Path) -> None:
    lab("import", "images", tiny_files / "photos", "--step-deg", "10", "--rig", "sim")
    assert "was not recorded by turnscan record" in lab.fails("record", "--resume", "latest")


def test_the_same_seed_gives_the_same_points(lab: Console) -> None:
    rows = [lab.json("record") for _ in range(2)]
    archive = archive_of(lab)
    one, two = (points_of(archive, [r["scan"]]) for r in rows)
    assert one.equals(two)
    assert np.isfinite(one["x_mm"].to_numpy()).all()
