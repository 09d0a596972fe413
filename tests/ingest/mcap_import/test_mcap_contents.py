"""What the log holds of ROS 2 recordings: every encoding, compressed images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType

from turnscan.schemas.events import LaserState, ScanStart, TurntableAngle
from turnscan.store import Archive

from ..images import encoded, frames, pixels
from ..messages import cdr_writer as cdr
from ..recordings import MS, T0, Recording, times
from .importing import joint, of_kind, refused, ros_image, ros_recording, run, said


@pytest.mark.parametrize(
    "how",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"chunks": False},
        {"index": False},
        {"chunk_bytes": 2000},
    ],
    ids=str,
)
def test_a_ros_2_recording(lab: Archive, tmp_path: Path, how: dict[str, Any]) -> None:
    items = run(lab, ros_recording(tmp_path / "bag.mcap", **how), label="bust", tags={"a": "b"})
    start = items[0]
    assert isinstance(start, ScanStart)
    assert (start.source, start.label, start.tags) == ("imported mcap", "bust", {"a": "b"})
    assert start.time_source == "header stamps of the messages"
    assert [f.t_ns for f in frames(items)] == list(times(4))
    for i, frame in enumerate(frames(items)):
        assert np.array_equal(frame.decode(), pixels(i))
        assert frame.lasers_on == (0,)
    angles = of_kind(items, TurntableAngle)
    assert [a.t_ns for a in angles] == [t - 10 * MS for t in times(4)]
    assert [a.reported_rad for a in angles] == [math.radians(i) for i in range(4)]
    assert not any(a.moving for a in angles)
    assert [(s.t_ns, s.laser, s.on) for s in of_kind(items, LaserState)] == [(T0, 0, True)]
    assert items[-1].ended == "complete"  # type: ignore[attr-defined]
    assert "header stamps" in said(items)
    assert "/camera/image_raw (4 x sensor_msgs/msg/Image, cdr)" in said(items)
    assert "bag.mcap" in said(items)
    assert "SHA-256" in said(items)


ENCODINGS = {
    "mono8": (1, "u1"),
    "8UC1": (1, "u1"),
    "mono16": (1, "u2"),
    "16UC1": (1, "u2"),
    "bgr8": (3, "u1"),
    "rgb8": (3, "u1"),
    "bgra8": (4, "u1"),
    "rgba8": (4, "u1"),
}


def sample(encoding: str) -> tuple[Any, Any]:
    """An image as the encoding stores it, and as a scan shows it."""
    channels, kind = ENCODINGS[encoding]
    image = pixels(5, channels=channels, dtype={"u1": "uint8", "u2": "uint16"}[kind])
    if channels == 4:
        image[:, :, 3] = 255
    shown = image[:, :, :3] if channels >= 3 else image
    return image, shown[:, :, ::-1] if encoding.startswith("rgb") else shown


@pytest.mark.parametrize("big", [0, 1])
@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_exactly(
    lab: Archive, tmp_path: Path, encoding: str, padding: int, big: int
) -> None:
    image, expected = sample(encoding)
    stored = image.astype(">u2") if big and image.dtype == np.uint16 else image
    rows = stored.reshape(image.shape[0], -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.5)
    order = ">" if big else "<"
    ros_image(rec, T0, image, encoding, data=rows.tobytes(), step=rows.shape[1], big=big, order=order)
    items = run(lab, rec.close())
    (frame,) = frames(items)
    assert np.array_equal(frame.decode(), expected)
    assert ("alpha" in said(items)) is encoding.endswith("a8")


@pytest.mark.parametrize(
    "encoding", ["bayer_rggb8", "yuv422", "32FC1", "16SC1", "rgb16", "8UC3", "nv21", ""]
)
def test_other_encodings_are_refused_by_name(tmp_path: Path, encoding: str) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.5)
    ros_image(rec, T0, pixels(), encoding)
    error = refused(rec.close(), f"message 1: its encoding '{encoding}' cannot be kept exactly")
    assert "mono16" in error.hint


def test_alpha_that_says_something_is_not_thrown_away(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.5)
    ros_image(rec, T0, pixels(channels=4), "rgba8")
    refused(rec.close(), "alpha channel that is not constant")


@pytest.mark.parametrize(
    ("step", "cut", "what"),
    [(63, 0, "rows of 63 bytes"), (64, 1, "3071 are there"), (0, 0, "rows of 0 bytes")],
)
def test_sizes_that_do_not_fit(tmp_path: Path, step: int, cut: int, what: str) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.5)
    data = pixels().tobytes()
    ros_image(rec, T0, pixels(), data=data[: len(data) - cut], step=step)
    refused(rec.close(), what)


@pytest.mark.parametrize(
    ("suffix", "fmt"),
    [
        (".jpg", "jpeg"),
        (".png", "png"),
        (".jpg", "mono8; jpeg compressed "),
        (".png", "rgb8; png compressed bgr8"),
    ],
)
def test_compressed_bytes_are_kept_as_they_are(
    lab: Archive, tmp_path: Path, suffix: str, fmt: str
) -> None:
    data = encoded(pixels(1), suffix)
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.5)
    rec.ros("/image", "sensor_msgs/msg/CompressedImage", T0, cdr.compressed(T0, fmt, data))
    (frame,) = frames(run(lab, rec.close()))
    assert bytes(frame.image.data) == data
    assert frame.image.encoding == {".jpg": "jpeg", ".png": "png"}[suffix]


def test_compressed_images_that_are_none(tmp_path: Path) -> None:
    for name, fmt, data, what in (
        ("depth", "16UC1; compressedDepth png", b"\0" * 12 + encoded(pixels(), ".png"), "depth image"),
        ("webp", "webp", encoded(pixels(), ".webp"), "is no WEBP image"),
        ("cut", "jpeg", encoded(pixels(), ".jpg")[:-200], "cut off"),
        ("bmp", "jpeg", encoded(pixels(), ".bmp"), "holds a bmp"),
    ):
        rec = Recording(tmp_path / f"{name}.mcap")
        joint(rec, T0, 0.5)
        rec.ros("/image", "sensor_msgs/msg/CompressedImage", T0, cdr.compressed(T0, fmt, data))
        refused(rec.close(), what)


def test_cv2_agrees_on_colour_order() -> None:
    image, expected = sample("rgb8")
    assert np.array_equal(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), expected)
