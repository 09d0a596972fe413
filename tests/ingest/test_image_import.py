"""Image files become a sealed scan: what the log then says, and what is left when it cannot be."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.image_sources import find_images
from turnscan.ingest.poses import Pose, poses_by_step, poses_from_csv
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane
from turnscan.schemas.errors import CalibrationError, ConflictError, InputError
from turnscan.schemas.events import (
    CalibrationSnapshot,
    Exposure,
    LaserState,
    LogLine,
    ScanEnd,
    ScanStart,
    TurntableAngle,
)
from turnscan.store import Archive
from turnscan.store.bytes import STAGING
from turnscan.store.verify import verify

from .images import encoded, frames, oriented, pixels, run_import, write_images


@pytest.fixture
def lab(tmp_path: Path) -> Archive:
    return Archive.init(tmp_path / "lab")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    write_images(tmp_path / "photos", 4)
    return tmp_path / "photos"


def of_kind(items: list[object], kind: type) -> list:
    return [i for i in items if isinstance(i, kind)]


def nothing_is_left(archive: Archive) -> bool:
    folders = [archive.root / "scans", archive.root / STAGING]
    assert all(f.is_dir() for f in folders)
    return not [p for f in folders for p in f.iterdir()] and archive.scans() == []


def camera(width: int = 64, height: int = 48) -> Calibration:
    intrinsics = Intrinsics(width_px=width, height_px=height, fx_px=300, fy_px=300, cx_px=32, cy_px=24)
    plane = LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=150.0)
    return Calibration(rig="r1", camera=intrinsics, lasers=(plane,))


# -- what the log holds ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("suffix", "channels", "dtype"),
    [
        *[(s, c, "uint8") for s in (".png", ".jpg", ".bmp", ".tiff") for c in (1, 3)],
        *[(s, c, "uint16") for s in (".png", ".tiff") for c in (1, 3)],
        (".png", 4, "uint8"),
    ],
)
def test_original_bytes_and_pixels_are_kept(
    lab: Archive, tmp_path: Path, suffix: str, channels: int, dtype: str
) -> None:
    image = pixels(3, channels=channels, dtype=dtype)
    data = encoded(image, suffix)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / f"a{suffix}").write_bytes(data)
    summary, items = run_import(lab, tmp_path / "photos")
    (frame,) = frames(items)
    assert bytes(frame.image.data) == data
    assert frame.image.encoding == {".jpg": "jpeg"}.get(suffix, suffix[1:])
    assert (summary.width_px, summary.height_px) == (64, 48)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(frame.decode(), expected)
    if suffix != ".jpg":
        assert np.array_equal(frame.decode(), image)


def test_orientation_tags_change_nothing(lab: Archive, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    plain = encoded(pixels(channels=3), ".jpg")
    turned = oriented(plain, 6)
    (folder / "a.jpg").write_bytes(plain)
    (folder / "b.jpg").write_bytes(turned)
    summary, items = run_import(lab, folder, calibration=camera())
    one, two = frames(items)
    assert bytes(two.image.data) == turned
    assert two.decode().shape == (48, 64, 3)
    assert np.array_equal(one.decode(), two.decode())
    assert (summary.width_px, summary.height_px) == (64, 48)


def test_events_of_a_plain_scan(lab: Archive, photos: Path) -> None:
    calibration = camera()
    summary, items = run_import(
        lab,
        photos,
        label="bust",
        tags={"owner": "lab2"},
        calibration=calibration,
        started_ns=1_000,
    )
    start = items[0]
    assert isinstance(start, ScanStart)
    assert (start.scan, start.rig, start.label, start.tags) == (
        summary.scan,
        "r1",
        "bust",
        {"owner": "lab2"},
    )
    assert (start.source, start.cameras, start.lasers) == ("imported images", ("0",), (0,))
    (snapshot,) = of_kind(items, CalibrationSnapshot)
    assert snapshot.sha256 == calibration.sha256()
    (remark,) = of_kind(items, LogLine)
    assert remark.message.startswith("imported at t_ns ")
    angles = of_kind(items, TurntableAngle)
    assert [a.commanded_rad for a in angles] == [math.radians(i) for i in range(4)]
    assert all(a.reported_rad is None for a in angles)
    assert [(s.laser, s.on) for s in of_kind(items, LaserState)] == [(0, True)]
    exposures = of_kind(items, Exposure)
    assert [(e.frame, e.file, e.lasers_on) for e in exposures] == [
        (i, f"img{i}.png", (0,)) for i in range(4)
    ]
    end = items[-1]
    assert isinstance(end, ScanEnd)
    assert (end.ended, end.frames) == ("complete", 4)
    assert (summary.label, summary.tags, summary.frames, summary.background_frames) == (
        "bust",
        {"owner": "lab2"},
        4,
        0,
    )
    assert summary.calibration == calibration.calibration_id()
    assert summary.angle_max_rad == math.radians(3)
    assert [(row["scan"], row["label"]) for row in lab.scan_rows()] == [(summary.scan, "bust")]
    assert verify(lab) == []


def test_lasers_and_angles_are_switched_only_when_they_change(lab: Archive, photos: Path) -> None:
    images = find_images([photos])[0]
    given = zip(images, (0.0, 0.0, 2.0, 2.0), ((), (0, 1), (1,), (1, 4)), strict=True)
    summary, items = run_import(lab, [Pose(p, a, on) for p, a, on in given], started_ns=0)
    second = 10**9
    assert [(s.t_ns, s.laser, s.on) for s in of_kind(items, LaserState)] == [
        (second, 0, True),
        (second, 1, True),
        (2 * second, 0, False),
        (3 * second, 4, True),
    ]
    assert [(a.t_ns, a.commanded_rad) for a in of_kind(items, TurntableAngle)] == [
        (0, 0.0),
        (2 * second, math.radians(2.0)),
    ]
    assert summary.background_frames == 1
    assert summary.lasers == (0, 1, 4)
    # Whatever holds for a frame stands before it in the log.
    kinds = [type(i).__name__ for i in items[2:]]
    assert kinds[:3] == ["TurntableAngle", "Exposure", "LogFrame"]
    assert kinds[3:7] == ["LaserState", "LaserState", "Exposure", "LogFrame"]


def test_times_from_the_csv(lab: Archive, photos: Path, tmp_path: Path) -> None:
    table = tmp_path / "angles.csv"
    rows = [f"img{i}.png,{i},{t}" for i, t in enumerate((400, 100, 300, 200))]
    table.write_text("\n".join(["file,angle_deg,t_ns", *rows]))
    poses = poses_from_csv(find_images([photos])[0], table)
    summary, items = run_import(lab, poses, started_ns=77)
    assert [(f.t_ns, f.file) for f in frames(items)] == [
        (100, "img1.png"),
        (200, "img3.png"),
        (300, "img2.png"),
        (400, "img0.png"),
    ]
    assert of_kind(items, ScanStart)[0].time_source == "csv"
    assert (summary.started_ns, summary.ended_ns) == (100, 400)


def test_times_from_the_start_that_was_given(lab: Archive, photos: Path) -> None:
    summary, items = run_import(lab, photos, started_ns=5)
    assert [f.t_ns for f in frames(items)] == [5 + i * 10**9 for i in range(4)]
    assert of_kind(items, ScanStart)[0].time_source == "given, frames a nominal second apart"
    assert (summary.started_ns, summary.ended_ns) == (5, 5 + 3 * 10**9)


@pytest.mark.parametrize("oldest", [1_500_000_000 * 10**9, -5 * 10**9])
def test_times_from_the_oldest_file(lab: Archive, photos: Path, oldest: int) -> None:
    os.utime(photos / "img2.png", ns=(0, oldest))
    summary, items = run_import(lab, photos)
    # Before 1970 there is no time in a log.
    assert summary.started_ns == max(oldest, 0)
    assert of_kind(items, ScanStart)[0].time_source == "oldest file, frames a nominal second apart"


def test_names_that_are_no_utf8_are_kept_readable(lab: Archive, photos: Path) -> None:
    odd = os.fsencode(photos) + b"/k\xfcche.png"
    Path(os.fsdecode(odd)).write_bytes(encoded(pixels(9), ".png"))
    (photos / "\u0443\u0433\u043e\u043b.png").write_bytes(encoded(pixels(10), ".png"))
    _, items = run_import(lab, photos)
    assert {f.file for f in frames(items)} > {"k\\xfcche.png", "\u0443\u0433\u043e\u043b.png"}


def test_progress_counts_every_frame(lab: Archive, photos: Path) -> None:
    seen: list[tuple[int, int]] = []
    poses = poses_by_step(find_images([photos])[0], step_deg=1.0)
    import_images(lab, ImportPlan(poses, rig="r"), lambda done, of: seen.append((done, of)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


# -- the same again -------------------------------------------------------------------------------


def test_the_same_images_are_noticed(lab: Archive, photos: Path, tmp_path: Path) -> None:
    first, _ = run_import(lab, photos)
    before = sorted(p.name for p in (lab.root / "scans").iterdir())
    copy = shutil.copytree(photos, tmp_path / "copy")
    with pytest.raises(ConflictError, match=f"are scan {first.scan} already") as caught:
        run_import(lab, copy, label="other", started_ns=9)
    assert "--again" in str(caught.value.hint)
    assert sorted(p.name for p in (lab.root / "scans").iterdir()) == before
    second, _ = run_import(lab, copy, again=True)
    assert second.scan != first.scan
    assert second.frames_sha256 == first.frames_sha256
    assert len(lab.scans()) == 2


def test_other_angles_or_lasers_are_another_scan(lab: Archive, photos: Path) -> None:
    images = find_images([photos])[0]
    variants = [
        poses_by_step(images, step_deg=1.0),
        poses_by_step(images, step_deg=1.5),
        poses_by_step(images, step_deg=1.0, laser=1),
        poses_by_step(images[:3], step_deg=1.0),
    ]
    assert len({run_import(lab, v)[0].frames_sha256 for v in variants}) == 4


def test_the_order_of_the_files_given_does_not_matter(lab: Archive, photos: Path) -> None:
    given = [photos / f"img{i}.png" for i in (2, 0, 3, 1)]
    one, _ = run_import(lab, poses_by_step(find_images(given)[0], step_deg=1.0), started_ns=1)
    two, _ = run_import(lab, photos, again=True, started_ns=1)
    assert one.content_sha256 == two.content_sha256


# -- what is refused, and what is left then -------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "other", "message"),
    [
        (
            "img3.png",
            pixels(5)[:40],
            r"img3\.png is 64 x 40, grey, 8 bit; .*img0\.png is 64 x 48, grey",
        ),
        ("img2.png", pixels(5, dtype="uint16"), r"img2\.png is .*16 bit; .*img0\.png is .*8 bit"),
        ("img1.png", pixels(5, channels=3), r"img1\.png is .*colour, .*; .*img0\.png is .*grey"),
        ("img1.png", pixels(5, channels=4), r"img1\.png is .*alpha, .*; .*img0\.png is .*grey"),
    ],
)
def test_mixed_images_name_both_files(
    lab: Archive, photos: Path, name: str, other: np.ndarray, message: str
) -> None:
    (photos / name).write_bytes(encoded(other, ".png"))
    with pytest.raises(InputError, match=message):
        run_import(lab, photos)
    assert nothing_is_left(lab)


def test_a_bad_image_at_any_place_leaves_nothing(lab: Archive, tmp_path: Path) -> None:
    good = write_images(tmp_path / "photos", 9)
    for bad in (good[0], good[4], good[8]):
        data = bad.read_bytes()
        bad.write_bytes(data[:-20])
        with pytest.raises(InputError, match=f"{bad.name}: the image is cut off"):
            run_import(lab, tmp_path / "photos")
        assert nothing_is_left(lab)
        bad.write_bytes(data)
    assert run_import(lab, tmp_path / "photos")[0].frames == 9


def test_the_first_bad_image_is_the_one_that_is_named(lab: Archive, tmp_path: Path) -> None:
    for path in write_images(tmp_path / "photos", 12)[5:]:
        path.write_bytes(b"")
    for _ in range(5):
        with pytest.raises(InputError, match=r"img5\.png: is empty"):
            run_import(lab, tmp_path / "photos")


def test_a_calibration_of_another_size(lab: Archive, photos: Path) -> None:
    calibration = camera(48, 64)
    with pytest.raises(CalibrationError, match=r"img0\.png is 64 x 48, calibration c-") as caught:
        run_import(lab, photos, calibration=calibration)
    assert "is for 48 x 64" in caught.value.message
    assert calibration.calibration_id() in caught.value.message
    assert nothing_is_left(lab)
    planes_only = calibration.model_copy(update={"camera": None})
    assert run_import(lab, photos, calibration=planes_only)[0].frames == 4


def test_a_file_that_went_away(lab: Archive, photos: Path) -> None:
    poses = poses_by_step(find_images([photos])[0], step_deg=1.0)
    (photos / "img2.png").unlink()
    for plan in ({}, {"started_ns": 1}):
        with pytest.raises(InputError, match=r"img2\.png: cannot be read \(No such file"):
            run_import(lab, poses, **plan)
    assert nothing_is_left(lab)


def test_an_interruption_leaves_nothing(lab: Archive, photos: Path) -> None:
    def stop(done: int, of: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    poses = poses_by_step(find_images([photos])[0], step_deg=1.0)
    with pytest.raises(KeyboardInterrupt):
        import_images(lab, ImportPlan(poses, rig="r"), stop)
    assert nothing_is_left(lab)


# -- memory ---------------------------------------------------------------------------------------

MEASURED = """
import resource, sys, json
from pathlib import Path
from turnscan.store import Archive
from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.image_sources import find_images
from turnscan.ingest.poses import poses_by_step
archive = Archive.init(sys.argv[2])
peaks = []
def advance(done, of):
    if done in (30, of):
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
poses = poses_by_step(find_images([sys.argv[1]])[0], step_deg=1.0)
import_images(archive, ImportPlan(poses, rig="r"), advance)
peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
print(json.dumps([p / 1024 for p in peaks]))
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (480, 640), dtype=np.uint8)
    for i in range(300):
        image = np.roll(noise, i, axis=1)
        fast = (cv2.IMWRITE_PNG_COMPRESSION, 0)
        (folder / f"{i}.png").write_bytes(encoded(image, ".png", *fast))
    run = subprocess.run(
        [sys.executable, "-c", MEASURED, str(folder), str(tmp_path / "lab")],
        check=True,
        capture_output=True,
        text=True,
    )
    at_30, at_300, sealed = json.loads(run.stdout)
    print(f"peak MB: {at_30:.0f} after 30 frames, {at_300:.0f} after 300, {sealed:.0f} sealed")
    # 300 frames are 92 MB; a chunk of the log and the few read ahead are less than half of that.
    assert sealed - at_30 < 30
