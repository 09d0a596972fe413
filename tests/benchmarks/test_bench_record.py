"""Recording under load: a camera that waits for nobody, the log, and extraction beside it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bench import calibration, frames

from turnscan.ingest.devices.building import build_controller, build_emulator
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.contracts import CameraInfo, Clock, Shot
from turnscan.ingest.session.interrupts import Interrupts
from turnscan.ingest.session.order import Begun, Devices, Order
from turnscan.ingest.session.session import SerialLines, record
from turnscan.process.live import LiveExtraction
from turnscan.process.pipeline import LiveStart
from turnscan.schemas.events import ScanEnd
from turnscan.schemas.recipe import BUILT_IN
from turnscan.schemas.rig import LaserSettings, ScanSettings, TurntableSettings
from turnscan.store import Archive
from turnscan.store.log_reader import LogFrame

pytestmark = pytest.mark.benchmark

SECONDS = 20.0
QUEUE = 4


class Impatient:
    """Frames made beforehand, one every 1/fps seconds; of those that nobody fetches four are kept."""

    def __init__(self, images: list[np.ndarray], fps: float, clock: Clock) -> None:
        self._images, self._fps, self._clock = images, fps, clock

    def open(self) -> CameraInfo:
        height, width = self._images[0].shape
        return CameraInfo("impatient", width, height, "mono8", {"fps": self._fps})

    def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
        return next(self.stream())

    def stream(self) -> Iterator[Shot]:
        queue: deque[Shot] = deque()
        ready, ended = threading.Condition(), threading.Event()

        def run() -> None:
            lost, began = 0, time.monotonic()
            for n in range(10**9):
                time.sleep(max(0.0, began + n / self._fps - time.monotonic()))
                if ended.is_set():
                    return
                with ready:
                    if len(queue) >= QUEUE:
                        lost += 1
                        continue
                    # A fresh copy, as a driver's buffer is.
                    image = self._images[n % len(self._images)].copy()
                    queue.append(Shot(self._clock.now_ns(), image, n, dropped=lost))
                    lost = 0
                    ready.notify()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        try:
            while True:
                with ready:
                    if not ready.wait_for(lambda: queue, 2.0):
                        return
                    shot = queue.popleft()
                yield shot
        finally:
            ended.set()
            thread.join()

    def close(self) -> None:
        return


@pytest.mark.parametrize(("width", "height", "fps"), [(1280, 1024, 30.0), (640, 480, 120.0)])
def test_twenty_seconds_without_a_pause(tmp_path: Path, width: int, height: int, fps: float) -> None:
    archive = Archive.init(tmp_path / "lab")
    clock = SystemClock()
    table = TurntableSettings(driver="simulated", gear_ratio=10.0, settle_ms=0.0)
    document = calibration(width, height)
    order = Order(
        rig="r1",
        lasers=(0,),
        scan=ScanSettings(mode="continuous", to_deg=9.0 * SECONDS, speed_deg_s=9.0),
        calibration=document,
    )
    made: list[LiveExtraction] = []

    def beside(begun: Begun) -> LiveExtraction:
        start = LiveStart(begun.scan, "0", BUILT_IN["default"], document, width, height)
        made.append(LiveExtraction(archive.root, start))
        return made[0]

    behind: list[int] = []
    lines = SerialLines()
    with build_emulator(table, clock) as emulator, Interrupts() as interrupts:
        controller = build_controller(
            table, (LaserSettings(number=0, output=1),), clock, port=emulator.port, heard=lines
        )
        camera = Impatient(frames(20, width, height), fps, clock)
        cpu = time.process_time()
        result = record(
            archive,
            order,
            Devices(clock, controller, controller, camera),
            lines,
            interrupts=interrupts,
            make_beside=beside,
            show=lambda p: behind.append(p.frames - made[0].look().frames),
        )
        cpu = time.process_time() - cpu
        outcome = made[0].sealed()
        controller.close()
    assert result.error is None
    assert result.scan is not None
    print(f"\n{width} x {height} at {fps:g} frames/s for {SECONDS:g} s, writing and extracting")
    print(
        f"  frames {result.frames}, dropped {result.dropped} ({result.dropped / fps:.2f} s of frames)"
    )
    print(f"  recorder's CPU {cpu / SECONDS:.2f} of a core; log {result.scan.log_bytes / 1e6:.0f} MB")
    assert made[0].failure is None
    assert outcome is not None
    stripes = next(m for m in archive.derivations() if m.kind == "stripes")
    last = max(i.t_ns for i in archive.log(result.scan.scan).items() if isinstance(i, LogFrame))
    sealed_s = (stripes.created_ns - last) / 1e9
    print(f"  extraction at most {max(behind)} frames behind; stripes {sealed_s:.2f} s after the last")
    assert outcome.frames == result.frames
    # What was lost was counted: by the recording, and in the log itself.
    (end,) = [i for i in archive.log(result.scan.scan).items() if isinstance(i, ScanEnd)]
    assert end.frames == result.frames
    assert (f"{result.dropped} frames dropped" in end.note) == (result.dropped > 0)
    assert result.frames + result.dropped >= 0.95 * fps * SECONDS
