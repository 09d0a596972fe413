"""The ``grbl`` dialect: Grbl 1.1, its millimetre a degree. ``ok`` to G1 means planned, no more."""

from __future__ import annotations

import re
import time

from ....schemas.errors import DeviceError
from ..contracts import DeviceInfo
from ..serial_link import SerialLink
from .contract import Setup, Status
from .gcode_lines import GcodeLines

_BANNER = re.compile(r"^Grbl 1\.1")
#: Between G1's ok and the first step a report may still say Idle.
_STARTS_S = 0.3
_RESTS = ("Idle", "Hold:0", "Alarm", "Sleep", "Check")


class GrblDialect:
    """Machine coordinates (G53), so that no work offset left in the board turns the table elsewhere."""

    sees_missed_steps = False

    def __init__(self, link: SerialLink, setup: Setup) -> None:
        self._link = link
        self._setup = setup
        self._lines = GcodeLines(link, wanted="Grbl 1.1 firmware", banner=_BANNER, barrier="")
        self._asleep = False
        self._target_deg: float | None = None
        self._started = 0.0
        self._power = 1000.0

    def wake(self) -> DeviceInfo:
        """Reset, banner, unlock, settings; ``$1=255`` holds the motor."""
        s, lines = self._setup, self._lines
        self._target_deg = None
        lines.origin_lost = False
        lines.settle()
        self._awake()
        torn = lines.origin_lost
        lines.origin_lost = False
        have = lines.set(
            {
                1: 255,
                10: 1,
                13: 0,
                32: 0,
                100: s.microsteps_per_degree,
                110: max(s.speed_deg_s * 60, lines.settings().get(110, 0.0)),
                120: s.acceleration_deg_s2,
            }
        )
        self._power = have.get(30, 1000.0)
        lines.command("G21 G90 G94")
        lines.command("M5")
        angle = lines.report().angle_deg
        kept = "no" if torn else "yes" if abs(angle) > 0.001 else "unknown"
        return DeviceInfo("Grbl 1.1", {"position_kept": kept, "missed_steps": "not seen"})

    def _awake(self) -> None:
        self._lines.reset()
        self._lines.unlock()
        self._asleep = False

    def hold(self) -> None:
        """Wake from ``$SLP``; awake, the motor is held."""
        if self._asleep:
            self._awake()

    def release(self) -> None:
        """``$SLP``: motor and laser without current until the next reset."""
        self.stop()
        if not self._asleep:
            self._lines.unlock()
            self._lines.command("$SLP")
            self._asleep = True

    def start(self, angle_deg: float, speed_deg_s: float) -> None:
        """G53 G1; planned when this returns."""
        self._lines.in_step()
        self._lines.refuse_lost()
        self.hold()
        self._target_deg = angle_deg
        self._started = time.monotonic()
        self._lines.command(f"G53 G1 X{angle_deg:.4f} F{speed_deg_s * 60:.3f}")

    def status(self, *, waiting: bool = False) -> Status:
        """``?``: a motion has ended when the board is idle and stands where it was sent."""
        lines = self._lines
        report = lines.any_report() if waiting and self._target_deg is not None else lines.report()
        if self._target_deg is not None and report.state == "Idle" and waiting:
            report = lines.report()  # the last one must not be an old one
        if report.state in ("Alarm", "Sleep"):
            self._target_deg = None
            if report.state == "Alarm":
                lines.origin_lost = lines.locked = True
                lines.refuse_lost()
        moving = report.state not in _RESTS
        if self._target_deg is not None and not moving:
            there = abs(report.angle_deg - self._target_deg) <= 0.6 / self._setup.microsteps_per_degree
            if there or time.monotonic() - self._started > _STARTS_S:
                self._target_deg = None
            else:
                moving = True
        return Status(report.t_ns, report.angle_deg, moving)

    def stop(self) -> None:
        """Feed hold; once it rests, a reset forgets the rest of the motion, and the count is kept."""
        if self._target_deg is None:
            return
        lines = self._lines
        until = time.monotonic() + self._link.timeout_s + self._braking_s()
        while time.monotonic() < until:
            try:
                state = lines.any_report().state
                if state in ("Hold:0", "Alarm", "Sleep"):
                    break
                if state != "Hold:1":  # a hold that comes before the first step may not be heeded
                    lines.feed_hold()
            except DeviceError:
                if not self._link.is_open:
                    raise
                break
        self._target_deg = None
        self._awake()

    def _braking_s(self) -> float:
        return self._setup.speed_deg_s / self._setup.acceleration_deg_s2

    def laser(self, output: int, *, on: bool) -> None:  # noqa: ARG002 - Grbl has one
        """M3 at full power, or M5. Both wait for the motion's end: to go dark, it is stopped."""
        if self._target_deg is not None and self.status().moving:
            if on:
                raise DeviceError(
                    "the board switches lasers only while the table stands",
                    hint="switch them on before the motion",
                )
            self.stop()
        if self._asleep:
            if not on:
                return
            self._awake()
        self._lines.command(f"M3 S{self._power:g}" if on else "M5")

    def dark(self) -> None:
        """A reset stops the spindle's pin."""
        self._target_deg = None
        self._awake()

    def keep_alive(self) -> None:
        """Grbl has no cut-off timer: nothing to reset."""
