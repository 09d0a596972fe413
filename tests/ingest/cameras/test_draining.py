"""The draining thread over a capture that behaves as V4L2 cameras do: a queue in the driver, stamps of
its own, an exposure time that holds a few frames after it was set.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from turnscan.ingest.devices.cameras.capture import Fetched
from turnscan.ingest.devices.cameras.live import LiveCamera
from turnscan.ingest.devices.cameras.watch import Limits
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.contracts import CameraInfo
from turnscan.schemas.errors import DeviceError

PERIOD_S = 0.02
LATENCY_S = 0.09


class Sensor:
    """Exposes a frame every period; it can be fetched ``LATENCY_S`` later, stamped with its exposure.

    The pixels of each image hold the exposure time that it was taken with, in units of 100 us; a new
    one holds two periods after it was set.
    """

    name = "sensor"

    def __init__(self, *, exposure_us: float | None = 1000.0) -> None:
        self.exposure_us = exposure_us
        self.refuse_above_us = 15_000.0
        self.frozen = threading.Event()
        self.bug = False
        self._at_ns = 0
        self._set: list[tuple[int, float]] = []

    def open(self) -> CameraInfo:
        self._at_ns = time.monotonic_ns()
        self._set = [(0, self.exposure_us or 3000.0)]
        known: dict[str, float | str] = (
            {} if self.exposure_us is None else {"exposure_us": self.exposure_us}
        )
        return CameraInfo(self.name, 16, 8, "mono8", known)

    def fetch(self) -> Fetched | None:
        if self.frozen.is_set():
            time.sleep(0.5)
            raise DeviceError("sensor: the driver gave up", hint="none")
        if self.bug:
            raise ZeroDivisionError("a bug")
        self._at_ns += round(PERIOD_S * 1e9)
        ready_ns = self._at_ns + round(LATENCY_S * 1e9)
        time.sleep(max(0.0, (ready_ns - time.monotonic_ns()) / 1e9))
        latched = [us for at_ns, us in self._set if at_ns <= self._at_ns - 2 * PERIOD_S * 1e9]
        image = np.full((8, 16), latched[-1] / 100, np.uint8)
        return Fetched(image, time.monotonic_ns(), self._at_ns)

    def set_exposure(self, exposure_us: float) -> float:
        if exposure_us > self.refuse_above_us:
            raise DeviceError(f"sensor: exposure_us: asked {exposure_us:g}, found 15000", hint="less")
        self._set.append((time.monotonic_ns(), exposure_us))
        return exposure_us

    def close(self) -> None:
        self.frozen.set()


@pytest.fixture
def sensor() -> Sensor:
    return Sensor()


@pytest.fixture
def camera(sensor: Sensor) -> Iterator[LiveCamera]:
    made = LiveCamera(sensor, SystemClock())
    made.open()
    yield made
    made.close()


def test_the_drivers_stamps_decide(camera: LiveCamera) -> None:
    clock = SystemClock()
    for pause_s in (0.0, 0.15, 0.05):
        time.sleep(pause_s)
        asked_ns = clock.now_ns()
        shot = camera.shoot(asked_ns)
        # Arrived LATENCY_S after its exposure, and yet stamped with the exposure itself.
        assert asked_ns <= shot.t_ns <= clock.now_ns() - 0.9 * LATENCY_S * 1e9
        # Stamps may be of the exposure's end: one period lies between.
        assert shot.t_ns - asked_ns >= PERIOD_S * 1e9
        assert shot.exposure_ns == 1_000_000


def test_stamps_of_a_stream_are_one_period_apart(camera: LiveCamera) -> None:
    clock = SystemClock()
    camera.shoot(clock.now_ns())
    begun_ns = clock.now_ns()
    shots = list(itertools.islice(camera.stream(), 12))
    # Those that were on their way already were exposed before.
    assert shots[0].t_ns >= begun_ns
    assert shots[0].dropped == 0
    steps_ns = np.diff([shot.t_ns for shot in shots])
    numbers = np.diff([shot.number for shot in shots])
    assert np.allclose(steps_ns, numbers * PERIOD_S * 1e9, atol=1e6)


def test_a_shot_has_the_exposure_asked(sensor: Sensor, camera: LiveCamera) -> None:
    clock = SystemClock()
    for asked_us, expected_us in [
        (4000.0, 4000),
        (8000.0, 8000),
        (None, 1000),
        (4000.0, 4000),
        (None, 1000),
    ]:
        shot = camera.shoot(clock.now_ns(), asked_us)
        assert shot.exposure_ns == expected_us * 1000
        assert int(shot.image[0, 0]) * 100 == expected_us


def test_an_exposure_refused_is_told_and_nothing_else_changes(camera: LiveCamera) -> None:
    clock = SystemClock()
    with pytest.raises(DeviceError, match="exposure_us: asked 20000, found 15000"):
        camera.shoot(clock.now_ns(), 20_000.0)
    shot = camera.shoot(clock.now_ns())
    assert shot.exposure_ns == 1_000_000
    assert int(shot.image[0, 0]) * 100 == 1000


def test_without_a_fixed_exposure_none_is_claimed() -> None:
    camera = LiveCamera(Sensor(exposure_us=None), SystemClock())
    camera.open()
    assert camera.shoot(SystemClock().now_ns()).exposure_ns is None
    camera.close()


def test_a_driver_that_hangs_is_noticed_by_the_one_who_asks(sensor: Sensor) -> None:
    camera = LiveCamera(sensor, SystemClock(), limits=Limits(stall_s=0.2))
    camera.open()
    camera.shoot(SystemClock().now_ns())
    sensor.frozen.set()
    # Before the driver itself gave up, half a second after it hung: that error has other words.
    with pytest.raises(DeviceError, match=r"no frame for 0\.\d s"):
        for _ in camera.stream():
            pass
    time.sleep(0.5)
    # The first finding stays.
    with pytest.raises(DeviceError, match="no frame for"):
        camera.shoot(SystemClock().now_ns())
    camera.close()


def test_a_bug_in_a_driver_is_not_hidden(sensor: Sensor, camera: LiveCamera) -> None:
    camera.shoot(SystemClock().now_ns())
    sensor.bug = True
    with pytest.raises(ZeroDivisionError):
        for _ in camera.stream():
            pass


def test_closing_ends_a_stream_that_waits(sensor: Sensor, camera: LiveCamera) -> None:
    shots = camera.stream()
    next(shots)
    closer = threading.Timer(0.1, camera.close)
    closer.start()
    with pytest.raises(DeviceError, match="closed"):
        for _ in shots:
            pass
    closer.join()


def test_too_slow_for_the_timeout(sensor: Sensor) -> None:
    camera = LiveCamera(sensor, SystemClock(), timeout_s=0.05)
    camera.open()
    with pytest.raises(DeviceError, match=r"no frame within 0\.1 s whose time of exposure is sure"):
        camera.shoot(SystemClock().now_ns())
    camera.close()
