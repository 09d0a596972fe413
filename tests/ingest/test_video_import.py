"""Videos become scans: frames exactly as decoded or as stored, times, angles; and what is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from turnscan.ingest.video_file import missing_bytes, video_facts
from turnscan.ingest.video_import import VideoPlan, import_video, read_content
from turnscan.schemas.calibration import Calibration, Intrinsics
from turnscan.schemas.errors import CalibrationError, ConflictError, InputError, StorageError
from turnscan.schemas.events import LaserState, LogLine, ScanEnd, ScanStart, TurntableAngle
from turnscan.store import Archive
from turnscan.store.bytes import STAGING

from .images import Pixels, encoded, frames, pixels


@pytest.fixture
def lab(tmp_path: Path) -> Archive:
    return Archive.init(tmp_path / "lab")


def write_video(
    path: Path, images: Sequence[Pixels], codec: str = "FFV1", *, fps: float = 25.0
) -> Path:
    first = images[0]
    options = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(first.ndim == 3)]
    if first.dtype == np.uint16:
        options += [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U]
    fourcc = cv2.VideoWriter.fourcc(*codec)
    size = (first.shape[1], first.shape[0])
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, size, options)
    assert writer.isOpened(), path
    for image in images:
        writer.write(image)
    writer.release()
    return path


def noise(count: int, **kind: Any) -> list[Pixels]:
    return [pixels(i, **kind) for i in range(count)]


def run(archive: Archive, path: Path, **words: Any) -> list[object]:
    plan = VideoPlan(path, **({"step_deg": 1.0} if "angles" not in words else {}), **words)
    summary = import_video(archive, read_content(plan))
    return list(archive.log(summary.scan).items())


def of_kind(items: list[object], kind: type) -> list[Any]:
    return [i for i in items if isinstance(i, kind)]


def said(items: list[object]) -> str:
    return "\n".join(line.message for line in of_kind(items, LogLine))


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
@pytest.mark.parametrize(
    "kind",
    [{}, {"channels": 3}, {"dtype": "uint16"}],
    ids=["grey", "colour", "16 bit"],
)
def test_lossless_videos_are_exact(
    lab: Archive, tmp_path: Path, suffix: str, kind: dict[str, Any]
) -> None:
    images = noise(5, **kind)
    path = write_video(tmp_path / f"a{suffix}", images)
    items = run(lab, path, started_ns=10**18)
    start = items[0]
    assert isinstance(start, ScanStart)
    assert start.source == "imported video"
    assert start.time_source == "given start, times of the video"
    kept = frames(items)
    assert [f.t_ns for f in kept] == [10**18 + i * 40_000_000 for i in range(5)]
    for frame, image in zip(kept, images, strict=True):
        shown = frame.decode()
        assert shown.dtype == image.dtype
        assert np.array_equal(shown, image)
    angles = of_kind(items, TurntableAngle)
    assert [a.commanded_rad for a in angles] == [math.radians(i) for i in range(5)]
    assert [(s.laser, s.on) for s in of_kind(items, LaserState)] == [(0, True)]
    assert "SHA-256" in said(items)
    assert items[-1].ended == "complete"  # type: ignore[attr-defined]


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_motion_jpeg_keeps_its_files(lab: Archive, tmp_path: Path, suffix: str) -> None:
    path = write_video(tmp_path / f"a{suffix}", noise(3, channels=3), "MJPG")
    kept = frames(run(lab, path))
    data = path.read_bytes()
    assert len(kept) == 3
    for frame in kept:
        assert frame.image.encoding == "jpeg"
        assert bytes(frame.image.data) in data
        assert frame.decode().shape == (48, 64, 3)


def test_a_bare_stream_of_jpegs(lab: Archive, tmp_path: Path) -> None:
    files = [encoded(pixels(i), ".jpg") for i in range(3)]
    path = tmp_path / "a.mjpeg"
    path.write_bytes(b"".join(files))
    assert [bytes(f.image.data) for f in frames(run(lab, path))] == files


def test_a_size_that_changes_is_refused(lab: Archive, tmp_path: Path) -> None:
    """OpenCV scales the second size to the first without a word."""
    files = [encoded(pixels(0), ".jpg"), encoded(pixels(1)[:40], ".jpg")]
    path = tmp_path / "a.mjpeg"
    path.write_bytes(b"".join(files))
    content = read_content(VideoPlan(path, step_deg=1.0))
    with pytest.raises(InputError, match=r"frame 1 is 64 x 40, grey, 8 bit; .*frame 0 is 64 x 48"):
        import_video(lab, content)
    assert not [p for f in ("scans", STAGING) for p in (lab.root / f).iterdir()]


def test_lossy_video_is_kept_as_decoded(lab: Archive, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", noise(3, channels=3), "mp4v")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    expected = [capture.read()[1] for _ in range(3)]
    capture.release()
    items = run(lab, path)
    for frame, image in zip(frames(items), expected, strict=True):
        assert np.array_equal(frame.decode(), image)
    assert "decoded, without further loss" in said(items)


# -- angles and times -----------------------------------------------------------------------------


def table(path: Path, *rows: str, head: str = "frame,angle_deg") -> Path:
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def test_angles_of_a_csv(lab: Archive, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", noise(4))
    head = "frame,angle_deg,t_ns,laser,laser_on"
    rows = ("2,10,30,1,1", "0,0,10,1,0", "1,0,20,1,1", "3,10,30,0;1,1")
    items = run(lab, path, angles=table(tmp_path / "a.csv", *rows, head=head))
    kept = frames(items)
    assert [f.t_ns for f in kept] == [10, 20, 30, 30]
    assert [f.lasers_on for f in kept] == [(), (1,), (1,), (0, 1)]
    for i, frame in enumerate(kept):
        assert np.array_equal(frame.decode(), pixels(i))
    angles = of_kind(items, TurntableAngle)
    assert [(a.t_ns, a.commanded_rad) for a in angles] == [(10, 0.0), (30, math.radians(10))]


@pytest.mark.parametrize(
    ("rows", "what"),
    [
        (["0,0", "1,1"], "has 2 rows, .*a.mkv has 3 frames"),
        (["0,0", "1,1", "2,2", "3,3"], "has 4 rows, .*a.mkv has 3 frames"),
        (["0,0", "1,1", "1,2"], "line 4: frame 1 stands already in line 3"),
        (["0,0", "1,1", "3,2"], "line 4: frame is '3', expected a number from 0 to 2"),
        (["0,0", "1,x", "2,2"], "line 3: angle_deg is 'x'"),
        (["0,0", "1,nan", "2,2"], "line 3: angle_deg is 'nan'"),
    ],
)
def test_tables_that_do_not_fit(tmp_path: Path, rows: list[str], what: str) -> None:
    path = write_video(tmp_path / "a.mkv", noise(3))
    with pytest.raises(InputError, match=what):
        read_content(VideoPlan(path, angles=table(tmp_path / "a.csv", *rows)))


def test_a_table_for_images_is_none_for_a_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", noise(1))
    csv = table(tmp_path / "a.csv", "a.png,0", head="file,angle_deg")
    with pytest.raises(InputError, match="expected frame, angle_deg"):
        read_content(VideoPlan(path, angles=csv))
    csv = table(tmp_path / "b.csv", "0,0,20", "1,1,10", head="frame,angle_deg,t_ns")
    path = write_video(tmp_path / "b.mkv", noise(2))
    with pytest.raises(InputError, match="t_ns steps back"):
        read_content(VideoPlan(path, angles=csv))


@pytest.mark.parametrize("fps", [5.0, 30.0, 120.0])
def test_times_are_those_of_the_video(lab: Archive, tmp_path: Path, fps: float) -> None:
    path = write_video(tmp_path / "a.avi", noise(4), fps=fps)
    kept = frames(run(lab, path, started_ns=0))
    for i, frame in enumerate(kept):
        assert abs(frame.t_ns - i / fps * 1e9) < 1e6


def test_the_same_video_twice(lab: Archive, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", noise(2))
    run(lab, path)
    with pytest.raises(ConflictError, match="already"):
        run(lab, path)
    run(lab, path, again=True)


def test_a_calibration_of_another_size(tmp_path: Path) -> None:
    camera = Intrinsics(width_px=60, height_px=48, fx_px=1, fy_px=1, cx_px=0, cy_px=0)
    plan = VideoPlan(
        write_video(tmp_path / "a.mkv", noise(2)),
        step_deg=1.0,
        calibration=Calibration(rig="r1", camera=camera),
    )
    with pytest.raises(CalibrationError, match="is 64 x 48, calibration"):
        read_content(plan)


# -- files that are cut off, or no video -----------------------------------------------------------

CONTAINERS = [("a.mkv", "FFV1"), ("a.avi", "FFV1"), ("b.avi", "MJPG"), ("c.mkv", "MJPG")]


@pytest.mark.parametrize(("name", "codec"), CONTAINERS)
def test_a_cut_video_gives_whole_frames_and_says_so(
    lab: Archive, tmp_path: Path, name: str, codec: str
) -> None:
    path = write_video(tmp_path / name, noise(10), codec)
    whole = [f.decode() for f in frames(run(lab, path))]
    data = path.read_bytes()
    assert missing_bytes(path) == 0
    for part in (4, 5, 8):
        path.write_bytes(data[: len(data) * part // 10])
        assert missing_bytes(path) == len(data) - len(data) * part // 10
        items = run(lab, path)
        kept = frames(items)
        assert 1 <= len(kept) <= part
        for frame, image in zip(kept, whole, strict=False):
            assert np.array_equal(frame.decode(), image)
        end = items[-1]
        assert isinstance(end, ScanEnd)
        assert end.ended == "interrupted"
        assert f"{missing_bytes(path)} bytes are missing; {len(kept)} whole frames" in end.note
    with pytest.raises(InputError, match=r"has 10 rows, .*bytes are missing"):
        rows = [f"{i},{i}" for i in range(10)]
        read_content(VideoPlan(path, angles=table(tmp_path / "a.csv", *rows)))


@pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
def test_damage_within_is_an_error(tmp_path: Path, name: str) -> None:
    """FFmpeg conceals a damaged frame, or leaves it out so that all that follow have a wrong angle."""
    path = write_video(tmp_path / name, noise(6))
    data = path.read_bytes()
    found = 0
    for at in range(len(data) * 3 // 10, len(data) * 7 // 10, 1501):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        with pytest.raises(InputError, match="damaged"):
            read_content(VideoPlan(path, step_deg=1.0))
        found += 1
    assert found >= 4


def test_a_damaged_jpeg_within_is_an_error(lab: Archive, tmp_path: Path) -> None:
    files = [encoded(pixels(i), ".jpg") for i in range(4)]
    files[2] = files[2][: len(files[2]) // 2]
    path = tmp_path / "a.mjpeg"
    path.write_bytes(b"".join(files))
    with pytest.raises(InputError, match=r"frame 2: |damaged"):
        import_video(lab, read_content(VideoPlan(path, step_deg=1.0)))
    assert lab.scans() == []


def test_every_cut_is_an_error_or_a_beginning(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", noise(3))
    data = path.read_bytes()
    for size in range(0, len(data), 499):
        path.write_bytes(data[:size])
        try:
            content = read_content(VideoPlan(path, step_deg=1.0))
        except InputError as error:
            assert str(path) in str(error)
        else:
            assert "cut off" in content.remarks[0]
            assert len(content.poses) < 3 or size > len(data) * 0.9


def test_an_mp4_without_its_index(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", noise(3, channels=3), "mp4v")
    path.write_bytes(path.read_bytes()[:-600])
    with pytest.raises(InputError, match="no video that FFmpeg can open, or its index is cut off"):
        read_content(VideoPlan(path, step_deg=1.0))


def test_no_video_at_all(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="no such file"):
        read_content(VideoPlan(tmp_path / "none.mkv", step_deg=1.0))
    with pytest.raises(StorageError, match="cannot be read"):
        read_content(VideoPlan(tmp_path, step_deg=1.0))
    text = tmp_path / "a.mkv"
    text.write_text("hello")
    with pytest.raises(InputError, match="no video"):
        read_content(VideoPlan(text, step_deg=1.0))


def test_a_video_that_changes_in_between(lab: Archive, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", noise(4))
    content = read_content(VideoPlan(path, step_deg=1.0))
    write_video(path, noise(2))
    with pytest.raises(InputError, match="gave 4 frames before, now 2"):
        import_video(lab, content)


def test_facts(tmp_path: Path) -> None:
    facts = video_facts(write_video(tmp_path / "a.mkv", noise(3), fps=10.0))
    assert (facts.frames, facts.stored, facts.promised, facts.fps) == (3, 3, 3, 10.0)
    assert (facts.codec, facts.grey, facts.files, facts.damaged) == ("ffv1", True, "", ())
    assert facts.times_ms == (0.0, 100.0, 200.0)
