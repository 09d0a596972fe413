"""Continuous rotation: interpolated angles against the truth, stalls, interrupts, going on later."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from turnscan.ingest.devices.contracts import Shot
from turnscan.ingest.session.earlier import read_earlier
from turnscan.ingest.session.order import Devices
from turnscan.ingest.session.turning import Due
from turnscan.process.pairing import pair_frames
from turnscan.schemas.errors import DeviceError
from turnscan.schemas.events import DeviceLine, ScanEnd, StripeTruth, TurntableAngle
from turnscan.store import Archive

from .rigs import Ran, order_of, rig, run

DIALECTS = ("turnscan", "horus", "grbl")


def continuous(folder: Path, dialect: str = "turnscan", **more: Any) -> Any:
    scan = {"mode": "continuous", "to_deg": 60, "speed_deg_s": 30, **more.pop("scan", {})}
    return rig(
        folder,
        dialect=dialect,
        # A controller that lets one wait is another test's subject, a busy machine is none.
        turntable={"timeout_s": 2.0, **more.pop("turntable", {})},
        camera={"fps": 60, "timeout_s": 2.0},
        simulated={"time_scale": 1},
        **scan,
        **more,
    )


def bounded_errors_rad(ran: Ran, speed_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Paired angle minus the emulator's true one, of frames at full speed, and how large it may be.

    A report is true of some moment between question and answer, whose times stand in the log: on a
    busy machine they lie far apart, and so may angles be.
    """
    items = ran.items()
    truth = {i.frame: i.angle_rad for i in items if isinstance(i, StripeTruth)}
    reports = [i for i in items if isinstance(i, TurntableAngle)]
    asked = np.array([i.t_ns for i in items if isinstance(i, DeviceLine) and i.direction == "sent"])
    told = np.array([i.t_ns for i in items if isinstance(i, DeviceLine) and i.direction == "received"])
    times = np.array([r.t_ns for r in reports])
    before = asked[np.maximum(np.searchsorted(asked, times, "right") - 1, 0)]
    after = told[np.minimum(np.searchsorted(told, times), len(told) - 1)]
    unsure_s = np.maximum(times - before, after - times) / 1e9
    errors, bounds = [], []
    for lit in pair_frames(_of_pairing(ran), with_background=False):
        n = int(np.searchsorted(times, lit.t_ns))
        ends = reports[max(n - 1, 0) : n + 1]
        if all(r.moving and 2 < math.degrees(r.reported_rad or 0) < 58 for r in ends):
            errors.append(lit.angle_rad - truth[lit.frame])
            bounds.append(speed_rad_s * max(unsure_s[max(n - 1, 0) : n + 1]))
    return np.array(errors), np.array(bounds)


def _of_pairing(ran: Ran) -> Iterator[Any]:
    return (i for i in ran.items() if isinstance(i, TurntableAngle) or hasattr(i, "decode"))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_interpolated_angle_is_the_true_one(lab: Archive, tmp_path: Path, dialect: str) -> None:
    ran = run(lab, continuous(tmp_path, dialect))
    assert ran.error is None
    assert ran.result is not None
    assert ran.result.error is None
    assert ran.result.scan is not None
    assert ran.result.scan.ended == "complete"
    errors, bounds = bounded_errors_rad(ran, math.radians(30))
    assert len(errors) > 10
    # A microstep of the table more: what it reports is whole ones.
    assert np.all(np.abs(errors) <= bounds + math.radians(0.02))
    angles = [p.angle_rad for p in pair_frames(_of_pairing(ran), with_background=False)]
    assert math.degrees(max(angles)) == pytest.approx(60, abs=0.2)


def test_frames_beyond_max_fps_are_not_kept_and_not_called_lost(lab: Archive, tmp_path: Path) -> None:
    few = run(lab, continuous(tmp_path, scan={"max_fps": 20}))
    assert few.result is not None
    times_s = np.array([f.t_ns for f in few.frames()]) / 1e9
    # 20 a second of the camera's 60. A machine under load may lose some: they are counted then.
    wanted = (times_s[-1] - times_s[0]) * 20 + 1
    assert few.result.frames + few.result.dropped == pytest.approx(wanted, abs=0.1 * wanted)
    assert min(np.diff(times_s)) > 0.02


def shot(t_ms: float, dropped: int = 0) -> Shot:
    return Shot(round(t_ms * 1e6), np.zeros((2, 2), np.uint8), 0, dropped=dropped)


def test_of_the_frames_that_a_camera_lost_those_count_that_were_due() -> None:
    due = Due(20.0)
    given = [(1000.0, 3), (1020.0, 0), (1049.0, 2), (1051.0, 0), (1260.0, 12), (1290.0, 1), (1301.0, 0)]
    kept = [(t, due.take(shot(t, lost))) for t, lost in given]
    # Due every 50 ms from 1000 on: of those at 1100, 1150 and 1200 there is nothing.
    found = [(t, s.dropped) for t, s in kept if s]
    assert found == [(1000.0, 0), (1051.0, 0), (1260.0, 3), (1301.0, 0)]
    every = Due(None)
    assert [s.dropped for s in (every.take(shot(*g)) for g in given) if s] == [3, 0, 2, 0, 12, 1, 0]


def test_an_off_frame_before_the_turn_serves_all_of_it(lab: Archive, tmp_path: Path) -> None:
    ran = run(lab, continuous(tmp_path, scan={"off_frame": True}))
    frames = ran.frames()
    assert [bool(f.lasers_on) for f in frames[:2]] == [False, True]
    pairs = list(pair_frames(_of_pairing(ran), with_background=True))
    assert len(pairs) == len(frames) - 1
    assert all(p.background is not None for p in pairs)


class StallingCamera:
    """The simulated camera, whose stream says nothing more after some frames."""

    def __init__(self, camera: Any, after: int, how: str) -> None:
        self._camera = camera
        self._after = after
        self._how = how

    def stream(self) -> Iterator[Shot]:
        for n, shot in enumerate(self._camera.stream()):
            if n >= self._after:
                if self._how == "ends":
                    return
                if self._how == "interrupts":
                    os.kill(os.getpid(), signal.SIGINT)
                else:
                    time.sleep(3.0)
            yield shot

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


def stalling(after: int, how: str) -> Any:
    def wrap(devices: Devices) -> Devices:
        return replace(devices, camera=StallingCamera(devices.camera, after, how))

    return wrap


@pytest.mark.parametrize(("how", "said"), [("stalls", "no frame for 2 s"), ("ends", "stream ended")])
def test_a_stream_that_stalls_or_ends_is_noticed(
    lab: Archive, tmp_path: Path, how: str, said: str
) -> None:
    ran = run(lab, continuous(tmp_path, scan={"to_deg": 300}), wrap=stalling(20, how))
    assert ran.result is not None
    assert isinstance(ran.result.error, DeviceError)
    assert said in str(ran.result.error)
    assert ran.result.scan is not None
    assert ran.result.scan.ended == "interrupted"
    assert ran.result.scan.frames == 20


def test_a_table_that_stalls_is_noticed(lab: Archive, tmp_path: Path) -> None:
    fault = {"kind": "stall", "at": 2}
    ran = run(lab, continuous(tmp_path, faults=(fault,), scan={"from_deg": 0}))
    error = ran.error or (ran.result and ran.result.error)
    assert isinstance(error, DeviceError)
    assert "stands at" in str(error)


def test_interrupted_and_taken_up_again_no_angle_is_missing(lab: Archive, tmp_path: Path) -> None:
    document = continuous(tmp_path)
    first = run(lab, document, wrap=stalling(30, "interrupts"))
    assert first.result is not None
    assert first.result.interrupted
    assert first.result.scan is not None
    earlier, plan = read_earlier(lab, [first.result.scan])
    assert plan == document.scan
    second = run(lab, document, order=order_of(document, earlier=earlier))
    assert second.result is not None
    assert second.result.scan is not None
    assert second.result.scan.continues == first.result.scan.scan
    (end,) = [i for i in second.items() if isinstance(i, ScanEnd)]
    assert end.ended == "complete"
    angles = sorted(
        math.degrees(p.angle_rad)
        for ran in (first, second)
        for p in pair_frames(_of_pairing(ran), with_background=False)
    )
    assert angles[0] == pytest.approx(0, abs=0.2)
    assert angles[-1] == pytest.approx(60, abs=0.2)
    # Frames come every half degree; where the second begins it stands for a moment, as at the start.
    lost = sum(ran.result.dropped for ran in (first, second) if ran.result is not None)
    assert max(np.diff(angles)) < 3.0 + 0.5 * lost
    numbers = [f.frame for ran in (first, second) for f in ran.frames()]
    assert numbers == list(range(len(numbers))), "frames of both logs are numbered through"
