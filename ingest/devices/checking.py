"""Trying a rig out: devices are talked to, the table moves a little, lasers blink, a frame is taken."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np

from ...schemas.errors import DeviceError, TurnscanError
from .building import Devices
from .contracts import Shot

#: How far the table turns to and fro.
TRIAL_DEG = 5.0
#: A laser whose light changes no sample by this share of full scale is not seen.
SEEN = 0.1
#: A frame whose brightest sample is below this share of full scale is black.
BLACK = 0.02


@dataclass(frozen=True)
class Finding:
    """One thing that was tried: whether it is well, what was seen, and what to do if not."""

    check: str
    ok: bool
    seen: str
    hint: str = ""


class Trial:
    """The checks of one rig, in order. What needs something that failed is not tried."""

    def __init__(self, devices: Devices, *, move: bool = True) -> None:
        self._devices = devices
        self._move = move

    def run(self) -> Iterator[Finding]:
        """Finding after finding, as they come; afterwards lasers are off and the motor is released."""
        devices = self._devices
        try:
            board = yield from self._tried("controller", self._connect)
            if board and self._move:
                yield from self._tried("motion", self._turn)
            seeing = yield from self._tried("camera", self._open)
            if seeing:
                seeing = yield from self._tried("frame", self._frame)
            if board:
                for laser in devices.rig.lasers:
                    number = laser.number
                    yield from self._tried(f"laser {number}", self._laser(number, seeing=seeing))
                yield from self._tried("everything off", self._off)
        finally:
            devices.close()

    @staticmethod
    def _tried(check: str, act: Callable[[], str]) -> Generator[Finding, None, bool]:
        try:
            finding = Finding(check, ok=True, seen=act())
        except TurnscanError as error:
            finding = Finding(check, ok=False, seen=str(error), hint=error.hint or "")
        yield finding
        return finding.ok

    def _connect(self) -> str:
        info = self._devices.controller.connect()
        facts = ", ".join(f"{k} {v}" for k, v in info.facts.items() if k in ("port", "baud"))
        note = "" if info.facts.get("missed_steps") == "seen" else "; missed steps cannot be seen"
        return f"{info.name} ({facts}){note}"

    def _turn(self) -> str:
        table, controller = self._devices.rig.turntable, self._devices.controller
        here = math.degrees(controller.position().angle_rad)
        away = here + TRIAL_DEG if here + TRIAL_DEG <= table.max_deg else here - TRIAL_DEG
        began = time.monotonic()
        there = math.degrees(controller.move_to(math.radians(away)).angle_rad)
        took = time.monotonic() - began
        back = math.degrees(controller.move_to(math.radians(here)).angle_rad)
        return f"from {here:.2f} to {there:.2f} deg in {took:.1f} s, and back to {back:.2f} deg"

    def _open(self) -> str:
        info = self._devices.camera.open()
        settings = "".join(f", {k} {v}" for k, v in info.settings.items())
        return f"{info.name}: {info.width_px} x {info.height_px} {info.encoding}{settings}"

    def _shot(self) -> Shot:
        return self._devices.camera.shoot(self._devices.clock.now_ns())

    def _frame(self) -> str:
        image = self._shot().image
        darkest, brightest = float(image.min()), float(image.max())
        if brightest < BLACK * self._full_scale:
            raise DeviceError(
                f"the frame is black: no sample above {brightest:.0f} DN",
                hint="is the lens cap on? is exposure_us too short?",
            )
        return f"{image.shape[1]} x {image.shape[0]}, {darkest:.0f} to {brightest:.0f} DN"

    def _laser(self, number: int, *, seeing: bool) -> Callable[[], str]:
        controller = self._devices.controller

        def blink() -> str:
            dark = self._shot().image.astype(np.float64) if seeing else None
            controller.switch(number, on=True)
            try:
                lit = self._shot().image.astype(np.float64) if seeing else None
            finally:
                controller.switch(number, on=False)
            if dark is None or lit is None:
                return "switched on and off"
            gain = float(np.max(lit - dark))
            if gain < SEEN * self._full_scale:
                raise DeviceError(
                    f"switched on, but no sample of the frame rose by more than {gain:.0f} DN",
                    hint="is it plugged into this output? does it shine where the camera looks?",
                )
            return f"seen: samples rise by up to {gain:.0f} DN"

        return blink

    @property
    def _full_scale(self) -> float:
        return 65535.0 if self._devices.rig.camera.encoding == "mono16" else 255.0

    def _off(self) -> str:
        self._devices.controller.all_off()
        self._devices.controller.release()
        return "lasers off, motor released"
