"""Continuous rotation: the table turns at a steady speed while every frame of the camera is kept.

Frames arrive in a thread of their own; this thread asks the controller where it is. Which angle belongs
to which frame is decided when processing, from the reports before and after its exposure.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from ...schemas.errors import DeviceError, TurnscanError
from ..devices.contracts import Position, Shot
from .floor import Floor
from .plan import Sweep

_ASK_EVERY_S: Final = 0.015
#: A report may be this much older or younger than its time says; slower ones are asked for again.
_SURE_NS: Final = 2_000_000
_LONGEST_GAP_NS: Final = 300_000_000
#: A report counts as the end of the sweep within this of its end angle.
_THERE_RAD: Final = math.radians(0.5)


def turn_through(floor: Floor, sweeps: Sequence[Sweep]) -> None:
    """Turn every sweep with its lasers lit; before the first, one off frame if the plan wants it.

    Raises
    ------
    DeviceError
        The turntable gives no reports or stalls, the camera stalls, or either fails.
    """
    devices, scan = floor.devices, floor.order.scan
    if not devices.turntable.reports_position:
        raise DeviceError(
            "this turntable does not report its position, which continuous rotation needs",
            hint='use mode = "step"',
        )
    total = sum(s.span_rad for s in sweeps)
    done = 0.0
    for sweep in sweeps:
        with floor.interrupts.let_in():
            start = devices.turntable.move_to(sweep.from_rad)
        floor.angle(sweep.from_rad, start)
        if scan.off_frame:
            with floor.interrupts.let_in():
                shot = devices.camera.shoot(devices.clock.now_ns())
            floor.frame(shot, (), None, wait=True)
            floor.recorder.settle(devices.clock.now_ns())
        floor.light(sweep.lasers)
        _sweep(floor, sweep, done, total)
        floor.light(())
        floor.recorder.settle(devices.clock.now_ns())
        done += sweep.span_rad


class Due:
    """Which frames are kept where fewer are wanted than the camera gives, and which of these it lost.

    Frames are due at equal times; of each the first one after it is kept.
    """

    def __init__(self, max_fps: float | None) -> None:
        self._between_ns = None if max_fps is None else 1e9 / max_fps
        self._due_ns: float | None = None
        self._lost = 0

    def take(self, shot: Shot) -> Shot | None:
        """``shot`` if it is kept; it then says how many were lost before it that were due."""
        between_ns = self._between_ns
        if between_ns is None:
            return shot
        due_ns = shot.t_ns if self._due_ns is None else self._due_ns
        self._lost += shot.dropped
        if shot.t_ns < due_ns:
            return None
        lost = min(int((shot.t_ns - due_ns) // between_ns), self._lost)
        self._lost = 0
        self._due_ns = max(due_ns + (lost + 1) * between_ns, shot.t_ns + between_ns / 2)
        return replace(shot, dropped=lost)


class _Frames:
    """The camera's stream, taken by a thread until told to end."""

    def __init__(self, floor: Floor, lasers: tuple[int, ...]) -> None:
        self._floor = floor
        self._lasers = lasers
        self._end = threading.Event()
        self.newest_ns = -1
        self.heard_at = time.monotonic()
        self.count = 0
        self.failure: TurnscanError | None = None
        self._thread = threading.Thread(target=self._take, name="frames", daemon=True)
        self._thread.start()

    def _take(self) -> None:
        due = Due(self._floor.order.scan.max_fps)
        stream = self._floor.devices.camera.stream()
        try:
            for shot in stream:
                if self._end.is_set():
                    break
                self.heard_at = time.monotonic()
                self.count += 1
                self.newest_ns = shot.t_ns
                kept = due.take(shot)
                if kept is not None:
                    self._floor.frame(kept, self._lasers, None, wait=False)
            else:
                self.failure = DeviceError(
                    f"the camera's stream ended after {self.count} frames",
                    hint="is it still plugged in? a recorded source must be as long as the turn",
                )
        except TurnscanError as error:
            self.failure = error
        finally:
            close = getattr(stream, "close", None)
            if close is not None:
                close()

    def end(self, wait_s: float) -> None:
        """Stop taking frames."""
        self._end.set()
        self._thread.join(wait_s)


def _sweep(floor: Floor, sweep: Sweep, done_rad: float, total_rad: float) -> None:
    devices, order = floor.devices, floor.order
    speed = math.radians(order.scan.speed_deg_s)
    frames = _Frames(floor, sweep.lasers)
    try:
        _await_first(floor, frames)
        with floor.interrupts.let_in():
            standing = devices.turntable.position()
        # Marked as turning: from here on frames lie between two reports, not at rest.
        floor.angle(sweep.to_rad, replace(standing, moving=True))
        with floor.interrupts.let_in():
            devices.turntable.start_move(sweep.to_rad, speed)
        _watch(floor, sweep, frames, done_rad, total_rad)
    finally:
        frames.end(2 * order.stall_s)


def _await_first(floor: Floor, frames: _Frames) -> None:
    """The table starts when the camera has: no angle goes without a frame."""
    while frames.count == 0:
        _check_frames(floor, frames)
        with floor.interrupts.let_in():
            floor.devices.clock.sleep_s(_ASK_EVERY_S / 3)


def _watch(floor: Floor, sweep: Sweep, frames: _Frames, done_rad: float, total_rad: float) -> None:
    """Log the table's reports until it stands at the end of the sweep."""
    devices = floor.devices
    moved_at = time.monotonic()
    last: Position | None = None
    reports = _Reports(floor, sweep)
    while True:
        with floor.interrupts.let_in():
            asked_ns = devices.clock.now_ns()
            position = devices.turntable.position()
            took_ns = devices.clock.now_ns() - asked_ns
        reports.take(position, took_ns)
        there = abs(position.angle_rad - sweep.to_rad) <= _THERE_RAD
        now = time.monotonic()
        if last is None or position.angle_rad != last.angle_rad:
            moved_at = now
        if not position.moving and there:
            _catch_up(floor, frames, position.t_ns)
            return
        if now - moved_at > floor.order.stall_s:
            raise DeviceError(
                f"the turntable stands at {math.degrees(position.angle_rad):.2f} deg on its way to "
                f"{math.degrees(sweep.to_rad):.2f} deg",
                hint="is it blocked, or the motor's current too low?",
            )
        _check_frames(floor, frames)
        floor.recorder.settle(min(reports.last_ns, frames.newest_ns))
        floor.keep_alive()
        floor.progress(done_rad + abs(position.angle_rad - sweep.from_rad), total_rad)
        last = position
        with floor.interrupts.let_in():
            devices.clock.sleep_s(_ASK_EVERY_S)


class _Reports:
    """Of the reports of a turning table, those whose time is sure.

    A report is true of some moment between question and answer. Where that took unusually long (the
    machine was busy), the angle could be off by as much turning: between two good reports a line is
    better than a bad one.
    """

    def __init__(self, floor: Floor, sweep: Sweep) -> None:
        self._floor = floor
        self._sweep = sweep
        self._best_ns: int | None = None
        #: Time of the last report that was taken.
        self.last_ns = -1

    def take(self, position: Position, took_ns: int) -> None:
        """Log the report, unless its time is unsure and another will come soon enough."""
        best = took_ns if self._best_ns is None else min(self._best_ns, took_ns)
        self._best_ns = best
        unsure = took_ns > best + 2 * _SURE_NS
        if unsure and position.moving and position.t_ns - self.last_ns < _LONGEST_GAP_NS:
            return
        self._floor.angle(self._sweep.to_rad, position)
        self.last_ns = position.t_ns


def _catch_up(floor: Floor, frames: _Frames, until_ns: int) -> None:
    """Frames exposed before the table stood still may still be on their way."""
    while frames.newest_ns < until_ns:
        _check_frames(floor, frames)
        with floor.interrupts.let_in():
            floor.devices.clock.sleep_s(_ASK_EVERY_S / 3)
    floor.recorder.settle(until_ns)


def _check_frames(floor: Floor, frames: _Frames) -> None:
    if frames.failure is not None:
        raise frames.failure
    if time.monotonic() - frames.heard_at > floor.order.stall_s:
        raise DeviceError(
            f"no frame for {floor.order.stall_s:g} s (so far {frames.count})",
            hint="turnscan rig check takes one frame and says what is wrong",
        )
