"""What every camera must do, whatever stands behind it.

A driver's own tests inherit from :class:`CameraContract` and say in ``camera`` how to make one.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from turnscan.ingest.devices.cameras.building import camera_of
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.contracts import Camera, CameraInfo, Clock, Shot
from turnscan.ingest.room import built_in
from turnscan.ingest.room.camera import Look, SimulatedCamera
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.schemas.errors import DeviceError
from turnscan.schemas.rig import CameraSettings

from ..ingest.cameras.mjpeg_server import MjpegServer
from ..ingest.cameras.sources import noise, write_ffv1, write_sequence

DTYPES = {"mono8": np.uint8, "mono16": np.uint16, "bgr8": np.uint8}


class CameraContract:
    """Contract of :class:`turnscan.ingest.devices.contracts.Camera`.

    Who inherits gives a fixture ``camera``, not yet open, of 12 frames at least.
    """

    @pytest.fixture
    def clock(self) -> Clock:
        return SystemClock()

    @pytest.fixture
    def opened(self, camera: Camera) -> Iterator[Camera]:
        camera.open()
        yield camera
        camera.close()

    def check(self, shot: Shot, info: CameraInfo) -> None:
        assert isinstance(shot.t_ns, int)
        assert shot.image.dtype == DTYPES[info.encoding]
        colours = (3,) if info.encoding == "bgr8" else ()
        assert shot.image.shape == (info.height_px, info.width_px, *colours)
        assert shot.dropped >= 0

    def test_says_what_it_is(self, camera: Camera) -> None:
        info = camera.open()
        assert info.name
        assert info.encoding in DTYPES
        assert info.width_px > 0
        assert info.height_px > 0
        camera.close()

    def test_shots_are_as_announced_and_never_old(self, camera: Camera, clock: Clock) -> None:
        info = camera.open()
        last = -1
        for _ in range(3):
            asked_ns = clock.now_ns()
            shot = camera.shoot(asked_ns)
            self.check(shot, info)
            assert asked_ns <= shot.t_ns <= clock.now_ns()
            assert shot.number > last
            last = shot.number
        camera.close()

    def test_waits_for_a_time_to_come(self, opened: Camera, clock: Clock) -> None:
        soon_ns = clock.now_ns() + 150_000_000
        assert opened.shoot(soon_ns).t_ns >= soon_ns

    def test_streams_in_order(self, camera: Camera, clock: Clock) -> None:
        info = camera.open()
        begun_ns = clock.now_ns()
        shots = camera.stream()
        taken = list(itertools.islice(shots, 6))
        shots.close()  # type: ignore[attr-defined]
        assert len(taken) == 6
        for shot in taken:
            self.check(shot, info)
            assert shot.t_ns >= begun_ns
        for before, after in itertools.pairwise(taken):
            assert after.t_ns > before.t_ns
            # Every number in between is accounted for as dropped.
            assert after.number > before.number
            assert after.dropped >= after.number - before.number - 1
        camera.close()

    def test_shots_after_a_stream_and_a_stream_after_shots(self, opened: Camera, clock: Clock) -> None:
        first = opened.shoot(clock.now_ns())
        shots = opened.stream()
        second = next(shots)
        shots.close()  # type: ignore[attr-defined]
        asked_ns = clock.now_ns()
        third = opened.shoot(asked_ns)
        assert first.number < second.number < third.number
        assert third.t_ns >= asked_ns

    def test_images_belong_to_who_got_them(self, opened: Camera, clock: Clock) -> None:
        first = opened.shoot(clock.now_ns())
        copy = first.image.copy()
        for _ in range(3):
            opened.shoot(clock.now_ns())
        assert np.array_equal(first.image, copy)

    def test_opens_again_after_close(self, camera: Camera, clock: Clock) -> None:
        first = camera.open()
        camera.shoot(clock.now_ns())
        camera.close()
        assert camera.open() == first
        camera.shoot(clock.now_ns())
        camera.close()

    def test_closes_at_any_time_and_more_than_once(self, camera: Camera) -> None:
        camera.close()
        camera.open()
        camera.close()
        camera.close()

    def test_gives_nothing_when_it_is_not_open(self, camera: Camera, clock: Clock) -> None:
        with pytest.raises(DeviceError, match="not open"):
            camera.shoot(clock.now_ns())
        with pytest.raises(DeviceError, match="not open"):
            next(camera.stream())
        camera.open()
        camera.close()
        with pytest.raises(DeviceError, match="not open"):
            camera.shoot(clock.now_ns())

    def test_leaves_no_thread_behind(self, camera: Camera, clock: Clock) -> None:
        before = set(threading.enumerate())
        camera.open()
        camera.shoot(clock.now_ns())
        camera.close()
        # Threads of a test's own server may come and go; ours are called after what they do.
        assert not [t for t in set(threading.enumerate()) - before if t.name.startswith("drain")]


@pytest.mark.skipif(
    "TURNSCAN_TEST_CAMERA" not in os.environ, reason="TURNSCAN_TEST_CAMERA names no camera"
)
class TestV4L2(CameraContract):
    """A real camera: TURNSCAN_TEST_CAMERA is its name in /dev/v4l/by-id, or its path."""

    @pytest.fixture
    def camera(self, clock: Clock, tmp_path: Path) -> Iterator[Camera]:
        settings = CameraSettings(
            driver="v4l2", device=os.environ["TURNSCAN_TEST_CAMERA"], encoding="bgr8", timeout_s=5
        )
        made = camera_of(settings, clock, folder=tmp_path)
        yield made
        made.close()


class TestStream(CameraContract):
    colour = False

    @pytest.fixture
    def camera(self, clock: Clock, tmp_path: Path) -> Iterator[Camera]:
        with MjpegServer(colour=self.colour) as server:
            encoding = "bgr8" if self.colour else "mono8"
            settings = CameraSettings(driver="stream", url=server.url, encoding=encoding)
            made = camera_of(settings, clock, folder=tmp_path)
            yield made
            made.close()


class TestColourStream(TestStream):
    colour = True


class TestImages(CameraContract):
    encoding = "mono8"
    suffix = ".png"

    @pytest.fixture
    def camera(self, clock: Clock, tmp_path: Path) -> Iterator[Camera]:
        write_sequence(tmp_path / "shots", noise(12, self.encoding), self.suffix)
        settings = CameraSettings.model_validate(
            {"driver": "images", "path": "shots", "encoding": self.encoding}
        )
        made = camera_of(settings, clock, folder=tmp_path)
        yield made
        made.close()


class TestDeepPng(TestImages):
    encoding = "mono16"


class TestDeepTiff(TestImages):
    encoding = "mono16"
    suffix = ".tif"


class TestColourImages(TestImages):
    encoding = "bgr8"


class TestVideo(CameraContract):
    encoding = "mono8"

    @pytest.fixture
    def camera(self, clock: Clock, tmp_path: Path) -> Iterator[Camera]:
        write_ffv1(tmp_path / "scan.mkv", noise(12, self.encoding))
        settings = CameraSettings.model_validate(
            {"driver": "video", "path": "scan.mkv", "encoding": self.encoding}
        )
        made = camera_of(settings, clock, folder=tmp_path)
        yield made
        made.close()


class TestDeepVideo(TestVideo):
    encoding = "mono16"


class TestColourVideo(TestVideo):
    encoding = "bgr8"


def test_other_drivers_are_not_built_here(tmp_path: Path) -> None:
    with pytest.raises(
        DeviceError, match='driver = "simulated" is none of v4l2, images, video, stream'
    ):
        camera_of(CameraSettings(driver="simulated"), SystemClock(), folder=tmp_path)


def test_no_such_v4l2_device(tmp_path: Path) -> None:
    settings = CameraSettings(driver="v4l2", device="usb-No_Such_Camera-video-index0")
    with pytest.raises(DeviceError, match="no such device"):
        camera_of(settings, SystemClock(), folder=tmp_path).open()


class TestSimulated(CameraContract):
    """The simulated camera, exposing when asked."""

    fps: float | None = None

    @pytest.fixture
    def camera(self, clock: Clock, tmp_path: Path) -> Iterator[Camera]:
        calibration, document = (
            built_in.BUILT_IN_CALIBRATIONS["room"](),
            built_in.BUILT_IN_SCENES["room"](),
        )
        look = Look(
            scene=Scene(document.shapes),
            rig=SimulatedRig(calibration),
            light=document.light,
            sensor=document.sensor,
        )
        made = SimulatedCamera(
            look, clock, actual_angle_rad=lambda _: 0.3, lasers_lit=lambda _: (0,), fps=self.fps
        )
        yield made
        made.close()


class TestSimulatedFreeRunning(TestSimulated):
    """The same, exposing on and on, whoever waits."""

    fps = 20.0
