"""Which topics are taken, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from turnscan.ingest.mcap_import import McapPlan, import_mcap, read_content
from turnscan.schemas.errors import (
    ConflictError,
    InputError,
)
from turnscan.store import Archive

from ..images import encoded, frames, pixels
from ..messages import cdr_writer as cdr
from ..recordings import T0, Recording, times
from .importing import joint, nothing_is_left, refused, ros_image, ros_recording, run


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
