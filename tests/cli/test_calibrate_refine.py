"""`calibrate refine` as users run it: files of observations, walls as CSV, and what it refuses."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path

import pytest
from console import Inside
from simulated_rig import Noise, Rig

from turnscan.schemas.calibration import parse_calibration
from turnscan.schemas.document import dump_json
from turnscan.schemas.observations import Observations, SeenAt, parse_observations

NOISE = Noise(corner_px=0.1, stripe_px=0.1, camera_views=8, plane_views=8, stripe_rows=8)


def write_csv(path: Path, stripes: tuple[SeenAt, ...], ends: bool = False) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["laser", "angle_deg", "u_px", "v_px", "sigma_px", "end"])
        for k, s in enumerate(stripes):
            for (u, v), sigma in zip(s.stripe.points_px, s.stripe.sigma_px, strict=True):
                out.writerow([0, math.degrees(s.angle_rad), u, v, sigma, k + 1 if ends else ""])


@pytest.fixture(scope="session")
def session_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """rig.json, camera.json and plane.json as three commands leave them, and references as CSV."""
    folder = tmp_path_factory.mktemp("refine")
    rig = Rig(4, NOISE)
    base, seen = rig.sequential()
    base = base.model_copy(update={"turntable": rig.true.turntable})
    (folder / "rig.json").write_bytes(dump_json(base.plain()))
    for name, o in zip(("camera", "plane"), seen, strict=True):
        (folder / f"{name}.json").write_text(o.model_dump_json(exclude_none=True))
    wall = rig.wall(5000.0, 1.5, off_mm=0.4).walls[0]
    write_csv(folder / "wall.csv", wall.stripes)
    sphere = rig.sphere(900.0, 120.0, 0.02)
    write_csv(folder / "sphere.csv", sphere.stripes)
    length = rig.length((800.0, 1300.0), 0.1)
    write_csv(folder / "length.csv", length.ends, ends=True)
    (folder / "length.txt").write_text(f"{length.length_mm}")
    return folder


@pytest.fixture
def console(tmp_path: Path) -> Inside:
    return Inside(tmp_path)


@pytest.fixture
def files(session_files: Path, console: Inside) -> Path:
    shutil.copytree(session_files, console.cwd, dirs_exist_ok=True)
    return console.cwd


REFINE = ("calibrate", "refine", "camera.json", "plane.json", "-c", "rig.json")


def test_refine_end_to_end(console: Inside, files: Path) -> None:
    length = (files / "length.txt").read_text()
    done = console(
        *REFINE,
        *("--wall", "wall.csv:5000.4:1.5", "--sphere", "sphere.csv:120:0.1"),
        *("--length", f"length.csv:{length}:0.1", "-o", "refined.json", "--note", "joint"),
    )
    assert done.stdout.splitlines()[0].split() == ["part", "parameter", "before", "value", "sigma"]
    assert "systematic 1 sigma of a range" in done.stderr
    assert "wall.csv: stated 5000.40 mm" in done.stderr
    assert "the axis was kept as it was" in done.stderr
    document = parse_calibration((files / "refined.json").read_bytes(), where="refined.json")
    assert document.note == "joint"
    assert document.joint is not None
    assert document.joint.order == ("intrinsics", "plane/0")
    assert document.quality is not None
    assert [q.part for q in document.quality] == ["joint"]
    before = parse_calibration((files / "rig.json").read_bytes(), where="rig.json")
    assert document.turntable == before.turntable
    assert document.calibration_id() != before.calibration_id()


def test_json_says_everything(console: Inside, files: Path) -> None:
    shown = json.loads(console(*REFINE, "--wall", "wall.csv:5000.4:1.5", "--json", "--dry-run").stdout)
    assert shown["order"] == ["intrinsics", "plane/0"]
    assert len(shown["covariance"]) == 14
    assert shown["references"][0]["kind"] == "walls"
    assert abs(shown["references"][0]["sigmas"]) < 4
    assert {s["range_mm"] for s in shown["systematic_mm"]["0"]} >= {1000.0, 3000.0}
    assert shown["corner_noise_px"] == pytest.approx(0.1, rel=0.15)
    assert not (files / "refined.json").exists()


def test_a_failed_gate_is_a_failed_command(console: Inside, files: Path) -> None:
    said = console.fails(*REFINE, "--max-rms-px", "0.01", "-o", "bad.json")
    assert "the calibration failed: corner noise is 0.09" in " ".join(said.split())
    document = parse_calibration((files / "bad.json").read_bytes(), where="bad.json")
    assert document.verdict == "failed"


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (("--wall", "wall.csv:5100:1.5"), 1, "wall.csv contradicts the rest"),
        (("--wall", "wall.csv:5000"), 2, "expected FILE.csv:MM:SD_MM"),
        (("--wall", "wall.csv:-1:1"), 2, "expected FILE.csv:MM:SD_MM"),
        (("--wall", "none.csv:5000:1"), 1, "cannot read none.csv"),
        (("--wall", "rig.json:5000:1"), 1, "rig.json: has no column u_px"),
        (("--wall", "length.csv:5000:1"), 1, "holds 2 stripe points, a wall needs 3"),
        (("--length", "wall.csv:500:1"), 1, "a length has two ends, found 5"),
    ],
)
def test_references_that_do_not_do(
    console: Inside, files: Path, words: tuple[str, ...], status: int, message: str
) -> None:
    said = console.fails(*REFINE, *words, "-o", "refined.json", code=status)
    assert message in " ".join(said.split())
    assert not (files / "refined.json").exists(), "nothing is written"


def test_files_that_are_something_else(console: Inside, files: Path) -> None:
    said = console.fails("calibrate", "refine", "rig.json", "-c", "rig.json")
    assert "rig.json: format is 'turnscan.calibration', expected 'turnscan.observations'" in " ".join(
        said.split()
    )
    said = console.fails("calibrate", "refine", "gone.json", "-c", "rig.json")
    assert "cannot read gone.json" in " ".join(said.split())
    (files / "bad.csv").write_text("u_px,v_px\n1,two\n")
    said = console.fails(*REFINE, "--wall", "bad.csv:5000:1")
    assert "bad.csv, line 2: not numbers" in " ".join(said.split())
    (files / "empty.csv").write_text("u_px,v_px\n")
    said = console.fails(*REFINE, "--wall", "empty.csv:5000:1")
    assert "empty.csv: holds no stripe points" in " ".join(said.split())


@pytest.mark.slow
def test_real_photographs_all_commands(console: Inside, test_data: Path) -> None:
    """Camera and plane of a real rig save what they used, and the adjustment reads it."""
    data = test_data / "srv_turntable"
    board = ("--pattern", "8x6", "--square-mm", "40")
    names = (22, 28, 33, 47, 92, 100, 109, 164, 180)
    images = [str(data / "camera_calibration" / f"Image{n}.jpg") for n in names]
    console("calibrate", "camera", *images, *board, "-o", "cam.json", "--observations", "cam-seen.json")
    plane = console.run(
        *("calibrate", "plane", str(data / "laser_calibration"), *board, "-c", "cam.json"),
        *("-o", "rig.json", "--observations", "plane-seen.json"),
    )
    assert (console.cwd / "rig.json").exists(), plane.stderr
    seen: Observations = parse_observations(
        (console.cwd / "plane-seen.json").read_bytes(), where="plane-seen.json"
    )
    assert seen.boards
    assert all(b.stripes for b in seen.boards)
    assert all(i.sha256 for i in seen.inputs)
    done = console.run(
        *("calibrate", "refine", "cam-seen.json", "plane-seen.json", "-c", "rig.json", "--json"),
        *("-o", "refined.json"),
    )
    shown = json.loads(done.stdout)
    f = next(p for p in shown["parameters"] if p["parameter"] == "fx_px")
    assert abs(f["value"] - 620.27) < 3 * math.hypot(f["sigma"], 3.0)
    document = parse_calibration((console.cwd / "refined.json").read_bytes(), where="refined.json")
    assert document.joint is not None
