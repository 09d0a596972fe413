"""The emulated stepper motor and its gear: what was counted, and where the table really stands.

The motor moves in trapezoids of speed. Counted steps are what the firmware believes; the table differs
from them by missed steps and by the play of the gear, as a real one would.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass

NS = 1_000_000_000


@dataclass(frozen=True)
class _Segment:
    """Constant acceleration from ``start_ns``: x = x0 + v t + a t^2 / 2, for ``span_s``."""

    start_ns: int
    span_s: float
    x0: float
    speed: float
    acceleration: float
    #: Steps that the rotor lags behind what was counted.
    missed: float
    #: Where the table stood at the start, in microsteps of the motor.
    table0: float

    def counted(self, t_ns: int) -> float:
        t = min(max((t_ns - self.start_ns) / NS, 0.0), self.span_s)
        return self.x0 + self.speed * t + 0.5 * self.acceleration * t * t

    def speed_at(self, t_ns: int) -> float:
        t = (t_ns - self.start_ns) / NS
        return self.speed + self.acceleration * t if t < self.span_s else 0.0

    def table(self, t_ns: int, play: float) -> float:
        # Play operator: going up, the tooth pushes at its own place; going down, ``play`` later.
        rotor = self.counted(t_ns) - self.missed
        return min(max(self.table0, rotor), rotor + play)


class Motor:
    """One stepper motor; positions in microsteps, times in ns, speeds in microsteps per second.

    Not locked: the emulator that owns it is.
    """

    def __init__(self, now_ns: int, *, play: float = 0.0) -> None:
        self._play = play
        self._segments = [_Segment(now_ns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)]
        self._stalled = False

    def _at(self, t_ns: int) -> _Segment:
        starts = bisect.bisect_right(self._segments, t_ns, key=lambda s: s.start_ns)
        return self._segments[max(starts - 1, 0)]

    def counted(self, t_ns: int) -> float:
        """Where the firmware counts the motor at ``t_ns``."""
        return self._at(t_ns).counted(t_ns)

    def rotor(self, t_ns: int) -> float:
        """Where the motor's shaft really is: what an encoder on it reads."""
        segment = self._at(t_ns)
        return segment.counted(t_ns) - segment.missed

    def table(self, t_ns: int) -> float:
        """Where the table really stands, in microsteps of the motor."""
        return self._at(t_ns).table(t_ns, self._play)

    def moving(self, t_ns: int) -> bool:
        """Whether the firmware has not finished its motion (a stalled one never does)."""
        last = self._segments[-1]
        return self._stalled or t_ns < last.start_ns + round(last.span_s * NS)

    def move(
        self,
        target: float,
        speed: float,
        acceleration: float,
        now_ns: int,
        *,
        missed: float = 0.0,
        stall: bool = False,
    ) -> None:
        """Begin a motion from rest; at its middle steps are ``missed``, or it ends (``stall``)."""
        start = self._at(now_ns).counted(now_ns)
        way = target - start
        if way == 0:
            return
        sign = math.copysign(1.0, way)
        top = min(speed, math.sqrt(abs(way) * acceleration))
        ramp_s = top / acceleration
        cruise_s = max(abs(way) - top * ramp_s, 0.0) / top
        middle = cruise_s / 2
        self._cut(now_ns)
        self._add(ramp_s, 0.0, sign * acceleration)
        self._add(middle, sign * top, 0.0)
        if stall:
            self._add(0.0, 0.0, 0.0)
            self._stalled = True
            return
        self._add(middle, sign * top, 0.0, missed=sign * missed)
        self._add(ramp_s, sign * top, -sign * acceleration)
        self._add(0.0, 0.0, 0.0, rest_at=target)

    def stop(self, acceleration: float, now_ns: int) -> None:
        """Brake from the present speed; acceleration 0 stops dead."""
        speed = self._at(now_ns).speed_at(now_ns)
        self._stalled = False
        self._cut(now_ns)
        if speed and acceleration:
            self._add(abs(speed) / acceleration, speed, -math.copysign(acceleration, speed))
        self._add(0.0, 0.0, 0.0)

    def recount(self, value: float, now_ns: int) -> None:
        """The firmware sets its count; nothing turns."""
        rotor, table = self.rotor(now_ns), self.table(now_ns)
        self._cut(now_ns)
        last = self._segments[-1]
        self._segments.append(
            _Segment(max(now_ns, last.start_ns), 0.0, value, 0.0, 0.0, value - rotor, table)
        )

    def _cut(self, now_ns: int) -> None:
        """End the present segment now and forget those to come."""
        while len(self._segments) > 1 and self._segments[-1].start_ns > now_ns:
            self._segments.pop()
        last = self._segments[-1]
        span = min(last.span_s, (now_ns - last.start_ns) / NS)
        self._segments[-1] = _Segment(
            last.start_ns, span, last.x0, last.speed, last.acceleration, last.missed, last.table0
        )
        self._next_ns = now_ns

    def _add(
        self,
        span_s: float,
        speed: float,
        acceleration: float,
        *,
        missed: float = 0.0,
        rest_at: float | None = None,
    ) -> None:
        last = self._segments[-1]
        end = last.start_ns + round(last.span_s * NS)
        start = max(self._next_ns, end)
        x0 = last.counted(start) if rest_at is None else rest_at
        self._segments.append(
            _Segment(
                start,
                span_s,
                x0,
                speed,
                acceleration,
                last.missed + missed,
                last.table(start, self._play),
            )
        )
        self._next_ns = start + round(span_s * NS)
