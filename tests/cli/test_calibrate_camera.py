"""`calibrate camera` and `calibrate import` as users run them, on real photographs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from console import Console, Inside

from turnscan.schemas.calibration import parse_calibration

SRV = ("--pattern", "8x6", "--square-mm", "40")


@pytest.fixture
def inside(tmp_path: Path) -> Inside:
    return Inside(tmp_path)


@pytest.fixture
def boards(test_data: Path, tmp_path: Path) -> Path:
    """Nine of the real images: far and near, tilted each way."""
    folder = tmp_path / "boards"
    folder.mkdir()
    for number in (22, 28, 33, 47, 92, 100, 109, 164, 180):
        shutil.copy(test_data / "srv_turntable" / "camera_calibration" / f"Image{number}.jpg", folder)
    return folder


def test_camera_end_to_end(console: Console, boards: Path) -> None:
    done = console(
        *(
            "calibrate",
            "camera",
            boards,
            *SRV,
            "-o",
            "cal.json",
            "--rig",
            "srv",
            "--note",
            "nine views",
        ),
        *("--picture", "cal.png", "--corners", "corners.csv"),
    )
    assert done.stdout.splitlines()[0].split() == ["parameter", "value", "sigma"]
    assert "all 6 gates passed" in done.stderr
    document = parse_calibration((console.cwd / "cal.json").read_bytes(), where="cal.json")
    assert document.rig == "srv"
    assert document.camera is not None
    assert document.camera.covariance is not None
    assert abs(document.camera.fx_px - 620.27) < 3 * document.camera.covariance[0][0] ** 0.5
    assert document.verdict == "passed"
    assert document.quality is not None
    assert len(document.quality[0].inputs) == 9
    assert all(i.sha256 for i in document.quality[0].inputs)
    image = cv2.imread(str(console.cwd / "cal.png"))
    assert image is not None
    assert image.shape[1] == 1500
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    lines = (console.cwd / "corners.csv").read_text().splitlines()
    assert lines[0] == "view,corner,u_px,v_px,residual_u_px,residual_v_px"
    assert len(lines) == 1 + 9 * 48


def test_json_holds_everything(inside: Inside, boards: Path) -> None:
    value = inside.json(
        "calibrate", "camera", boards, *SRV, "--skew", "--weights", "by-view", "--dry-run"
    )
    assert [p["parameter"] for p in value["parameters"]][:5] == [
        "fx_px",
        "fy_px",
        "cx_px",
        "cy_px",
        "skew",
    ]
    assert all(p["sigma"] > 0 for p in value["parameters"])
    assert np.array(value["covariance"]).shape == (10, 10)
    assert len(value["views"]) == 9
    for view in value["views"]:
        off = np.array(view["residuals_px"])[:, 3:]
        assert np.sqrt((off**2).sum(axis=1).mean()) == pytest.approx(view["rms_px"], abs=1e-3)
    assert value["verdict"] == "passed"
    assert not list(inside.cwd.glob("*.json"))


def test_a_failed_gate_is_stored_as_failed_and_exits_with_1(inside: Inside, boards: Path) -> None:
    said = inside.fails("calibrate", "camera", boards, *SRV, "-o", "cal.json", "--max-rms-px", "0.01")
    assert "the calibration failed: rms is" in said
    assert "kept as failed in cal.json" in said
    document = parse_calibration((inside.cwd / "cal.json").read_bytes(), where="cal.json")
    assert document.verdict == "failed"
    assert [g.name for _, g in document.failed_gates()] == ["rms"]


def test_awkward_images_are_told_and_left_out(inside: Inside, boards: Path, test_data: Path) -> None:
    laser = test_data / "srv_turntable" / "laser_calibration"
    for name in ("Image45.jpg", "Image131.jpg"):
        shutil.copy(laser / name, boards / f"laser{name}")
    whole = (boards / "Image22.jpg").read_bytes()
    (boards / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    cv2.imwrite(str(boards / "empty.png"), np.full((480, 640), 90, np.uint8))
    done = inside("calibrate", "camera", boards, *SRV, "-o", "cal.json")
    assert "left out laserImage45.jpg: the board is cut by the image border" in done.stderr
    assert "left out laserImage131.jpg: blurred" in done.stderr
    assert "left out cut.jpg: " in done.stderr
    assert "left out empty.png: nothing in it" in done.stderr
    document = parse_calibration((inside.cwd / "cal.json").read_bytes(), where="cal.json")
    assert document.quality is not None
    assert {item.what for item in document.quality[0].left_out} == {
        "laserImage45.jpg",
        "laserImage131.jpg",
        "cut.jpg",
        "empty.png",
    }
    assert len(document.quality[0].inputs) == 9


def test_frames_of_a_scan_are_images(inside: Inside, boards: Path) -> None:
    inside("init", "lab")
    inside.archive = inside.cwd / "lab"
    inside("import", "images", boards, "--step-deg", "1", "--label", "boards")
    value = inside.json("calibrate", "camera", "--scan", "boards", *SRV, "--dry-run")
    files = inside.json("calibrate", "camera", boards, *SRV, "--dry-run")
    assert value["parameters"] == files["parameters"]
    assert "frame 0" in value["views"][0]["view"]
    every = inside.json("calibrate", "camera", "--scan", "boards", "--every", "2", *SRV, "--dry-run")
    assert len(every["views"]) == 5


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        ((), 2, "no images given"),
        (("nowhere", *SRV), 1, "nowhere"),
        (("boards",), 2, "the board is not described"),
        (("boards", "--pattern", "8by6", "--square-mm", "40"), 2, "expected COLSxROWS"),
        (("boards", "--pattern", "8x2", "--square-mm", "40"), 2, "needs 3 at least"),
        (("boards", "--pattern", "8x6", "--square-mm", "-4"), 2, "expected a length"),
        (("boards", "--pattern", "8x6", "--square-mm", "1.2.3"), 2, "expected a length"),
        (("boards", *SRV, "--board", "charuco"), 2, "needs marker_mm and dictionary"),
        (("boards", *SRV, "--marker-mm", "3"), 2, "belong to charuco"),
        (("boards", "--pattern", "7x4", "--square-mm", "40"), 1, "8x6 inner corners is seen"),
        (("boards", *SRV, "-o", "missing/cal.json"), 1, "there is no folder"),
        (("boards", *SRV, "-o", "boards"), 1, "is a folder"),
        (("--scan", "latest", *SRV), 1, "archive"),
    ],
)
def test_bad_calls(words: tuple[str, ...], code: int, text: str, inside: Inside, boards: Path) -> None:
    said = inside.fails("calibrate", "camera", *(words or SRV), code=code)
    assert text in said
    assert not list(inside.cwd.glob("*.json"))


def test_too_few_and_mixed_sizes_write_nothing(inside: Inside, boards: Path) -> None:
    two = [boards / "Image22.jpg", boards / "Image28.jpg"]
    said = inside.fails("calibrate", "camera", *two, *SRV, "-o", "cal.json")
    assert "2 views of the board are too few" in said
    image = cv2.imread(str(boards / "Image33.jpg"))
    assert image is not None
    cv2.imwrite(str(boards / "large.png"), cv2.resize(image, None, fx=1.5, fy=1.5))
    said = inside.fails("calibrate", "camera", boards, *SRV, "-o", "cal.json")
    assert "images of 2 sizes" in said
    assert "large.png" in said
    assert not (inside.cwd / "cal.json").exists()


def test_nothing_is_replaced_unasked(inside: Inside, boards: Path) -> None:
    (inside.cwd / "cal.json").write_text("mine")
    said = inside.fails("calibrate", "camera", boards, *SRV, "-o", "cal.json")
    assert "exists already" in said
    assert (inside.cwd / "cal.json").read_text() == "mine"
    inside("calibrate", "camera", boards, *SRV, "-o", "cal.json", "--overwrite")
    assert (inside.cwd / "cal.json").read_text() != "mine"


def test_import_end_to_end(inside: Inside, test_data: Path) -> None:
    source = test_data / "srv_turntable" / "calibration4.yaml"
    value = inside.json("calibrate", "import", source, "--size-px", "640x480", "-o", "cal.json")
    assert value["verdict"] == "not judged"
    document = parse_calibration((inside.cwd / "cal.json").read_bytes(), where="cal.json")
    assert document.camera is not None
    assert document.camera.fx_px == pytest.approx(620.2678375549896)
    inside.fails("calibrate", "import", source, "-o", "other.json")
    inside.fails("calibrate", "import", source, "--size-px", "640", code=2)
    inside.fails("calibrate", "import", "nowhere.mat")
    inside.fails("calibrate", "import", test_data / "srv_turntable" / "table" / "TableCalib.jpg")
    assert [p.name for p in inside.cwd.glob("*.json")] == ["cal.json"]


def test_a_calibration_goes_into_the_archive_with_its_verdict(inside: Inside, boards: Path) -> None:
    inside("init", "lab")
    inside("calibrate", "camera", boards, *SRV, "-o", "cal.json", "--rig", "srv")
    inside.archive = inside.cwd / "lab"
    inside("calibration", "add", "cal.json")
    (row,) = inside.json("calibration", "list")
    assert row["calibration"] == json.loads(json.dumps(row["calibration"]))
    assert "passed" in json.dumps(row)
