"""Foxglove, bare numbers, joints, other definitions, laser topics."""

from __future__ import annotations

import base64
import math
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from turnscan.ingest.messages.paths import split_path
from turnscan.schemas.events import LaserState, TurntableAngle
from turnscan.store import Archive
from turnscan.store.log_reader import LogFrame

from ..images import encoded, frames, pixels
from ..messages import cdr_writer as cdr
from ..recordings import MS, T0, Recording, times
from .importing import joint, of_kind, refused, ros_image, run, said


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
