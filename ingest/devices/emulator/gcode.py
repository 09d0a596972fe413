"""What the emulated Horus and Grbl firmwares have in common: words, settings, one motion at a time."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass

from .body import Body
from .faults import Command

RESET, HOLD, RESUME, STATUS = "\x18", "!", "~", "?"
REAL_TIME = frozenset((RESET + HOLD + RESUME + STATUS).encode())

_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d*)?|-?\.\d+)")
_SETTING = re.compile(r"^\$(\d+)=(-?\d+(?:\.\d*)?)$")


def tidy(line: str) -> str:
    """A line as Grbl sees it: no spaces, no comments, upper case."""
    return re.sub(r"\([^)]*\)|\s", "", line).upper()


def words(line: str) -> list[tuple[str, float]] | None:
    """Letters and numbers of a tidy G-code line; None if it is none."""
    found = _WORD.findall(line)
    if "".join(a + b for a, b in found) != line:
        return None
    return [(letter, float(number)) for letter, number in found]


def setting(line: str) -> tuple[int, float] | None:
    """Number and value of ``$n=v``."""
    match = _SETTING.match(line)
    return (int(match[1]), float(match[2])) if match else None


def sort(line: str) -> str:
    """What sort of command a line or real-time character is, for faults."""
    text = tidy(line)
    if line in (STATUS,):
        return "status"
    if line in (RESET, HOLD, RESUME):
        return "other"
    if not text:
        return "empty"
    if "X" in text and "G" in text and not text.startswith("$"):
        return "move"
    if re.match(r"M(3|4|5|70|71)(?!\d)", text):
        return "laser"
    return "motor" if text in ("M17", "M18", "$SLP") else "other"


@dataclass
class Motion:
    """One motion that was asked for: target in degrees, speed in degrees per second."""

    target_deg: float
    speed_deg_s: float
    command: Command


class Axis:
    """The X axis: motions in turn, feed hold, the board's own steps per degree."""

    def __init__(self, body: Body, steps_per_degree: float, acceleration_deg_s2: float) -> None:
        self.body = body
        self.steps_per_degree = steps_per_degree
        self.acceleration_deg_s2 = acceleration_deg_s2
        self.queue: deque[Motion] = deque()
        self.current: Motion | None = None
        self.held = False

    @property
    def position_deg(self) -> float:
        """Where the board counts the axis."""
        return self.body.counted / self.steps_per_degree

    @property
    def busy(self) -> bool:
        """Whether a motion has not ended or waits."""
        return self.current is not None or bool(self.queue)

    def tick(self) -> Motion | None:
        """The motion that has just ended, if one has; begins the next."""
        ended = None
        if self.current is not None and not self.held and not self.body.moving:
            ended, self.current = self.current, None
        if self.current is None and self.queue and not self.held:
            self.current = self.queue.popleft()
            self._begin(self.current)
        return ended

    def _begin(self, motion: Motion) -> None:
        missed = motion.command.fault("missed-steps")
        self.body.hold(on=True)
        self.body.move(
            round(motion.target_deg * self.steps_per_degree),
            motion.speed_deg_s * self.steps_per_degree,
            self.acceleration_deg_s2 * self.steps_per_degree,
            missed=missed.steps if missed else 0,
            stall=motion.command.fault("stall") is not None,
        )

    def hold(self, *, at_rest: bool) -> None:
        """Brake and keep the rest of the motion; ``at_rest``: also when nothing moves yet."""
        if self.held or (self.current is None and not at_rest):
            return
        self.held = True
        if self.current is not None:
            self.body.stop(self.acceleration_deg_s2 * self.steps_per_degree)

    def resume(self) -> None:
        """Go on after a hold that has come to rest."""
        if self.held and not self.body.moving:
            self.held = False
            if self.current is not None:
                self._begin(self.current)

    def abort(self) -> bool:
        """Forget all motions; True if the axis was torn out of one, so that steps may be lost."""
        torn = self.current is not None and self.body.moving
        if torn:
            self.body.stop()
        self.queue.clear()
        self.current, self.held = None, False
        return torn
