"""The chain by commands alone: rendered boards, camera, plane, axis, scan, ranges against truth."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from console import Console, Inside

from turnscan.schemas.calibration import parse_calibration

sys.path.append(str(Path(__file__).parents[1] / "process" / "calibrate"))
from rendered_chain import ANGLE_SD_DEG, RenderedRig, nearer

BOARD = ("--pattern", "9x6", "--square-mm", "30")
SEED = 3


@pytest.fixture
def console(tmp_path: Path) -> Console:
    return Inside(tmp_path)


def write(folder: Path, name: str, image: np.ndarray) -> None:
    folder.mkdir(exist_ok=True)
    assert cv2.imwrite(str(folder / name), image)


def write_angles(path: Path, rows: list[tuple[str, float]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("file", "angle_deg"), *rows])


def test_from_boards_to_ranges_by_commands_alone(console: Console, tmp_path: Path) -> None:
    rig = RenderedRig(SEED)
    for name, image in rig.camera_frames():
        write(tmp_path / "boards", name, image)
    for name, image in rig.plane_frames():
        write(tmp_path / "stripes", name, image)
    turned = []
    for name, angle, image in rig.axis_frames():
        write(tmp_path / "turned", name, image)
        turned.append((name, angle))
    write_angles(tmp_path / "turned.csv", turned)
    truth: dict[tuple[int, int], tuple[float, float]] = {}
    angles = []
    for i, (angle, image, true) in enumerate(rig.scan_frames()):
        write(tmp_path / "room", f"room{i:02d}.png", image)
        angles.append((f"room{i:02d}.png", math.degrees(angle)))
        rows, counts = np.unique(true.row, return_counts=True)
        single = set(rows[counts == 1].tolist())
        for row, u, mm in zip(true.row.tolist(), true.u_px, true.range_mm, strict=True):
            if row in single:
                truth[i, row] = (u, mm)
    write_angles(tmp_path / "room.csv", angles)

    console("calibrate", "camera", "boards", *BOARD, "-o", "a.json", "--rig", "chain")
    console("calibrate", "plane", "stripes", *BOARD, "-c", "a.json", "-o", "b.json")
    console("init", "lab")
    console.archive = tmp_path / "lab"
    console("import", "images", "turned", "--angles", "turned.csv", "--label", "turned")
    axis = ("calibrate", "axis", *BOARD, "-c", "b.json", "--head", "rotates", "--min-span-deg", "20",
            "--angle-sd-deg", str(ANGLE_SD_DEG))  # fmt: skip
    found = console.json(*axis, "--scan", "turned", "-o", "c.json")
    files = console.json(*axis, "turned", "--angles", "turned.csv", "--dry-run")
    assert found["parameters"] == files["parameters"]
    assert "frame 0" in found["frames"][0]["frame"]
    few = console.json(*axis, "--scan", "turned", "--every", "2", "--dry-run", "--min-frames", "3")
    assert len(few["frames"]) == 6

    document = parse_calibration((tmp_path / "c.json").read_bytes(), where="c.json")
    assert document.verdict == "passed"
    assert document.joint is not None
    assert document.joint.order == ("intrinsics", "plane/0", "axis")
    assert all(share < 0.9999 for share in nearer(document, rig.true).values())

    console("import", "images", "room", "--angles", "room.csv", "--calibration", "c.json")
    (tmp_path / "shares.toml").write_text(
        'format = "turnscan.recipe"\nversion = 1\nname = "shares"\n[[stages]]\nstage = "extract"\n'
        '[[stages]]\nstage = "undistort"\n[[stages]]\nstage = "triangulate"\nsigma = "systematic"\n'
    )
    console("process", "latest", "--recipe", "shares.toml")
    table = console.json(
        "query", "SELECT frame, row, u_px, range_mm, sigma_range_mm FROM points ORDER BY frame, row"
    )
    off = []
    for point in table:
        u, mm = truth.get((point["frame"], point["row"]), (np.nan, np.nan))
        if abs(point["u_px"] - u) < 0.5:
            off.append((mm, point["range_mm"] - mm, point["sigma_range_mm"]))
    mm, error, sigma = np.array(off).T
    assert len(mm) > 3000
    for low, high in ((1500.0, 2500.0), (2500.0, 4000.0), (4000.0, 6000.0)):
        mine = (mm > low) & (mm < high)
        assert mine.sum() > 200
        # Points of one range share nearly all of their systematic error.
        assert abs(float(np.median(error[mine]))) < 3.0 * float(np.median(sigma[mine])), (low, high)
        assert float(np.median(sigma[mine])) < 1.5e-6 * high**2


def test_a_scan_brings_its_own_angles(console: Console, tmp_path: Path) -> None:
    image = np.full((480, 640), 90, np.uint8)
    for i in range(3):
        write(tmp_path / "turned", f"t{i}.png", image)
    axis = ("calibrate", "axis", *BOARD, "-c", "a.json", "-o", "out.json")
    assert "takes them from a scan" in console.fails(*axis, "turned", code=2)
    said = console.fails(*axis, "turned", "--scan", "latest", code=2)
    assert "images and --scan exclude each other" in said
    said = console.fails(*axis, "--scan", "latest", "--step-deg", "10", code=2)
    assert "a scan's log holds its angles" in said
    assert not (tmp_path / "out.json").exists()
