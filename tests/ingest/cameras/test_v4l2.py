"""What can be shown of V4L2 without a camera: how one is named, and what is said when there is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from turnscan.ingest.devices.cameras import v4l2
from turnscan.ingest.devices.cameras.v4l2 import V4L2Capture, find_device
from turnscan.schemas.errors import DeviceError


@pytest.fixture
def by_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "by-id"
    folder.mkdir()
    (tmp_path / "video7").touch()
    (folder / "usb-Maker_Camera_123-video-index0").symlink_to("../video7")
    monkeypatch.setattr(v4l2, "STABLE", (folder, tmp_path / "by-path"))
    return folder


def test_a_stable_name_leads_to_the_device(by_id: Path) -> None:
    name = "usb-Maker_Camera_123-video-index0"
    device = by_id.parent / "video7"
    assert find_device(name) == device
    assert find_device(str(by_id / name)) == device


@pytest.mark.parametrize("device", [99, "/dev/video99", "usb-Other-video-index0"])
def test_no_such_device_names_those_present(by_id: Path, device: int | str) -> None:
    with pytest.raises(
        DeviceError, match=r"no such device; in .*by-id: usb-Maker_Camera_123"
    ) as caught:
        V4L2Capture(device).open()
    assert str(device) in caught.value.message
    assert caught.value.hint


def test_no_device_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(v4l2, "STABLE", (tmp_path / "by-id",))
    with pytest.raises(DeviceError, match=r"no such device; (no video device is present|present: )"):
        V4L2Capture("usb-Other-video-index0").open()


def test_a_file_that_is_no_camera(by_id: Path) -> None:
    with pytest.raises(DeviceError, match="is there but cannot be opened for capture"):
        V4L2Capture(str(by_id.parent / "video7")).open()


def test_what_is_asked_of_the_camera(by_id: Path) -> None:
    import cv2

    capture = V4L2Capture(
        0, width_px=640, height_px=480, fps=30, exposure_us=5000, gain=8, white_balance=4600
    )
    asked = {s.name: (s.property, s.value * s.per_unit) for s in capture._settings()}
    assert asked == {
        "width_px": (cv2.CAP_PROP_FRAME_WIDTH, 640),
        "height_px": (cv2.CAP_PROP_FRAME_HEIGHT, 480),
        "fps": (cv2.CAP_PROP_FPS, 30),
        # V4L2: 1 is manual; exposure counts 100 us.
        "exposure_auto (1: manual)": (cv2.CAP_PROP_AUTO_EXPOSURE, 1),
        "exposure_us": (cv2.CAP_PROP_EXPOSURE, 50),
        "gain": (cv2.CAP_PROP_GAIN, 8),
        "white_balance_auto": (cv2.CAP_PROP_AUTO_WB, 0),
        "white_balance": (cv2.CAP_PROP_WB_TEMPERATURE, 4600),
    }
    # Automatic off first, or the camera takes the value and goes on by itself.
    names = list(asked)
    assert names.index("exposure_auto (1: manual)") < names.index("exposure_us")
    assert names.index("white_balance_auto") < names.index("white_balance")
    assert V4L2Capture(0)._settings() == []
