"""The simulated camera keeps the contract: times, numbers, exposures, drops, and the true state."""

from __future__ import annotations

import itertools
import math
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.room.camera import QUEUE_FRAMES, FrameTruth, Look, SimulatedCamera
from turnscan.ingest.room.render import render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.schemas.calibration import Calibration
from turnscan.schemas.errors import DeviceError
from turnscan.schemas.events import Exposure, StripeTruth
from turnscan.schemas.scene import Light
from turnscan.schemas.truth import unpacked_truth
from turnscan.store.log_reader import ScanLog
from turnscan.store.log_writer import LogWriter

from .rigs import ball, paper, small_camera, wall


class SteppedClock:
    """A clock that moves only when somebody sleeps by it."""

    def __init__(self) -> None:
        self.t_ns = 1_000_000_000

    def now_ns(self) -> int:
        return self.t_ns

    def sleep_s(self, duration_s: float) -> None:
        self.t_ns += math.ceil(duration_s * 1e9)


def small() -> Calibration:
    return paper().model_copy(update={"camera": small_camera()})


def look(seed: int = 4) -> Look:
    return Look(Scene([*wall().shapes, ball((0, 1200, 0), 200)]), SimulatedRig(small()), seed=seed)


def turning(t_ns: int) -> float:
    """A table that turns by a radian a second."""
    return (t_ns - 1_000_000_000) / 1e9


def camera(clock: SteppedClock | SystemClock, **settings: float) -> SimulatedCamera:
    return SimulatedCamera(
        look(),
        clock,
        actual_angle_rad=turning,
        lasers_lit=lambda t_ns: [0] if t_ns < 3_000_000_000 else [],
        **settings,
    )


def test_a_frame_shows_what_the_middle_of_its_exposure_saw() -> None:
    clock = SteppedClock()
    made = camera(clock, exposure_us=20_000)
    info = made.open()
    assert (info.width_px, info.height_px, info.encoding) == (160, 120, "mono8")
    assert info.settings["exposure_us"] == 20_000
    shot = made.shoot(1_500_000_000)
    assert shot.t_ns == 1_510_000_000
    assert clock.now_ns() >= 1_520_000_000, "a frame is there when its exposure is over"
    assert (shot.number, shot.dropped, shot.exposure_ns) == (0, 0, 20_000_000)
    a = look()
    expected = render(a.scene, a.rig, turning(shot.t_ns), seed=4, frame=0, exposure_us=20_000)
    assert shot.image.tobytes() == expected.image.tobytes()
    assert shot.truth.angle_rad == turning(shot.t_ns)
    assert np.array_equal(shot.truth.lasers[0].u_px, expected.truth[0].u_px)
    # The lasers go off at 3 s.
    assert list(made.shoot(2_995_000_000).truth.lasers) == []
    made.close()
    made.close()
    with pytest.raises(DeviceError, match="it is not open"):
        made.shoot(0)


def test_bracketing_changes_one_frame() -> None:
    made = camera(SteppedClock(), exposure_us=10_000)
    made.open()
    means = [made.shoot(0, us).image.mean() for us in (None, 40_000, None)]
    assert means[1] > 3 * means[0]
    assert means[2] == pytest.approx(means[0], rel=0.1)


def test_a_triggered_camera_gives_the_same_frames_again() -> None:
    runs = []
    for _ in range(2):
        made = camera(SteppedClock())
        made.open()
        runs.append([made.shoot(0) for _ in range(4)])
        made.close()
    assert [s.image.tobytes() for s in runs[0]] == [s.image.tobytes() for s in runs[1]]
    assert [s.number for s in runs[0]] == [0, 1, 2, 3]
    assert len({s.image.tobytes() for s in runs[0]}) == 4


def test_a_free_running_source_drains_older_frames() -> None:
    clock = SteppedClock()
    made = camera(clock, fps=10.0, exposure_us=10_000)
    made.open()
    clock.sleep_s(0.65)
    shot = made.shoot(clock.now_ns())
    # Frames begin at 0, 100, ... ms after opening: the first one from now on is the seventh after it.
    assert shot.number == 7
    assert shot.t_ns == 1_000_000_000 + 705_000_000
    assert shot.dropped == 0, "drained on purpose is not lost"
    assert made.shoot(clock.now_ns()).number == 8


def test_a_frame_in_the_far_future_is_not_waited_for() -> None:
    clock = SteppedClock()
    made = camera(clock, timeout_s=2.0)
    made.open()
    with pytest.raises(DeviceError, match=r"asked for in 60.0 s, the longest wait is 2 s"):
        made.shoot(clock.now_ns() + 60_000_000_000)


def test_a_triggered_stream_is_one_exposure_after_another() -> None:
    made = camera(SteppedClock(), exposure_us=5000)
    made.open()
    shots = list(itertools.islice(made.stream(), 5))
    assert [s.number for s in shots] == [0, 1, 2, 3, 4]
    assert np.diff([s.t_ns for s in shots]).min() >= 5_000_000


def frame_threads() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name == "simulated camera"]


def test_a_source_waits_for_nobody_and_counts_what_is_lost() -> None:
    clock = SystemClock()
    made = SimulatedCamera(
        look(),
        clock,
        actual_angle_rad=lambda _: 0.3,
        lasers_lit=lambda _: [0],
        exposure_us=1000,
        fps=50.0,
    )
    made.open()
    source = made.stream()
    shots = [next(source) for _ in range(5)]
    time.sleep(0.5)
    shots += [next(source) for _ in range(QUEUE_FRAMES + 6)]
    source.close()
    assert not frame_threads(), "closing the iterator ends the thread"
    numbers = [s.number for s in shots]
    # What is missing between two frames is what the later one says was lost.
    assert [b - a - 1 for a, b in itertools.pairwise(numbers)] == [s.dropped for s in shots[1:]]
    # 25 frames came in half a second; the queue holds four of them.
    assert sum(s.dropped for s in shots[5:]) >= 25 - QUEUE_FRAMES - 5
    grid = [s.t_ns - n * 20_000_000 for s, n in zip(shots, numbers, strict=True)]
    assert len(set(grid)) == 1, "times are the source's, not the reader's"
    assert shots[-1].image.tobytes() == (
        render(
            look().scene, look().rig, 0.3, seed=4, frame=numbers[-1], exposure_us=1000
        ).image.tobytes()
    )
    assert made.shoot(clock.now_ns()).number > numbers[-1]
    made.close()


def test_what_goes_wrong_in_the_source_reaches_the_reader() -> None:
    def broken(t_ns: int) -> float:
        raise DeviceError("the emulator is gone")

    made = SimulatedCamera(
        look(), SystemClock(), actual_angle_rad=broken, lasers_lit=lambda _: [], fps=100.0
    )
    made.open()
    with pytest.raises(DeviceError, match="the emulator is gone"):
        next(made.stream())
    assert not frame_threads()


def test_a_source_that_is_too_slow_is_an_error_in_time() -> None:
    made = SimulatedCamera(
        look(),
        SystemClock(),
        actual_angle_rad=lambda _: 0.0,
        lasers_lit=lambda _: [],
        exposure_us=400_000,
        fps=2.0,
        timeout_s=0.1,
    )
    made.open()
    with pytest.raises(DeviceError, match=r"no frame within 0\.1 s"):
        next(made.stream())
    assert not frame_threads()


def test_truth_goes_into_the_log_and_comes_back_exactly(tmp_path: Path) -> None:
    clock = SteppedClock()
    made = SimulatedCamera(
        Look(look().scene, look().rig, light=Light(ambient_dn=3)),
        clock,
        actual_angle_rad=turning,
        lasers_lit=lambda _: [0],
    )
    made.open()
    shots = [made.shoot(0) for _ in range(2)]
    path = tmp_path / "scan.mcap"
    with LogWriter(path) as writer:
        for shot in shots:
            exposure = Exposure(t_ns=shot.t_ns, frame=shot.number, lasers_on=(0,))
            writer.write_image(exposure, shot.image)
            assert isinstance(shot.truth, FrameTruth)
            for event in shot.truth.events(t_ns=shot.t_ns, frame=shot.number):
                writer.write_event(event)
    found = [item for item in ScanLog(path).items() if isinstance(item, StripeTruth)]
    assert [event.frame for event in found] == [0, 1]
    for event, shot in zip(found, shots, strict=True):
        assert event.t_ns == shot.t_ns
        assert event.angle_rad == shot.truth.angle_rad
        columns, truth = unpacked_truth(event), shot.truth.lasers[0]
        assert columns["u_px"].tobytes() == truth.u_px.tobytes()
        assert columns["z_mm"].tobytes() == np.ascontiguousarray(truth.points_mm[:, 2]).tobytes()
        assert columns["row"].tolist() == truth.row.tolist()
        assert columns["surface"].tolist() == truth.surface.tolist()
