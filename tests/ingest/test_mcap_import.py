"""Recordings of ROS 2 and Foxglove become scans: what the log then holds, and what is refused."""

from __future__ import annotations

import base64
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from turnscan.ingest.mcap_import import McapPlan, import_mcap, read_content
from turnscan.ingest.mcap_survey import Asked
from turnscan.ingest.mcap_times import in_order, most_waiting
from turnscan.ingest.messages.paths import split_path
from turnscan.schemas.calibration import Calibration, Intrinsics
from turnscan.schemas.errors import (
    CalibrationError,
    ConflictError,
    DamageError,
    InputError,
    StorageError,
)
from turnscan.schemas.events import LaserState, LogLine, ScanEnd, ScanStart, TurntableAngle
from turnscan.store import Archive
from turnscan.store.bytes import STAGING
from turnscan.store.log_reader import LogFrame

from .images import encoded, frames, pixels
from .messages import cdr_writer as cdr
from .recordings import MS, T0, Recording, times


@pytest.fixture
def lab(tmp_path: Path) -> Archive:
    return Archive.init(tmp_path / "lab")


def run(archive: Archive, path: Path, **words: Any) -> list[object]:
    """Import and give all items of the new log."""
    asked = Asked(**{k: words.pop(k) for k in list(words) if k in Asked.__dataclass_fields__})
    plan = McapPlan(path, asked, **words)
    summary = import_mcap(archive, read_content(plan))
    return list(archive.log(summary.scan).items())


def refused(path: Path, match: str, error: type[Exception] = InputError, **words: Any) -> Any:
    with pytest.raises(error, match=match) as caught:
        asked = Asked(**{k: words.pop(k) for k in list(words) if k in Asked.__dataclass_fields__})
        read_content(McapPlan(path, asked, **words))
    return caught.value


def of_kind(items: list[object], kind: type) -> list[Any]:
    return [i for i in items if isinstance(i, kind)]


def nothing_is_left(archive: Archive) -> bool:
    folders = [archive.root / "scans", archive.root / STAGING]
    return not [p for f in folders for p in f.iterdir()] and archive.scans() == []


def said(items: list[object]) -> str:
    return "\n".join(line.message for line in of_kind(items, LogLine))


def ros_image(rec: Recording, t_ns: int, image: Any, encoding: str = "mono8", **more: Any) -> None:
    data = more.pop("data", image.tobytes())
    step = more.pop("step", len(data) // image.shape[0])
    message = cdr.image(
        t_ns, encoding, data, width=image.shape[1], height=image.shape[0], step=step, **more
    )
    rec.ros("/camera/image_raw", "sensor_msgs/msg/Image", t_ns + 5 * MS, message)


def joint(rec: Recording, t_ns: int, angle: float, *, topic: str = "/joints", **more: Any) -> None:
    data = cdr.joints(t_ns, {"table": angle, **more.pop("others", {})}, **more)
    rec.ros(topic, "sensor_msgs/msg/JointState", t_ns + 2 * MS, data)


def ros_recording(path: Path, count: int = 4, **how: Any) -> Path:
    """A joint report 10 ms before every image; stamps lie before log times."""
    rec = Recording(path, **how)
    for i, t_ns in enumerate(times(count)):
        joint(rec, t_ns - 10 * MS, math.radians(i))
        ros_image(rec, t_ns, pixels(i))
    return rec.close()


# -- what the log holds ---------------------------------------------------------------------------


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


def test_foxglove_protobuf(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "fox.mcap")
    for i, t_ns in enumerate(times(3)):
        state = JointStates()
        state.timestamp.FromNanoseconds(t_ns)
        state.joints.add(name="table", position=0.25 * i)
        rec.proto("/state", t_ns, state)
        image = RawImage(
            frame_id="c", width=64, height=48, encoding="mono16", step=128,
            data=pixels(i, dtype="uint16").tobytes(),
        )  # fmt: skip
        image.timestamp.FromNanoseconds(t_ns)
        rec.proto("/image", t_ns, image)
    items = run(lab, rec.close())
    assert [a.reported_rad for a in of_kind(items, TurntableAngle)] == [0.0, 0.25, 0.5]
    for i, frame in enumerate(frames(items)):
        assert np.array_equal(frame.decode(), pixels(i, dtype="uint16"))


def test_an_unset_protobuf_field_is_not_zero(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "fox.mcap")
    state = JointStates()
    state.timestamp.FromNanoseconds(T0)
    state.joints.add(name="table", velocity=1.0)
    rec.proto("/state", T0, state)
    image = CompressedImage(format="png", data=encoded(pixels(), ".png"))
    image.timestamp.FromNanoseconds(T0)
    rec.proto("/image", T0, image)
    refused(rec.close(), "position is None, expected a number")


def test_foxglove_json_and_a_json_angle(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "fox.mcap")
    for i, t_ns in enumerate(times(2)):
        stamp = {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
        rec.json("/table", "Table", t_ns, {"timestamp": stamp, "state": {"angle_deg": 10.0 * i}})
        data = base64.b64encode(pixels(i).tobytes()).decode()
        image = {"width": 64, "height": 48, "step": 64, "encoding": "mono8", "data": data}
        rec.json("/image", "foxglove.RawImage", t_ns, {"timestamp": stamp, **image})
    items = run(lab, rec.close(), angle_path=split_path("state.angle_deg"))
    assert [a.reported_rad for a in of_kind(items, TurntableAngle)] == [0.0, math.radians(10)]
    assert np.array_equal(frames(items)[1].decode(), pixels(1))


def test_a_bare_json_number_needs_its_unit(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "fox.mcap")
    rec.json("/angle", "", T0 + 5 * MS, 90)
    ros_image(rec, T0, pixels())
    path = rec.close()
    error = refused(path, "/angle .* nothing says whether the message itself is in degrees")
    assert "--angle-unit deg" in error.hint
    (angle,) = of_kind(run(lab, path, angle_unit="deg"), TurntableAngle)
    assert angle.reported_rad == math.pi / 2


@pytest.mark.parametrize(("kind", "tolerance"), [("Float64", 0.0), ("Float32", 1e-6)])
def test_a_std_msgs_number(lab: Archive, tmp_path: Path, kind: str, tolerance: float) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    rec.ros("/angle", f"std_msgs/msg/{kind}", T0 + 5 * MS, cdr.write([(kind.lower(), 12.34)]))
    ros_image(rec, T0, pixels())
    path = rec.close()
    refused(path, "nothing says whether data is in degrees")
    items = run(lab, path, angle_unit="rad")
    (angle,) = of_kind(items, TurntableAngle)
    assert abs(angle.reported_rad - 12.34) <= tolerance
    # Without a header there is no stamp, and two clocks are never mixed.
    assert items[0].time_source == "log times of the messages"  # type: ignore[attr-defined]
    assert "/angle has messages without a stamp" in said(items)
    assert frames(items)[0].t_ns == T0 + 5 * MS


def test_joints_by_name_and_number(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.5, others={"arm": 2.0})
    ros_image(rec, T0, pixels())
    path = rec.close()
    error = refused(path, "does not say which of its fields is the angle")
    assert error.hint == "give --angle-field: position.table or position.arm"
    for field, value in (("position.arm", 2.0), ("position[0]", 0.5), ("position.1", 2.0)):
        items = run(lab, path, angle_path=split_path(field), again=True)
        assert [a.reported_rad for a in of_kind(items, TurntableAngle)] == [value]
    error = refused(
        path, "it has no position.leg", angle_topic="/joints", angle_path=("position", "leg")
    )
    refused(
        path, "its name.0 is 'table', expected a number", angle_path=("name", "0"), angle_unit="rad"
    )


def test_a_standard_message_without_its_definition(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    data = cdr.joints(T0, {"table": 0.5})
    rec.ros("/joints", "sensor_msgs/msg/JointState", T0, data, text="")
    ros_image(rec, T0, pixels())
    assert of_kind(run(lab, rec.close()), TurntableAngle)[0].reported_rad == 0.5
    rec = Recording(tmp_path / "other.mcap")
    rec.ros("/angle", "my/msg/Angle", T0, data, text="")
    ros_image(rec, T0, pixels())
    refused(rec.close(), "no ros2msg definition of my/msg/Angle", angle_topic="/angle")


def test_turnscans_own_log(lab: Archive, tmp_path: Path) -> None:
    """Angles as commanded and reported, laser states, frames and times come through a second time."""
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        joint(rec, t_ns, 0.1 * i)
        ros_image(rec, t_ns, pixels(i))
        on = cdr.write([("bool", i > 0)])
        rec.ros("/laser", "std_msgs/msg/Bool", t_ns, on)
    first = run(lab, rec.close(), laser_topic="/laser", laser=3, times="log")
    scan = first[0].scan  # type: ignore[attr-defined]
    second = run(lab, lab.log(scan).path, again=True)
    kinds = (TurntableAngle, LaserState, LogFrame)
    keep = [i for i in first if isinstance(i, kinds)]
    copy = [i for i in second if isinstance(i, kinds)]
    assert [i for i in copy if not isinstance(i, LogFrame)] == [
        i for i in keep if not isinstance(i, LogFrame)
    ]
    for one, two in zip(frames(first), frames(second), strict=True):
        assert (one.t_ns, one.lasers_on) == (two.t_ns, two.lasers_on)
        assert np.array_equal(one.decode(), two.decode())


def test_a_laser_topic(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(6)):
        joint(rec, t_ns, 0.1 * i)
        if i in (1, 2, 4):
            rec.json("/laser", "", t_ns + 5 * MS, {"on": i == 2})
        ros_image(rec, t_ns, pixels(i))
    path = rec.close()
    items = run(lab, path, laser_topic="/laser", laser=2, times="log")
    # What the laser did before it said so is not known; the first frame is left out, and that is said.
    assert [f.lasers_on for f in frames(items)] == [(), (2,), (2,), (), ()]
    assert "frames left out, because they come before the first angle or laser state: 1" in said(items)
    assert [s.on for s in of_kind(items, LaserState)] == [False, True, False]
    rec = Recording(tmp_path / "bad.mcap")
    joint(rec, T0, 0)
    ros_image(rec, T0, pixels())
    rec.json("/laser", "", T0, {"on": "yes"})
    refused(rec.close(), "its on is 'yes', expected on or off", laser_topic="/laser")


# -- time -----------------------------------------------------------------------------------------


def test_a_table_that_turns(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(4)):
        joint(rec, t_ns - 10 * MS, 0.1 * min(i, 2))
        ros_image(rec, t_ns, pixels(i))
    path = rec.close()
    items = run(lab, path)
    assert [a.moving for a in of_kind(items, TurntableAngle)] == [None] * 4
    assert "frames between two different angles: 2" in said(items)
    items = run(lab, path, mode="continuous", again=True)
    assert [a.moving for a in of_kind(items, TurntableAngle)] == [True, True, None, None]
    assert "between two different angles" not in said(items)
    assert "between two different angles" not in said(run(lab, path, mode="step", again=True))


def test_a_joint_that_says_it_moves(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        joint(rec, t_ns, 0.1 * i, velocity=1.0)
        ros_image(rec, t_ns, pixels(i))
    assert [a.moving for a in of_kind(run(lab, rec.close()), TurntableAngle)] == [True, True, None]


def test_frames_before_the_first_angle_are_left_out_and_that_is_said(
    lab: Archive, tmp_path: Path
) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(5)):
        ros_image(rec, t_ns, pixels(i))
        if i >= 2:
            joint(rec, t_ns, 0.1)
    items = run(lab, rec.close())
    assert [f.t_ns for f in frames(items)] == list(times(5))[2:]
    assert "before the first angle: 2" in said(items)


def test_no_overlap_in_time(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        ros_image(rec, t_ns, pixels(i))
    joint(rec, T0 + 10**12, 0.1)
    path = rec.close()
    assert "--times" in refused(path, r"no overlap in time: /camera/image_raw runs from t_ns 17").hint
    refused(path, "no overlap in time", times="stamp")
    rec = Recording(tmp_path / "stale.mcap")
    ros_image(rec, T0, pixels())
    joint(rec, T0 - 120 * 10**9, 0.1)
    refused(rec.close(), "no overlap in time")


def test_stamps_of_two_clocks_are_not_paired(lab: Archive, tmp_path: Path) -> None:
    """A camera that counts from its start: log times are used, and that is said."""
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        joint(rec, t_ns, 0.1 * i)
        data = cdr.image(t_ns - T0 + 1, "mono8", pixels(i).tobytes(), width=64, height=48, step=64)
        rec.ros("/image", "sensor_msgs/msg/Image", t_ns + 5 * MS, data)
    path = rec.close()
    items = run(lab, path)
    assert [f.t_ns for f in frames(items)] == [t + 5 * MS for t in times(3)]
    assert "times are log times of the messages (by their stamps" in said(items)
    refused(path, "no overlap in time", times="stamp")


def test_messages_out_of_order_are_put_in_order(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap", chunk_bytes=5000)
    stamps = times(8)
    for i in (1, 0, 3, 2, 5, 7, 4, 6):
        ros_image(rec, stamps[i], pixels(i))
    for i in (7, 6, 5, 4, 3, 2, 1, 0):
        joint(rec, stamps[i], 0.1 * i)
    items = run(lab, rec.close())
    assert [f.t_ns for f in frames(items)] == list(stamps)
    for i, frame in enumerate(frames(items)):
        assert np.array_equal(frame.decode(), pixels(i))
    assert [a.t_ns for a in of_kind(items, TurntableAngle)] == list(stamps)


def test_images_too_far_out_of_order_are_refused(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    small = np.zeros((2, 2), np.uint8)
    joint(rec, T0, 0.1)
    for t_ns in reversed(times(70)):
        ros_image(rec, t_ns, small)
    assert "mcap sort" in refused(rec.close(), "up to 70 places out of order").hint


@given(st.lists(st.integers(0, 20), min_size=1, max_size=40))
def test_order_and_what_waits_for_it(values: list[int]) -> None:
    order = list(in_order(values))
    assert [values[i] for i in order] == sorted(values)
    assert all(a < b for a, b in pairwise(order) if values[a] == values[b])
    held, following, most = set(), 0, 0
    for i in range(len(values)):
        held.add(order.index(i))
        most = max(most, len(held))
        while following in held:
            held.remove(following)
            following += 1
    assert most_waiting(order) == most
    assert (most == 1) is (values == sorted(values))


# -- choosing topics ------------------------------------------------------------------------------


def test_topics_are_listed_when_there_is_a_choice(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for topic in ("/a", "/b"):
        joint(rec, T0, 0.1, topic=topic)
    ros_image(rec, T0, pixels())
    png = encoded(pixels(), ".png")
    rec.ros("/thumb", "sensor_msgs/msg/CompressedImage", T0, cdr.compressed(T0, "png", png))
    path = rec.close()
    error = refused(path, "2 topics could be the image")
    assert error.hint == (
        "give --image-topic, one of: /camera/image_raw (1 x sensor_msgs/msg/Image, cdr); "
        "/thumb (1 x sensor_msgs/msg/CompressedImage, cdr)"
    )
    error = refused(path, "2 topics could be the angle", image_topic="/thumb")
    assert "/a (1 x sensor_msgs/msg/JointState, cdr); /b" in error.hint
    refused(path, "has no topic /c", image_topic="/c")
    refused(path, r"/a \(.*\) is no image topic", image_topic="/a")
    refused(path, r"has no topic /laser", image_topic="/thumb", angle_topic="/a", laser_topic="/laser")
    error = refused(path, "does not say which", image_topic="/thumb", angle_topic="/camera/image_raw")
    assert len(frames(run(lab, path, image_topic="/thumb", angle_topic="/b"))) == 1


def test_a_file_without_what_is_needed(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    rec.ros("/text", "std_msgs/msg/String", T0, cdr.write([("string", "hello")]))
    path = rec.close()
    error = refused(path, "no topic is the image")
    assert "the file has: /text (1 x std_msgs/msg/String, cdr)" in error.hint
    empty = Recording(tmp_path / "empty.mcap").close()
    assert "the file has: no message" in refused(empty, "no topic is the image").hint
    rec = Recording(tmp_path / "ros1.mcap")
    rec.other("/image", "ros1", "sensor_msgs/Image", T0, b"")
    error = refused(rec.close(), "messages are 'ros1'", image_topic="/image")
    assert "rosbags-convert" in error.hint


@pytest.mark.parametrize(
    ("value", "what"),
    [
        (math.nan, "message 2: its position.0 is nan, expected a finite angle"),
        (math.inf, "is inf, expected a finite angle"),
        (1000.0, "more than a hundred turns"),
    ],
)
def test_an_angle_that_is_none(tmp_path: Path, value: float, what: str) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.1)
    joint(rec, T0 + 1, value)
    ros_image(rec, T0, pixels())
    refused(rec.close(), what)


def test_what_is_wrong_on_another_topic_does_not_matter(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    joint(rec, T0, 0.1)
    joint(rec, T0, math.nan, topic="/other")
    rec.json("/broken", "Broken", T0, b"{nonsense")
    ros_image(rec, T0, pixels())
    path = rec.close()
    assert len(frames(run(lab, path, angle_topic="/joints"))) == 1
    refused(path, "not JSON", angle_topic="/broken")
    refused(path, "its position.0 is nan", angle_topic="/other")


def test_images_must_stay_the_same(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, image in enumerate((pixels(), pixels()[:-1])):
        joint(rec, times(2)[i], 0.1 * i)
        ros_image(rec, times(2)[i], image)
    content = read_content(McapPlan(rec.close()))
    with pytest.raises(InputError, match=r"message 2 is 64 x 47, grey, 8 bit; .*message 1 is 64 x 48"):
        import_mcap(lab, content)
    assert nothing_is_left(lab)


def test_the_same_content_twice(lab: Archive, tmp_path: Path) -> None:
    path = ros_recording(tmp_path / "bag.mcap")
    run(lab, path)
    with pytest.raises(ConflictError, match="already"):
        run(lab, path)
    run(lab, path, again=True)
    assert len(lab.scans()) == 2


# -- cameras --------------------------------------------------------------------------------------

K = [300.0, 0.3, 31.5, 0.0, 301.0, 23.5, 0.0, 0.0, 1.0]
D = [-0.1, 0.02, 0.001, -0.002, 0.003]


def with_camera(path: Path, *cameras: bytes) -> Path:
    rec = Recording(path)
    joint(rec, T0, 0.1)
    for data in cameras:
        rec.ros("/camera/camera_info", "sensor_msgs/msg/CameraInfo", T0, data)
    ros_image(rec, T0, pixels())
    return rec.close()


def test_camera_info_becomes_the_snapshot(lab: Archive, tmp_path: Path) -> None:
    data = cdr.camera_info(T0, K, D)
    content = read_content(McapPlan(with_camera(tmp_path / "a.mcap", data, data), rig="r1"))
    assert content.calibration is not None
    camera = content.calibration.camera
    assert camera is not None
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (300.0, 301.0, 31.5, 23.5)
    assert camera.skew == pytest.approx(0.001, rel=1e-15)
    assert camera.distortion == tuple(D)
    summary = import_mcap(lab, content)
    assert summary.calibration == content.calibration.calibration_id()
    assert summary.rig == "r1"


@pytest.mark.parametrize(
    ("cameras", "what"),
    [
        ([cdr.camera_info(T0, [0.0] * 9, D)], "not calibrated"),
        ([cdr.camera_info(T0, K, D[:3])], "with 3 coefficients"),
        ([cdr.camera_info(T0, K, D, width=32)], "it is for 32 x 48, the images are 64 x 48"),
        ([cdr.camera_info(T0, K, D), cdr.camera_info(T0, K, D[:4])], "changes on the way"),
    ],
    ids=["zero", "short", "size", "changes"],
)
def test_cameras_that_cannot_be_kept_are_said_to_be_ignored(
    tmp_path: Path, cameras: list[bytes], what: str
) -> None:
    content = read_content(McapPlan(with_camera(tmp_path / "a.mcap", *cameras)))
    assert content.calibration is None
    (remark,) = content.remarks
    assert "camera calibration on /camera/camera_info is ignored" in remark
    assert what in remark


def test_a_given_calibration_wins(tmp_path: Path) -> None:
    path = with_camera(tmp_path / "a.mcap", cdr.camera_info(T0, K, D))
    camera = Intrinsics(width_px=64, height_px=48, fx_px=1, fy_px=1, cx_px=0, cy_px=0)
    given_one = Calibration(rig="r1", camera=camera)
    content = read_content(McapPlan(path, calibration=given_one))
    assert content.calibration == given_one
    assert "ignored: --calibration is given" in content.remarks[0]
    small = given_one.model_copy(update={"camera": camera.model_copy(update={"width_px": 60})})
    refused(path, "is for 60 x 48", CalibrationError, calibration=small)


# -- files that are cut off or damaged -------------------------------------------------------------


@pytest.mark.parametrize("how", [{"chunk_bytes": 4000}, {"chunks": False}], ids=str)
def test_a_cut_file_gives_what_is_whole(lab: Archive, tmp_path: Path, how: dict[str, Any]) -> None:
    whole = ros_recording(tmp_path / "bag.mcap", 8, **how)
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 6 // 10])
    items = run(lab, cut)
    kept = frames(items)
    assert 2 <= len(kept) <= 5
    for i, frame in enumerate(kept):
        assert np.array_equal(frame.decode(), pixels(i))
    end = items[-1]
    assert isinstance(end, ScanEnd)
    assert end.ended == "interrupted"
    assert "runs past the end" in end.note
    assert "the recording is cut off" in said(items)


def test_every_cut_gives_a_beginning_or_an_error(tmp_path: Path) -> None:
    data = ros_recording(tmp_path / "bag.mcap", 3, chunk_bytes=2000).read_bytes()
    cut = tmp_path / "cut.mcap"
    found = set()
    for size in range(0, len(data), 97):
        cut.write_bytes(data[:size])
        try:
            content = read_content(McapPlan(cut))
        except (InputError, DamageError) as error:
            assert str(cut) in str(error)
        else:
            assert content.survey.lost
            for i, frame in enumerate(content.images()):
                assert np.array_equal(frame.pixels, pixels(i))
            found.add(len(content.order))
    assert found == {1, 2, 3}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_flipped_bit_changes_what_is_imported(tmp_path: Path, data: st.DataObject) -> None:
    good = tmp_path / "bag.mcap"
    if not good.exists():
        ros_recording(good, 3, chunk_bytes=4000)
    bits = bytearray(good.read_bytes())
    at = data.draw(st.integers(0, len(bits) * 8 - 1))
    bits[at // 8] ^= 1 << at % 8
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(bits)
    try:
        content = read_content(McapPlan(bad))
    except (DamageError, InputError) as error:
        assert str(bad) in str(error)
        return
    assert not content.survey.lost
    for i, frame in enumerate(content.images()):
        assert np.array_equal(frame.pixels, pixels(i))
    assert list(content.choice.angles.reported) == [math.radians(i) for i in range(3)]


def test_a_broken_chunk_is_an_error_and_no_loss(lab: Archive, tmp_path: Path) -> None:
    path = ros_recording(tmp_path / "bag.mcap", 4, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    refused(path, "the CRC of a chunk does not fit", DamageError)
    assert nothing_is_left(lab)


def test_no_such_file_and_no_mcap(tmp_path: Path) -> None:
    refused(tmp_path / "none.mcap", "no such file", StorageError)
    (tmp_path / "a.txt").write_text("hello, this is no recording")
    refused(tmp_path / "a.txt", "does not begin as an MCAP file", DamageError)


def test_a_file_that_changes_in_between(lab: Archive, tmp_path: Path) -> None:
    path = ros_recording(tmp_path / "bag.mcap", 4)
    content = read_content(McapPlan(path))
    ros_recording(path, 2)
    with pytest.raises(InputError, match="changed while it was read"):
        import_mcap(lab, content)
    assert nothing_is_left(lab)


# -- real recordings ------------------------------------------------------------------------------


def test_the_real_json_recording(lab: Archive, test_data: Path) -> None:
    """Foxglove JSON of another program. It holds no angle, so a number of its camera stands in."""
    path = test_data / "mcap_recordings" / "lichtblick" / "custom-camera-model.mcap"
    error = refused(path, "no topic is the angle")
    assert "/image/compressed (10 x foxglove.CompressedImage, json)" in error.hint
    items = run(
        lab,
        path,
        angle_topic="/camera_calibration",
        angle_path=split_path("K.8"),
        angle_unit="deg",
    )
    kept = frames(items)
    assert len(kept) == 10
    assert {f.decode().shape[:2] for f in kept} == {(360, 520)}
    assert bytes(kept[0].image.data).startswith(b"\xff\xd8\xff\xe0\0\x10JFIF")
    # Its log times are milliseconds in the place of nanoseconds; its stamps are right.
    assert kept[0].t_ns == 1747930377 * 10**9
    assert "camera calibration on /camera_calibration is ignored: it is for 640 x 480" in said(items)
    assert "CylinderCameraModel" in said(items)


@pytest.mark.parametrize(
    "name", ["lichtblick/example", "rosbag2/talker", "rosbag2/wbag_0", "rosbag2/cdr_test_0"]
)
def test_real_recordings_without_images_say_what_they_hold(test_data: Path, name: str) -> None:
    path = test_data / "mcap_recordings" / f"{name}.mcap"
    error = refused(path, "no topic is the image")
    assert " x " in error.hint


def test_memory_stays_flat(tmp_path: Path) -> None:
    """Twice the frames, not twice the memory."""
    import tracemalloc

    peaks = []
    for count in (20, 60):
        rec = Recording(tmp_path / f"{count}.mcap")
        image = np.zeros((300, 400), np.uint8)
        for i, t_ns in enumerate(times(count)):
            joint(rec, t_ns, 0.01 * i)
            ros_image(rec, t_ns, image + np.uint8(i))
        content = read_content(McapPlan(rec.close()))
        tracemalloc.start()
        assert sum(1 for _ in content.images()) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def test_cv2_agrees_on_colour_order() -> None:
    image, expected = sample("rgb8")
    assert np.array_equal(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), expected)
