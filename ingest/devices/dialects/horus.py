"""The ``horus`` dialect: Horus firmware 0.2 of Ciclop boards. ``ok`` to G1: it has ended."""

from __future__ import annotations

import re
import time

from ....schemas.errors import DeviceError
from ..contracts import DeviceInfo
from ..serial_link import SerialLink
from .contract import Setup, Status
from .gcode_lines import GcodeLines, Report

#: The firmware cuts a laser off so long after it was lit; only M70 resets the timer.
CUT_OFF_S = 255.0
_MARGIN_S = 15.0
_BANNER = re.compile(r"^Horus 0\.2 ")


class HorusDialect:
    """Angles in degrees, straight: G1X takes them, MPos gives them."""

    sees_missed_steps = False

    def __init__(self, link: SerialLink, setup: Setup) -> None:
        self._link = link
        self._setup = setup
        self._lines = GcodeLines(
            link,
            wanted="Horus 0.2 firmware",
            banner=_BANNER,
            barrier=f"G1F{setup.speed_deg_s:.3f}",
        )
        self._lines.on_reset = self._forget
        self._held = False
        self._moving = False
        self._lit: dict[int, float] = {}

    def _forget(self) -> None:
        self._held = self._moving = False
        self._lit.clear()

    def wake(self) -> DeviceInfo:
        """Reset, banner, settings, motor on."""
        s = self._setup
        lines = self._lines
        lines.settle()
        lines.reset()
        lines.unlock()
        lines.origin_lost = False
        lines.command(f"G1F{s.speed_deg_s:.3f}")
        lines.set({100: s.microsteps_per_degree, 120: s.acceleration_deg_s2})
        for output in s.outputs:
            lines.command(f"M70T{output}")
        angle = lines.report().angle_deg
        self.hold()
        return DeviceInfo(
            "Horus 0.2",
            {"position_kept": "yes" if abs(angle) > 0.001 else "unknown", "missed_steps": "not seen"},
        )

    def hold(self) -> None:
        """M17."""
        if not self._held:
            self._lines.command("M17")
            self._held = True

    def release(self) -> None:
        """M18."""
        self.stop()
        self._held = False
        self._lines.unlock()
        self._lines.command("M18")

    def start(self, angle_deg: float, speed_deg_s: float) -> None:
        """G1; its ok is owed until the table stands. No laser may be cut off meanwhile."""
        self._lines.in_step()
        self._lines.refuse_lost()
        self.hold()
        if self._lit:
            way = abs(angle_deg - self._lines.report().angle_deg)
            ends = time.monotonic() + way / speed_deg_s
            if ends - min(self._lit.values()) > CUT_OFF_S - _MARGIN_S:
                raise DeviceError(
                    f"the board cuts its lasers off after {CUT_OFF_S:g} s, before this motion ends",
                    hint="turn faster, or in parts, with the laser off between them",
                )
        self._moving = True
        self._lines.begin(f"G1X{angle_deg:.4f}F{speed_deg_s:.3f}")

    def status(self, *, waiting: bool = False) -> Status:
        """While G1's ok is owed, it moves; once that has come, a report of after it is asked for.

        Queue and Run count as moving even then: builds of the firmware that send ok when they have
        planned are understood, too.
        """
        lines = self._lines
        if lines.owed:
            report = lines.any_report("G1") if waiting else lines.report("G1")
            if lines.owed:
                return Status(report.t_ns, report.angle_deg, moving=True)
        report = lines.report()
        self._refuse_alarm(report)
        self._moving = report.state in ("Queue", "Run", "Hold")
        return Status(report.t_ns, report.angle_deg, self._moving)

    def _refuse_alarm(self, report: Report) -> None:
        if report.state == "Alarm":
            self._lines.origin_lost = self._lines.locked = True
            self._lines.refuse_lost()

    def stop(self) -> None:
        """Feed hold; once it rests, a reset forgets the rest of the motion, and the count is kept.

        The reset puts the lasers out. A motion that ended by itself meanwhile needs none.
        """
        lines = self._lines
        if not self._moving:
            return
        until = time.monotonic() + self._link.timeout_s + self._braking_s()
        while time.monotonic() < until:
            try:
                state = lines.any_report("!").state
                if state == "Idle" and not lines.owed:
                    self._moving = False  # it ended by itself
                    return
                if state in ("Queue", "Alarm"):
                    break
                if state != "Hold":  # a hold that comes before the first step is not heeded
                    lines.feed_hold()
            except DeviceError:
                if not self._link.is_open:
                    raise
                break
        lines.reset()
        lines.unlock()

    def _braking_s(self) -> float:
        return self._setup.speed_deg_s / self._setup.acceleration_deg_s2

    def laser(self, output: int, *, on: bool) -> None:
        """M71T or M70T. The board takes them only at rest: to go dark, a motion is stopped."""
        if self._moving and self.status().moving:
            if on:
                raise DeviceError(
                    "the board switches lasers only while the table stands",
                    hint="switch them on before the motion",
                )
            self.stop()
        if not on or output not in self._lit:
            self._lines.command(f"M70T{output}")  # also before M71: only M70 resets the cut-off timer
            self._lit.pop(output, None)
        if on:
            self._lines.command(f"M71T{output}")
            self._lit.setdefault(output, time.monotonic())

    def dark(self) -> None:
        """A reset puts the firmware's outputs out."""
        self._lines.reset()

    def keep_alive(self) -> None:
        """M70 and at once M71 again, when the cut-off is near and the table stands."""
        if self._moving:
            return
        for output, since in list(self._lit.items()):
            if time.monotonic() - since > CUT_OFF_S / 2:
                self.laser(output, on=False)
                self.laser(output, on=True)
