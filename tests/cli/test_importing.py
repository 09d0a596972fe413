"""``turnscan import mcap`` and ``import video`` as users type them: to a cloud, dry, and refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from console import Console, Inside

T0 = 1_700_000_000 * 10**9


@pytest.fixture
def run(tmp_path: Path) -> Inside:
    inside = Inside(tmp_path)
    inside("init", "lab")
    inside.archive = tmp_path / "lab"
    return inside


@pytest.fixture
def recordings() -> ModuleType:
    """The writer of recordings that the tests of ingest have."""
    root = str(Path(__file__).parents[2])
    if root not in sys.path:
        sys.path.insert(0, root)
    from tests.ingest import recordings

    return recordings


def points(run: Inside, scan: str) -> str:
    """All points of a scan as CSV."""
    columns = "frame, laser, row, angle_rad, u_px, x_mm, y_mm, z_mm"
    sql = f"SELECT {columns} FROM points WHERE scan = '{scan}' ORDER BY frame, laser, row"
    return run("query", sql, "--format", "csv").stdout


def record(recordings: ModuleType, path: Path, photos: Path, *, stop_after: int | None = None) -> Path:
    """PNG photographs and joint states of a table that turns 10 degrees a frame."""
    from tests.ingest.messages import cdr_writer as cdr

    rec = recordings.Recording(path, chunk_bytes=1000)
    for i, photo in enumerate(sorted(photos.iterdir())[:stop_after]):
        t_ns = T0 + i * 10**8
        joint = cdr.joints(t_ns, {"table": np.radians(10.0 * i)})
        rec.ros("/joint_states", "sensor_msgs/msg/JointState", t_ns, joint)
        image = cdr.compressed(t_ns, "png", photo.read_bytes())
        rec.ros("/camera/compressed", "sensor_msgs/msg/CompressedImage", t_ns, image)
    return rec.close()


def test_a_recording_gives_the_same_points_as_its_images(
    run: Inside, recordings: ModuleType, tiny_files: Path, tmp_path: Path
) -> None:
    bag = record(recordings, tmp_path / "bag.mcap", tiny_files / "photos")
    cal = tiny_files / "cal.json"
    images = run.json(
        "import", "images", tiny_files / "photos", "--step-deg", "10", "-c", cal, "--label", "one"
    )
    # Angle, lasers and bytes are the same, so it is known for the same content.
    assert "are scan " + images["scan"] in run.fails("import", "mcap", bag, "-c", cal)
    again = run.json("import", "mcap", bag, "-c", cal, "--again", "--label", "two", "--tag", "a=b")
    assert {k: again[k] for k in ("rig", "frames", "size_px", "calibration")} == {
        k: images[k] for k in ("rig", "frames", "size_px", "calibration")
    }
    run("process")
    one, two = points(run, images["scan"]), points(run, again["scan"])
    assert one.count("\n") > 50
    assert one == two


def test_a_dry_run_writes_nothing(
    run: Inside, recordings: ModuleType, tiny_files: Path, tmp_path: Path
) -> None:
    bag = record(recordings, tmp_path / "bag.mcap", tiny_files / "photos")
    shown = run.json("import", "mcap", bag, "--dry-run")
    assert shown["images"] == "/camera/compressed"
    assert shown["angles"] == "/joint_states"
    assert (shown["frames"], shown["angle_events"], shown["size_px"]) == (3, 3, "64x48")
    assert abs(shown["angle_to_deg"] - 20) < 1e-9
    assert shown["times"] == "header stamps of the messages"
    assert run.json("scan", "list") == []
    assert "would import 3 frames" in run("import", "mcap", bag, "--dry-run").stderr


def test_mcap_errors_are_one_line_with_a_way_out(
    run: Inside, recordings: ModuleType, tiny_files: Path, tmp_path: Path
) -> None:
    bag = record(recordings, tmp_path / "bag.mcap", tiny_files / "photos")
    assert "/camera/compressed (3 x" in run.fails("import", "mcap", bag, "--image-topic", "/camera")
    run.fails("import", "mcap", bag, "--angle-field", "effort.0", "--angle-topic", "/joint_states")
    run.fails("import", "mcap", "none.mcap")
    run.fails("import", "mcap", tiny_files / "cal.json")
    run.fails("import", "mcap", bag, "--mode", "sideways", code=2)
    data = bag.read_bytes()
    (tmp_path / "bad.mcap").write_bytes(data[:3000] + bytes([data[3000] ^ 1]) + data[3001:])
    assert "damaged at byte" in run.fails("import", "mcap", "bad.mcap")
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 7 // 10])
    done = run("import", "mcap", "cut.mcap", "--json")
    assert "note: the recording is cut off" in done.stderr
    scan = json.loads(done.stdout)["scan"]
    assert run.json("scan", "show", scan)["ended"] == "interrupted"


def video(path: Path, photos: Path, *, turns: int = 1) -> Path:
    size = (64, 48)
    options = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10.0, size, options
    )
    for photo in sorted(photos.iterdir()) * turns:
        writer.write(cv2.imread(str(photo), cv2.IMREAD_UNCHANGED))
    writer.release()
    return path


def test_a_video_gives_the_same_points_as_its_images(
    run: Inside, tiny_files: Path, tmp_path: Path
) -> None:
    cal = tiny_files / "cal.json"
    path = video(tmp_path / "turn.mkv", tiny_files / "photos")
    common = ("--step-deg", "10", "-c", cal)
    images = run.json("import", "images", tiny_files / "photos", *common, "--label", "one")
    shown = run.json("import", "video", path, *common, "--label", "two")
    assert (shown["frames"], shown["size_px"], shown["rig"]) == (3, "64x48", "r1")
    run("process")
    one, two = points(run, images["scan"]), points(run, shown["scan"])
    assert one.count("\n") > 50
    assert one == two


def test_video_words(run: Inside, tiny_files: Path, tmp_path: Path) -> None:
    path = video(tmp_path / "turn.mkv", tiny_files / "photos")
    run.fails("import", "video", path, code=2)
    run.fails("import", "video", path, "--step-deg", "1", "--angles", "a.csv", code=2)
    run.fails("import", "video", "none.mkv", "--step-deg", "1")
    (tmp_path / "a.csv").write_text("frame,angle_deg\n0,0\n1,5\n")
    assert "has 2 rows" in run.fails("import", "video", path, "--angles", "a.csv")
    (tmp_path / "a.csv").write_text("frame,angle_deg\n0,0\n1,5\n2,15\n")
    shown = run.json("import", "video", path, "--angles", "a.csv", "--dry-run")
    assert (shown["frames"], shown["angle_to_deg"], shown["codec"]) == (3, 15.0, "ffv1")
    assert run.json("scan", "list") == []
    run("import", "video", path, "--angles", "a.csv", "--laser", "2")
    path = video(tmp_path / "turns.mkv", tiny_files / "photos", turns=4)
    path.write_bytes(path.read_bytes()[:-3000])
    assert "note: the video is cut off" in run("import", "video", path, "--step-deg", "1").stderr


def test_ffmpeg_says_nothing_beside_us(tiny_files: Path, tmp_path: Path) -> None:
    """In a process of its own, since its words come from C."""
    console = Console(tmp_path)
    console("init", "lab")
    console.archive = tmp_path / "lab"
    path = video(tmp_path / "turn.mkv", tiny_files / "photos", turns=4)
    path.write_bytes(path.read_bytes()[:-3000])
    done = console("import", "video", path, "--step-deg", "1", "--json")
    assert [line.split()[0] for line in done.stderr.splitlines()] == ["note:", "sealed"]
    (tmp_path / "no.mp4").write_bytes(b"\0\0\0\x18ftypisom" + bytes(2000))
    error = console.fails("import", "video", "no.mp4", "--step-deg", "1")
    assert len(error.splitlines()) == 2
