"""After a certification: what changed is derived again and only that; old results stay."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import cv2
import polars as pl
import pytest
from console import Console, Inside, every_file, surroundings, write_frames, write_json

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.process.pipeline import derive
from turnscan.schemas.calibration import parse_calibration
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive

SCANS = 24


def recalibrated(lab: Console, h: float, name: str = "moved.json") -> str:
    """Add and certify the tiny calibration with another plane; its id."""
    assert lab.archive is not None
    source = min((lab.archive / "calibrations").glob("c-*.json"), key=lambda p: p.stat().st_mtime_ns)
    document = json.loads(source.read_text())
    document["lasers"][0]["distance_mm"] = h
    path = write_json(lab.cwd / name, document)
    return Inside(lab.cwd, lab.archive)("calibration", "add", path, "--certify").stdout.strip()


@pytest.fixture
def lab(tiny_lab: Path, tmp_path: Path) -> Inside:
    shutil.copytree(tiny_lab, tmp_path / "lab")
    return Inside(tmp_path, tmp_path / "lab")


@pytest.fixture
def many(tmp_path: Path, tiny_files: Path) -> Console:
    archive = Archive.init(tmp_path / "lab")
    calibration = parse_calibration((tiny_files / "cal.json").read_bytes(), where="cal.json")
    (image,) = write_frames(tmp_path / "photos", 1).iterdir()
    for i in range(SCANS):
        poses = poses_by_step([image], step_deg=1, start_deg=i)
        import_images(archive, ImportPlan(poses, rig="r1", calibration=calibration))
    assert all(o.derived for o in derive(archive, archive.scans(), BUILT_IN["default"]))
    return Console(tmp_path, archive.root)


def test_two_generations_side_by_side(lab: Inside) -> None:
    (old,) = {r["calibration"] for r in lab.json("query", "SELECT DISTINCT calibration FROM points")}
    before = every_file(lab.cwd / "lab" / "derived")
    new = recalibrated(lab, 150.5)
    (stale,) = lab.json("status")
    assert stale["table"] == "points"
    assert stale["why"] == f"calibration changed: plane/0 ({old} to {new})"
    (did,) = lab.json("process", "--stale")
    assert (did["did"], did["why"]) == ("derived points", stale["why"])
    after = every_file(lab.cwd / "lab" / "derived")
    assert {n: after[n] for n in before} == before, "nothing old was touched"
    assert len(after) == len(before) + 2
    assert lab("process", "--stale").stderr == "no scan to process\n"

    counts = {
        r["calibration"]: r["n"]
        for r in lab.json("query", "SELECT calibration, count(*) AS n FROM points GROUP BY calibration")
    }
    assert counts.keys() == {old, new}
    (one,) = lab.json("query", f"SELECT max(range_mm) AS m FROM points WHERE calibration = '{old}'")
    (two,) = lab.json("query", f"SELECT max(range_mm) AS m FROM points WHERE calibration = '{new}'")
    assert two["m"] / one["m"] == pytest.approx(150.5 / 150, rel=1e-6)
    for choice in (old, new, "recorded", "current"):
        lab("export", "latest", f"{choice}.csv", "--calibration", choice)
    tables = {c: pl.read_csv(lab.cwd / f"{c}.csv") for c in (old, new, "recorded", "current")}
    assert tables["recorded"].equals(tables[old])
    assert tables["current"].equals(tables[new])
    assert tables[old]["calibration"].unique().to_list() == [old]

    told = lab.json("compare", old, new)
    (row,) = told
    assert row["matched"] == counts[old] == counts[new]
    assert row["bias_mm"] == pytest.approx(
        float(tables[new]["range_mm"].mean()) - float(tables[old]["range_mm"].mean()),  # type: ignore[arg-type]
        abs=1e-4,
    )
    for a, b in (("recorded", "current"), (row["first_key"][:16], "k-" + row["second_key"])):
        (same,) = lab.json("compare", a, b)
        assert {k: same[k] for k in ("rms_mm", "p95_mm")} == {k: row[k] for k in ("rms_mm", "p95_mm")}


def test_compare_recipes_with_a_picture(lab: Inside) -> None:
    lab("process", "--recipe", "paper")
    done = lab("compare", "default", "paper", "--picture", "shifts.png")
    assert done.stderr == "wrote shifts.png\n"
    image = cv2.imread(str(lab.cwd / "shifts.png"))
    assert image.shape == (760, 1280, 3)
    # The map is coloured, and so are the curves: most of the right half is paper.
    assert (image[110:660, 70:640].std(axis=2) > 10).mean() > 0.05
    assert 0.005 < (image[110:660, 780:1240].std(axis=2) > 20).mean() < 0.6
    (row,) = lab.json("compare", "default", "paper")
    assert row["matched"] > 0
    assert row["rms_mm"] < 5
    (key,) = lab.json(
        "query", "SELECT recipe FROM derivations WHERE kind = 'points' AND recipe_name = 'paper'"
    )
    assert lab.json("compare", "default", key["recipe"])[0]["rms_mm"] == row["rms_mm"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("recorded", "paper"), "of recorded there are 1, of paper 0"),
        (("recorded", "c-000000"), "no calibration"),
        (("recorded", "nonsense"), "nonsense"),
        (("recorded", "k-0000000000"), "no points table has the key"),
        (("recorded", "current", "nothing"), "nothing"),
        (("recorded", "current", "--picture", "no/such.png"), "cannot write"),
    ],
)
def test_what_cannot_be_compared(lab: Inside, words: tuple[str, ...], says: str) -> None:
    assert says in lab.fails("compare", *words)


def test_scans_without_one_of_the_two_are_counted(many: Console) -> None:
    inside = Inside(many.cwd, many.archive)
    recalibrated(many, 150.5)
    inside("process", "latest")
    done = inside("compare", "recorded", "current", "--json")
    assert f"left out: {SCANS - 1} scans" in done.stderr
    assert len(json.loads(done.stdout)) == 1
    inside("process", "--stale")
    rows = inside.json("compare", "recorded", "current")
    assert (len(rows), rows[-1]["scan"]) == (SCANS + 1, "all")
    assert rows[-1]["matched"] == sum(r["matched"] for r in rows[:-1])


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_killed_again_and_again(many: Console, workers: int) -> None:
    """Each run goes on where the last one was killed; what it published is not derived again."""
    assert many.archive is not None
    recalibrated(many, 150.5)
    derived = many.archive / "derived"
    stripes = every_file(derived / "stripes")
    kills = 0
    for _ in range(3 * SCANS):
        before = every_file(derived / "points")
        process = subprocess.Popen(
            many.command("process", "--stale", "-j", workers),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=many.cwd,
            env=surroundings(),
            start_new_session=True,
        )
        with process:
            while process.poll() is None and len(every_file(derived / "points")) < len(before) + 14:
                time.sleep(0.002)
            if process.poll() is None:
                # The parent alone: its workers must see to their own end.
                process.kill()
                kills += 1
                process.communicate()
                _until_gone(process.pid)
            else:
                _, said = process.communicate()
                assert process.returncode == 0, said
                break
        after = every_file(derived / "points")
        assert {n: after[n] for n in before} == before
    else:
        pytest.fail("it never came to an end")
    assert kills >= 2
    inside = Inside(many.cwd, many.archive)
    assert inside.json("status") == []
    # What a kill left in staging is debris, not damage of anything that was published.
    inside("repair")
    assert inside.json("verify") == []
    assert every_file(derived / "stripes") == stripes
    (row,) = inside.json("query", "SELECT count(*) AS n FROM derivations WHERE kind = 'points'")
    assert row["n"] == 2 * SCANS


def _until_gone(group: int) -> None:
    """Wait for every process of a session that this test started."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)
    os.killpg(group, signal.SIGKILL)
    pytest.fail("workers outlived the process that was killed")
