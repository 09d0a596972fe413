"""Image sequences and video files: every frame, bit for bit, in order; and files that are damaged."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.ingest.devices.cameras.capture import DamagedFrameError
from turnscan.ingest.devices.cameras.ffv1 import slices_sound
from turnscan.ingest.devices.cameras.images import ImagesCapture
from turnscan.ingest.devices.cameras.recorded import RecordedCamera
from turnscan.ingest.devices.cameras.video import VideoCapture, rounded
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.contracts import Shot
from turnscan.schemas.errors import DeviceError

from .sources import Image, noise, write_ffv1, write_sequence

ENCODINGS = ["mono8", "mono16", "bgr8"]


def camera_on(
    path: Path, encoding: str = "mono8", *, fps: float | None = None, **asked: object
) -> RecordedCamera:
    kind = VideoCapture if path.suffix in (".mkv", ".mp4", ".avi") else ImagesCapture
    capture = kind(path, encoding=encoding, **asked)  # type: ignore[arg-type]
    return RecordedCamera(capture, SystemClock(), fps=fps)


@pytest.mark.parametrize("kind", ["png", "tif", "mkv"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_frame_bit_for_bit_in_order(tmp_path: Path, encoding: str, kind: str) -> None:
    frames = noise(12, encoding)
    if kind == "mkv":
        path = write_ffv1(tmp_path / "a.mkv", frames)
    else:
        path = write_sequence(tmp_path / "a", frames, f".{kind}")
    camera = camera_on(path, encoding)
    info = camera.open()
    assert info.settings["frames"] == 12
    shots = list(camera.stream())
    assert [shot.number for shot in shots] == list(range(12))
    assert all(shot.dropped == 0 for shot in shots)
    for shot, frame in zip(shots, frames, strict=True):
        assert np.array_equal(shot.image, frame)
    with pytest.raises(DeviceError, match="all of its 12 frames were given"):
        camera.shoot(0)
    camera.close()


def test_paced(tmp_path: Path) -> None:
    camera = camera_on(write_sequence(tmp_path / "a", noise(5, "mono8")), fps=50)
    camera.open()
    times = [shot.t_ns for shot in camera.stream()]
    assert all(b - a >= 20_000_000 for a, b in itertools.pairwise(times))
    camera.close()


@pytest.mark.parametrize(("found", "asked"), [(a, b) for a in ENCODINGS for b in ENCODINGS if a != b])
@pytest.mark.parametrize("kind", ["png", "mkv"])
def test_another_encoding_than_asked(tmp_path: Path, found: str, asked: str, kind: str) -> None:
    write = write_ffv1 if kind == "mkv" else write_sequence
    path = write(tmp_path / ("a.mkv" if kind == "mkv" else "a"), noise(2, found))
    with pytest.raises(DeviceError, match=f"encoding: asked {asked}, found {found}") as caught:
        camera_on(path, asked).open()
    assert found in (caught.value.hint or "")


@pytest.mark.parametrize("kind", ["png", "mkv"])
@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"exposure_us": 5000.0}, "exposure_us: asked 5000, found nothing"),
        ({"gain": 1.0}, "gain: asked 1, found nothing"),
        ({"white_balance": 5000.0}, "white_balance: asked 5000, found nothing"),
        ({"width_px": 64, "height_px": 50}, "height_px: asked 50, found 48"),
    ],
)
def test_files_follow_no_settings(
    tmp_path: Path, kind: str, asked: dict[str, object], message: str
) -> None:
    write = write_ffv1 if kind == "mkv" else write_sequence
    path = write(tmp_path / ("a.mkv" if kind == "mkv" else "a"), noise(2, "mono8"))
    with pytest.raises(DeviceError, match=message):
        camera_on(path, **asked).open()
    camera = camera_on(path)
    camera.open()
    with pytest.raises(DeviceError, match="exposure_us: asked 900, found nothing"):
        camera.shoot(0, exposure_us=900.0)
    camera.close()


def test_a_file_of_another_size_in_the_sequence(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "a", noise(2, "mono8"))
    cv2.imwrite(str(folder / "frame2.png"), noise(1, "mono8", shape=(32, 64))[0])
    camera = camera_on(folder)
    camera.open()
    with pytest.raises(DeviceError, match="frame 2: its frames changed from 64 x 48 mono8 to 64 x 32"):
        list(camera.stream())


def test_a_damaged_file_in_the_sequence(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "a", noise(3, "mono8"))
    whole = (folder / "frame1.png").read_bytes()
    (folder / "frame1.png").write_bytes(whole[: len(whole) // 2])
    camera = camera_on(folder)
    camera.open()
    with pytest.raises(DamagedFrameError, match=r"frame1\.png: the image is cut off"):
        list(camera.stream())


@pytest.mark.parametrize("name", ["none", "none/*.png", "none.mkv"])
def test_no_such_file(tmp_path: Path, name: str) -> None:
    with pytest.raises(DeviceError, match="no such file"):
        camera_on(tmp_path / name).open()


def test_no_video_inside(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    path.write_bytes(b"no video at all" * 100)
    with pytest.raises(DeviceError, match="no video that this OpenCV's FFmpeg can read"):
        camera_on(path).open()


def test_a_video_cut_off(tmp_path: Path) -> None:
    path = write_ffv1(tmp_path / "a.mkv", noise(10, "mono16"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    camera = camera_on(path, "mono16")
    camera.open()
    with pytest.raises(DeviceError, match=r"ends after \d of 10 frames: cut off or damaged|is damaged"):
        list(camera.stream())
    camera.close()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_flipped_bit_in_a_video_is_seen(tmp_path: Path, encoding: str) -> None:
    # FFmpeg shows older pixels in its place and says nothing.
    frames = noise(6, encoding)
    path = write_ffv1(tmp_path / "a.mkv", frames)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    camera = camera_on(path, encoding)
    camera.open()
    given: list[Shot] = []
    with pytest.raises(DamagedFrameError, match=r"frame \d is damaged \(checksum of a slice\)"):
        # One by one: extend would lose those before the error.
        for shot in camera.stream():
            given += [shot]
    assert 1 <= len(given) < 6
    for shot, frame in zip(given, frames, strict=False):
        assert np.array_equal(shot.image, frame)
    camera.close()


def test_every_flipped_bit_of_a_packet_is_seen(tmp_path: Path) -> None:
    path = write_ffv1(tmp_path / "a.mkv", noise(1, "mono8", shape=(16, 16)))
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    ok, packet = capture.read()
    capture.release()
    assert ok
    sound = packet.tobytes()
    assert slices_sound(sound)
    for bit in range(8 * len(sound)):
        broken = bytearray(sound)
        broken[bit // 8] ^= 1 << bit % 8
        assert not slices_sound(bytes(broken)), bit
    assert not slices_sound(sound[:-1])
    assert not slices_sound(b"")


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        *[
            (tag, False)
            for tag in ("I420", "BGRA", "Y42B", "RGB[24]", "BGR[24]", "G3[0][8]", "RGB[15]")
        ],
        *[
            (tag, True)
            for tag in ("Y1[0][12]", "[16][0]1Y", "Y3[11][10]", "RGB[48]", "G3[0][16]", "P010")
        ],
    ],
)
def test_formats_that_would_be_rounded(pixels: str, *, expected: bool) -> None:
    assert rounded(pixels) == expected


def write_png_video(path: Path, frames: list[Image]) -> Path:
    """PNG in a video: FFmpeg keeps 16 bit with the high byte first, which OpenCV cannot hand over."""
    height, width = frames[0].shape[:2]
    params = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(frames[0].ndim == 3)]
    params += [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U if frames[0].dtype == np.uint16 else cv2.CV_8U]
    fourcc = cv2.VideoWriter.fourcc(*"MPNG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (width, height), params)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_a_video_that_would_be_rounded_is_refused(tmp_path: Path) -> None:
    path = write_png_video(tmp_path / "a.mkv", noise(2, "mono16"))
    with pytest.raises(
        DeviceError, match=r"pixels are \[16\]\[0\]1Y; reading them here would round"
    ) as caught:
        camera_on(path, "mono16").open()
    assert "gray16le" in (caught.value.hint or "")


@pytest.mark.parametrize("encoding", ["mono8", "bgr8"])
def test_other_lossless_codecs(tmp_path: Path, encoding: str) -> None:
    frames = noise(3, encoding)
    camera = camera_on(write_png_video(tmp_path / "a.mkv", frames), encoding)
    camera.open()
    for shot, frame in zip(camera.stream(), frames, strict=True):
        assert np.array_equal(shot.image, frame)
    camera.close()


def test_lossy_colour_is_taken_as_colour(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    fourcc = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (64, 48))
    for i in range(4):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()
    camera = camera_on(path, "bgr8")
    info = camera.open()
    assert info.settings["slice_crc"] == "none"
    levels = [float(shot.image.mean()) for shot in camera.stream()]
    assert np.allclose(levels, [0, 40, 80, 120], atol=3)
    camera.close()
