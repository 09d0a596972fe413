"""Set and read back, against real captures: FFmpeg's ignores nearly everything that it is told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from turnscan.ingest.devices.cameras.opencv import four_letters, open_video
from turnscan.ingest.devices.cameras.settings import Setting, apply
from turnscan.schemas.errors import DeviceError

from .sources import noise, write_ffv1


@pytest.fixture
def video(tmp_path: Path) -> Iterator[cv2.VideoCapture]:
    opened = open_video(str(write_ffv1(tmp_path / "a.mkv", noise(3, "mono8"))), cv2.CAP_FFMPEG, [])
    assert opened is not None
    yield opened
    opened.release()


def test_what_holds_is_reported(video: cv2.VideoCapture) -> None:
    settings = [
        Setting("convert", cv2.CAP_PROP_CONVERT_RGB, 0.0),
        # Set without success, but it stands already, and that is what counts.
        Setting("width_px", cv2.CAP_PROP_FRAME_WIDTH, 64),
        Setting("fps", cv2.CAP_PROP_FPS, 29.9, tolerance=0.3),
    ]
    assert apply(video, settings, camera="c") == {"convert": 0.0, "width_px": 64.0, "fps": 30.0}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (Setting("width_px", cv2.CAP_PROP_FRAME_WIDTH, 640), "c: width_px: asked 640, found 64"),
        (Setting("fps", cv2.CAP_PROP_FPS, 60.0, tolerance=0.6), "c: fps: asked 60, found 30"),
        (
            Setting("exposure_us", cv2.CAP_PROP_EXPOSURE, 5000.0, per_unit=0.01, tolerance=50),
            "c: exposure_us: asked 5000, found nothing",
        ),
        (Setting("gain", cv2.CAP_PROP_GAIN, 0.0), "c: gain: asked 0, found nothing"),
        (Setting("white_balance", cv2.CAP_PROP_WB_TEMPERATURE, 4000.0), "white_balance: asked 4000"),
    ],
)
def test_what_does_not_hold_is_an_error(
    video: cv2.VideoCapture, setting: Setting, message: str
) -> None:
    with pytest.raises(DeviceError, match=message) as caught:
        apply(video, [setting], camera="c")
    assert caught.value.hint
    assert setting.name in caught.value.hint


class Exposure:
    """Properties of a camera in V4L2's units, which round as such cameras do and may lie."""

    def __init__(self, *, lies: bool = False, steps: float = 1.0) -> None:
        self.lies = lies
        self.steps = steps
        self.values = {cv2.CAP_PROP_EXPOSURE: 157.0}

    def set(self, propId: int, value: float, /) -> bool:
        if not self.lies:
            self.values[propId] = round(value / self.steps) * self.steps
        return True

    def get(self, propId: int, /) -> float:
        return self.values.get(propId, -1.0)


WANTED = Setting("exposure_us", cv2.CAP_PROP_EXPOSURE, 5040.0, per_unit=0.01, tolerance=50.0)


def test_units_are_the_rig_files_and_rounding_by_one_step_is_allowed() -> None:
    assert apply(Exposure(), [WANTED], camera="c") == {"exposure_us": 5000.0}


def test_rounding_further_is_refused() -> None:
    with pytest.raises(DeviceError, match="exposure_us: asked 5040, found 6000"):
        apply(Exposure(steps=20), [WANTED], camera="c")


def test_yes_without_deed_is_refused() -> None:
    with pytest.raises(DeviceError, match="exposure_us: asked 5040, found 15700"):
        apply(Exposure(lies=True), [WANTED], camera="c")


def test_four_letters() -> None:
    assert four_letters(cv2.VideoWriter.fourcc(*"MJPG")) == "MJPG"
    assert four_letters(cv2.VideoWriter.fourcc(*"Y16 ")) == "Y16"
    assert four_letters(0) == "[0][0][0][0]"
    assert four_letters(-1) == "[255][255][255][255]"
