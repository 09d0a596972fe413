"""The emulated scanner's body: motor, holding current and lasers, and what they did when.

Firmware acts on it from the emulator's thread; a simulated camera asks from another what was true at
the moment of its exposure.
"""

from __future__ import annotations

import bisect
import math
import threading
from dataclasses import dataclass

from ..contracts import Clock
from .motor import Motor


@dataclass(frozen=True)
class PhysicalState:
    """What is really so at ``t_ns``, whatever the firmware believes or reports.

    ``microsteps`` is where the table stands, in microsteps of the motor; ``angle_rad`` the same through
    the gear, in the sense of commanded angles. ``outputs_lit`` are the board's outputs, counted from 1.
    """

    t_ns: int
    microsteps: float
    angle_rad: float
    outputs_lit: frozenset[int]
    motor_held: bool
    turning: bool


class Body:
    """Motor, lasers and their past. Every method may be called from any thread."""

    def __init__(
        self,
        clock: Clock,
        *,
        microsteps_per_degree: float,
        play_deg: float = 0.0,
        time_scale: float = 1.0,
    ) -> None:
        self.clock = clock
        self.microsteps_per_degree = microsteps_per_degree
        self._scale = time_scale
        self._lock = threading.RLock()
        self._motor = Motor(clock.now_ns(), play=play_deg * microsteps_per_degree)
        self._past: list[tuple[int, frozenset[int], bool]] = [(clock.now_ns(), frozenset(), False)]

    # -- what is so ---------------------------------------------------------------------------------

    def state(self, t_ns: int | None = None) -> PhysicalState:
        """What is, or was, really so; None: now."""
        with self._lock:
            t = self.clock.now_ns() if t_ns is None else t_ns
            at = bisect.bisect_right(self._past, t, key=lambda p: p[0])
            _, lit, held = self._past[max(at - 1, 0)]
            table = self._motor.table(t)
            return PhysicalState(
                t_ns=t,
                microsteps=table,
                angle_rad=math.radians(table / self.microsteps_per_degree),
                outputs_lit=lit,
                motor_held=held,
                turning=self._motor.moving(t),
            )

    def ever_lit(self, since_ns: int = 0) -> list[tuple[int, frozenset[int]]]:
        """Every change of the lasers since a time: when, and which were lit from then on."""
        with self._lock:
            return [(t, lit) for t, lit, _ in self._past if t >= since_ns]

    @property
    def counted(self) -> int:
        """The firmware's step counter now."""
        with self._lock:
            return round(self._motor.counted(self.clock.now_ns()))

    @property
    def encoder(self) -> int:
        """What an encoder on the motor's shaft reads now, in microsteps."""
        with self._lock:
            return round(self._motor.rotor(self.clock.now_ns()))

    @property
    def moving(self) -> bool:
        """Whether a motion has not ended."""
        with self._lock:
            return self._motor.moving(self.clock.now_ns())

    @property
    def lit(self) -> frozenset[int]:
        """The outputs that are lit now."""
        return self._past[-1][1]

    @property
    def held(self) -> bool:
        """Whether the motor has its holding current now."""
        return self._past[-1][2]

    # -- what the firmware does ---------------------------------------------------------------------

    def switch(self, output: int, *, on: bool) -> None:
        """One laser on or off."""
        with self._lock:
            self._change(self.lit | {output} if on else self.lit - {output}, held=self.held)

    def all_off(self) -> None:
        """Every laser off."""
        with self._lock:
            self._change(frozenset(), held=self.held)

    def hold(self, *, on: bool) -> None:
        """The motor's holding current on or off."""
        with self._lock:
            self._change(self.lit, held=on)

    def move(
        self, target: float, speed: float, acceleration: float, *, missed: int = 0, stall: bool = False
    ) -> None:
        """Turn to ``target`` microsteps (speeds in microsteps per second, of unscaled time)."""
        with self._lock:
            k = self._scale
            self._motor.move(
                target,
                speed * k,
                acceleration * k * k,
                self.clock.now_ns(),
                missed=missed,
                stall=stall,
            )

    def stop(self, acceleration: float = 0.0) -> None:
        """Brake; acceleration 0 stops dead."""
        with self._lock:
            self._motor.stop(acceleration * self._scale**2, self.clock.now_ns())

    def recount(self, value: int) -> None:
        """Set the step counter."""
        with self._lock:
            self._motor.recount(value, self.clock.now_ns())

    def _change(self, lit: frozenset[int], *, held: bool) -> None:
        if (lit, held) != self._past[-1][1:]:
            self._past.append((self.clock.now_ns(), lit, held))
