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
from turnscan.process.pairing import pair_frames
from turnscan.schemas.errors import DeviceError
from turnscan.schemas.events import ScanEnd, StripeTruth, TurntableAngle
from turnscan.store import Archive

from .rigs import Ran, order_of, rig, run

DIALECTS = ("turnscan", "horus", "grbl")


def continuous(folder: Path, dialect: str = "turnscan", **more: Any) -> Any:
    scan = {"mode": "continuous", "to_deg": 60, "speed_deg_s": 30, **more.pop("scan", {})}
    return rig(
        folder,
        dialect=dialect,
        camera={"fps": 60, "timeout_s": 1.0},
        simulated={"time_scale": 1},
        **scan,
        **more,
    )


def angle_errors_rad(ran: Ran) -> np.ndarray:
    """Paired angle minus the emulator's true one, of every lit frame."""
    truth = {i.frame: i.angle_rad for i in ran.items() if isinstance(i, StripeTruth)}
    left_out: list[int] = []
    pairs = list(pair_frames(_of_pairing(ran), with_background=False, left_out=left_out))
    assert len(pairs) + len(left_out) == len(truth)
    return np.array([p.angle_rad - truth[p.frame] for p in pairs])


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
    errors = np.degrees(angle_errors_rad(ran))
    turning = [i for i in ran.items() if isinstance(i, TurntableAngle) and i.moving]
    assert len(turning) > 10
    # At 30 deg/s, 0.15 deg are 5 ms: less than a third of the time from frame to frame. Where the
    # table starts and stops, or the machine was busy elsewhere, single frames are farther off.
    assert np.quantile(np.abs(errors), 0.9) < 0.15
    assert np.median(np.abs(errors)) < 0.05
    angles = [p.angle_rad for p in pair_frames(_of_pairing(ran), with_background=False)]
    assert math.degrees(max(angles)) == pytest.approx(60, abs=0.2)


def test_frames_beyond_max_fps_are_not_kept_and_not_called_lost(lab: Archive, tmp_path: Path) -> None:
    every = run(lab, continuous(tmp_path))
    few = run(lab, continuous(tmp_path, scan={"max_fps": 20}))
    assert few.result is not None
    # Two of three are not kept. A machine under load may lose a few besides, and then says so.
    assert few.result.dropped < 0.3 * few.result.frames
    assert every.result is not None
    assert 0.25 < few.result.frames / (every.result.frames + every.result.dropped) < 0.42


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
                    time.sleep(1.5)
            yield shot

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


def stalling(after: int, how: str) -> Any:
    def wrap(devices: Devices) -> Devices:
        return replace(devices, camera=StallingCamera(devices.camera, after, how))

    return wrap


@pytest.mark.parametrize(("how", "said"), [("stalls", "no frame for 1 s"), ("ends", "stream ended")])
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
    assert max(np.diff(angles)) < 3.0
    numbers = [f.frame for ran in (first, second) for f in ran.frames()]
    assert numbers == list(range(len(numbers))), "frames of both logs are numbered through"
