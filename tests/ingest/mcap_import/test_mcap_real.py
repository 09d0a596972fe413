"""Real recordings, and memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from turnscan.ingest.mcap_import import McapPlan, read_content
from turnscan.ingest.messages.paths import split_path
from turnscan.store import Archive

from ..images import frames
from ..recordings import Recording, times
from .importing import joint, refused, ros_image, run, said


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
