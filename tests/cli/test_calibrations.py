"""Calibrations over time at the command line: refused, forced, withdrawn, compared, checked."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from console import Inside, every_file, write_json

FAILED = [
    {
        "part": "intrinsics",
        "gates": [
            {
                "name": "rms",
                "value": 0.8,
                "limit": 0.5,
                "unit": "px",
                "sense": "at most",
                "passed": False,
            }
        ],
    }
]


@pytest.fixture
def lab(tiny_lab: Path, tmp_path: Path) -> Inside:
    shutil.copytree(tiny_lab, tmp_path / "lab")
    return Inside(tmp_path, tmp_path / "lab")


@pytest.fixture
def recorded(lab: Inside) -> str:
    (row,) = lab.json("calibration", "list")
    return str(row["calibration"])


def write(lab: Inside, name: str, h: float, **more: Any) -> Path:
    (known,) = (lab.cwd / "lab" / "calibrations").glob("c-*.json") if not more.get("base") else ()
    document = json.loads(known.read_text())
    document["lasers"][0]["distance_mm"] = h
    return write_json(lab.cwd / name, document | more)


@pytest.fixture
def moved(lab: Inside) -> str:
    return lab("calibration", "add", write(lab, "moved.json", 150.5)).stdout.strip()


def test_a_failed_calibration_is_kept_but_not_certified(lab: Inside) -> None:
    path = write(lab, "failed.json", 151.0, quality=FAILED)
    events = every_file(lab.cwd / "lab" / "events")
    said = lab.run("calibration", "add", path, "--certify")
    assert said.returncode == 1
    assert "warning: failed: intrinsics: rms is 0.8 px, limit at most 0.5 px" in said.stderr
    assert "is not certified for rig 'r1'" in said.stderr
    name = said.stdout.strip()
    verdicts = {r["calibration"]: r["verdict"] for r in lab.json("calibration", "list")}
    assert verdicts[name] == "failed"
    assert "limit at most" in lab.fails("calibration", "certify", name)
    assert every_file(lab.cwd / "lab" / "events") == events
    assert lab.json("status") == []

    assert "needs --reason" in lab.fails("calibration", "certify", name, "--force", code=2)
    assert "goes with --force" in lab.fails("calibration", "certify", name, "--reason", "x", code=2)
    done = lab("calibration", "certify", name, "--force", "--reason", "no better one")
    assert "warning: forced, although it failed an acceptance limit" in done.stderr
    (row,) = (r for r in lab.json("calibration", "list") if r["calibration"] == name)
    (entry,) = row["certifications"]
    assert entry["reason"] == "no better one"
    assert "rms is 0.8 px" in entry["objections"][0]
    assert "holds, forced" in lab("calibration", "list").stdout


def test_a_misspelt_rig_leaves_nothing_behind(lab: Inside, recorded: str) -> None:
    before = every_file(lab.cwd / "lab")
    path = write(lab, "moved.json", 150.5)
    for words in (
        ("calibration", "add", path, "--certify", "--rig", "r-one"),
        ("calibration", "certify", recorded, "--rig", "r-one"),
    ):
        assert "knows no rig 'r-one' (it knows r1)" in lab.fails(*words)
    assert "--force goes with --certify" in lab.fails(
        "calibration", "add", path, "--force", "--reason", "x", code=2
    )
    assert every_file(lab.cwd / "lab") == before


def test_consequences_are_told_in_scans_and_mm(lab: Inside, recorded: str, moved: str) -> None:
    before = every_file(lab.cwd / "lab")
    dry = lab("calibration", "certify", moved, "--dry-run").stderr
    assert every_file(lab.cwd / "lab") == before
    assert f"1 scan from {recorded} to {moved}: first; the stripe's points move " in dry
    # Of a plane at 150 mm that moved by 0.5 mm: 1/300 of the range.
    assert dry.strip().endswith("move 0.667 mm at 0.2 m")
    done = lab("calibration", "certify", moved).stderr
    assert dry.splitlines() == done.splitlines()[:-1]
    assert "is certified so already" in lab("calibration", "certify", moved).stderr
    again = lab("calibration", "certify", recorded, "--from", "2020-01-01").stderr
    assert f"warning: overlaps {moved}, certified for all time" in again
    assert f"1 scan from {moved} to {recorded}: first" in again
    back = lab("calibration", "withdraw", recorded).stderr
    assert f"1 scan from {recorded} to {moved}: first" in back
    assert "is not certified" in lab.fails("calibration", "withdraw", recorded)


def test_a_calibration_that_lacks_parts_says_what_scans_will_miss(lab: Inside) -> None:
    paths = [
        write(lab, "camera.json", 150.5, lasers=[], turntable=None),
        write(lab, "bare.json", 150.5, turntable=None),
        write(lab, "moved.json", 150.5),
    ]
    name, bare, moved = (lab("calibration", "add", path).stdout.strip() for path in paths)
    events = every_file(lab.cwd / "lab" / "events")
    said = lab("calibration", "certify", name, "--dry-run").stderr
    assert "no laser's plane and no turntable axis: no points can be made of a scan" in said
    assert every_file(lab.cwd / "lab" / "events") == events
    told = lab.run("calibration", "diff", moved, bare)
    assert "shifts are in camera space" in told.stderr
    assert lab.json("calibration", "diff", moved, bare)["space"] == "camera"


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("2026-05-01", 1777593600_000_000_000),
        ("2026-05-01T12:00", 1777636800_000_000_000),
        ("2026-05-01T12:00:00.000001Z", 1777636800_000_001_000),
        ("2026-05-01T14:00+02:00", 1777636800_000_000_000),
        ("1777636800000000001", 1777636800_000_000_001),
    ],
)
def test_times_in_the_users_words(lab: Inside, recorded: str, text: str, t_ns: int) -> None:
    lab("calibration", "certify", recorded, "--from", text)
    (row,) = lab.json("calibration", "list")
    assert row["certifications"][0]["from_ns"] == t_ns


@pytest.mark.parametrize("text", ["1969-12-31", "2300-01-01", "9" * 30])
def test_times_that_no_clock_of_ours_shows(lab: Inside, recorded: str, text: str) -> None:
    assert "1970 to 2262" in lab.fails("calibration", "certify", recorded, "--from", text, code=2)


def test_the_timeline(lab: Inside, recorded: str, moved: str) -> None:
    lab("calibration", "certify", recorded, "--from", "2026-01-01", "--to", "2027-01-01")
    lab("calibration", "certify", moved, "--from", "2026-04-01", "--to", "2026-06-01")
    lab("calibration", "certify", moved, "--from", "2026-08-01")
    lab("calibration", "withdraw", recorded, "--note", "the camera was touched")
    shown = lab("calibration", "list", "--picture", "timeline.png").stdout.splitlines()
    at = next(i for i, line in enumerate(shown) if line.startswith("rig r1: "))
    first, second, third = shown[at + 1 : at + 4]
    assert "xxxx" in first
    assert "withdrawn" in first
    assert second.count("=") < third.count("=")
    assert third.rstrip().endswith("holds")
    assert ">" in third
    assert shown[at + 4].strip().startswith("scans")
    drawn = cv2.imread(str(lab.cwd / "timeline.png"))
    assert drawn.shape[1] == 1200
    # Right of the axis (960 px), below its dates: the arrow of the third certification, without an end.
    tips = (drawn[46:, 964] < 250).any(axis=1)
    assert (np.diff(tips.astype(int)) == 1).sum() == 1
    assert 60 <= np.flatnonzero(tips).min() < 90
    rows = {r["calibration"]: r for r in lab.json("calibration", "list")}
    (entry,) = rows[recorded]["certifications"]
    assert (entry["state"], entry["withdrawn_note"]) == ("withdrawn", "the camera was touched")
    assert entry["effective"] == []
    assert rows[recorded]["certified"] is None
    lab.fails("calibration", "list", "--picture", "no/such/folder.png")


def test_diff_in_sigmas_and_mm(lab: Inside, recorded: str, moved: str) -> None:
    told = lab.json("calibration", "diff", recorded, moved, "--at-m", "0.5", "--at-m", "1")
    (row,) = told["parameters"]
    assert (row["part"], row["parameter"]) == ("plane/0", "distance_mm")
    assert row["difference"] == pytest.approx(0.5)
    assert row["sigmas"] is None
    for shift in told["shifts"]:
        if shift["points"]:
            assert shift["rms_mm"] == pytest.approx(shift["at_m"] * 1000 * 0.5 / 150, rel=1e-6)
    assert {p["part"]: p["same"] for p in told["parts"]} == {
        "intrinsics": True,
        "plane/0": False,
        "axis": True,
    }
    assert "a covariance is missing" in lab("calibration", "diff", recorded, moved).stderr
    assert "all parts are the same" in lab("calibration", "diff", recorded, recorded).stderr
    assert "above 0" in lab.fails("calibration", "diff", recorded, moved, "--at-m", "-1", code=2)
    table = lab("calibration", "diff", recorded, moved, "--format", "csv").stdout
    assert table.startswith("part,parameter,first,second,difference,sigma,sigmas\n")


def test_check_needs_something_to_compare(lab: Inside) -> None:
    assert "no angle is seen twice" in lab.fails("calibration", "check", "latest")
    assert "expected X,Y,Z" in lab.fails("calibration", "check", "latest", "--target", "1,2", code=2)
    said = lab.fails("calibration", "check", "latest", "--target", "9000,0,0")
    assert "no surface at any target" in said


def test_check_against_recorded_targets(lab: Inside) -> None:
    points = lab.json("query", "SELECT x_mm, y_mm, z_mm FROM points ORDER BY frame, row")
    x, y, z = (points[len(points) // 2][n] for n in ("x_mm", "y_mm", "z_mm"))
    given = (f"x_mm={x}", f"y_mm={y}", f"z_mm={z}", "sd_mm=0.5", "within_mm=8", "name=post")
    lab("scan", "reference", "latest", "target", *given)
    told = lab.json("calibration", "check", "latest")
    (check,) = told["checks"]
    assert (check["check"], check["fits"], told["fits"]) == ("target post", True, True)
    # The same place measured 4 mm further out: the calibration does not fit any more.
    length = (x * x + y * y + z * z) ** 0.5
    far = ",".join(str(c * (1 + 4 / length)) for c in (x, y, z))
    said = lab.run("calibration", "check", "latest", "--target", f"{far},0.2")
    assert said.returncode == 1
    assert "does not fit scan" in said.stderr
    assert "hint: calibrate the rig again" in said.stderr
    assert "needs z_mm" in lab.fails(
        "scan", "reference", "latest", "target", "x_mm=1", "y_mm=2", code=2
    )
    assert "finite" in lab.fails("scan", "reference", "latest", "disc", "d_mm=nan", code=2)
