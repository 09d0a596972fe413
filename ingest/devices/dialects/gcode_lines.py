"""Lines, replies and real-time characters of the Grbl family: one line at a time, and in step again.

Nothing in these replies says which line they answer. So a line is sent only while no reply is owed;
after a reply that did not come, the link is brought in step by a reset (0x18), whose banner nothing
older can follow. Status reports (``?``) are answered at once and in order; a report that did not come
leaves the next ones in doubt, until the ``ok`` of a line that was sent after it has passed.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass

from ....schemas.errors import DeviceError
from ..serial_link import SerialLink
from .contract import no_banner

RESET, HOLD, STATUS = "\x18", "!", "?"
_STATUS = re.compile(r"^<([A-Za-z]+(?::\d)?)[,|]")
_POSITION = re.compile(r"[,|]MPos:(-?\d+\.\d+)[,|>]")
_SETTING = re.compile(r"^\$(\d+)=(-?\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Report:
    """A status report: the state's word, MPos of X in degrees, and when it was true."""

    t_ns: int
    state: str
    angle_deg: float


def parse_report(line: str, t_ns: int) -> Report | None:
    """The report that ``line`` is, or None."""
    state, position = _STATUS.match(line), _POSITION.search(line)
    if state is None or position is None or not line.endswith(">"):
        return None
    return Report(t_ns, state[1], float(position[1]))


class _NoReportError(DeviceError):
    """No status report came, though lines may pass still."""


class GcodeLines:
    """The conversation with one board."""

    def __init__(self, link: SerialLink, *, wanted: str, banner: re.Pattern[str], barrier: str) -> None:
        self._link = link
        self._wanted = wanted
        self._banner = banner
        #: A line that changes nothing and is answered with ok.
        self._barrier = barrier
        #: Replies (ok, error, ALARM) that the board owes us.
        self.owed = 0
        self._asked = 0
        self._answered = 0
        self._asked_before_line = 0
        #: A reply did not come in time: only a reset brings the link in step again.
        self._given_up = False
        #: The board was torn out of a motion or restarted: its count means nothing.
        self.origin_lost = False
        #: The board wants ``$X`` before it moves.
        self.locked = False
        #: Called after each reset, which switches lasers off and may let go of the motor.
        self.on_reset: Callable[[], None] = lambda: None

    # -- lines --------------------------------------------------------------------------------------

    def command(self, line: str, *, timeout_s: float | None = None) -> list[str]:
        """Send a line and wait for its ``ok``; what the board said before it."""
        self.begin(line)
        return self.finish(line, timeout_s=timeout_s)

    def begin(self, line: str) -> None:
        """Send a line whose ``ok`` comes later (see ``owed``)."""
        self.in_step()
        self.owed += 1
        self._asked_before_line = self._asked
        self._link.send(line)

    def finish(self, line: str, *, timeout_s: float | None = None) -> list[str]:
        """Wait for the ``ok`` of the line that was begun."""
        timeout = self._link.timeout_s if timeout_s is None else timeout_s
        until = time.monotonic() + timeout
        said: list[str] = []
        while self.owed:
            text = self._link.read_line(until)
            if text is None:
                self._given_up = True
                shown = f"; saw {'; '.join(said[:3])[:100]!r}" if said else ""
                raise DeviceError(
                    f"the controller did not answer {line!r} in {timeout:g} s{shown}",
                    hint="check cable and power, then turnscan rig check RIG",
                )
            if not self.take(text, line):
                said.append(text)
        return said

    def take(self, text: str, line: str) -> bool:
        """Count a reply; True if it was an ``ok``. ``line`` is what is waited for, for the message."""
        if text == "ok":
            self.owed = max(self.owed - 1, 0)
            self._passed()
            return True
        if text.startswith("error"):
            self.owed = max(self.owed - 1, 0)
            self._passed()
            raise DeviceError(
                f"the controller refused {line!r}: {text}",
                hint="docs/controllers.md says where the codes are listed",
            )
        if text.startswith("ALARM"):
            self.origin_lost = self.locked = True
            raise DeviceError(
                f"the controller raised an alarm at {line!r}: {text}",
                hint="its position is lost: turn the table to its zero, and connect again",
            )
        if self._banner.match(text):
            self.owed = 0
            self.origin_lost = True
            self.on_reset()
            raise DeviceError(
                f"the controller restarted by itself: {text!r}; its position is lost",
                hint="check its power, turn the table to its zero, and connect again",
            )
        return False

    def _passed(self) -> None:
        """Reports asked for before the line that was just answered have come, or never will."""
        self._answered = max(self._answered, self._asked_before_line)

    # -- real time ----------------------------------------------------------------------------------

    def report(self, line: str = STATUS) -> Report:
        """A status report that surely answers this very question, or DeviceError.

        ``line`` is what else is waited for, for the message of an error that comes instead.
        """
        if self._given_up:
            self.reset()
        for last in (False, True):
            if self._asked > self._answered:
                if self.owed:
                    raise DeviceError(
                        "a status report was lost, so the next ones may be old",
                        hint="the motion must end before the link can be brought in step again",
                    )
                self.command(self._barrier)
            try:
                return self.any_report(line, tries=1, share_s=self._link.timeout_s / 2)
            except _NoReportError:
                if last or self.owed:
                    raise
        raise AssertionError("unreachable")

    def any_report(self, line: str = STATUS, *, tries: int = 3, share_s: float | None = None) -> Report:
        """A status report that may answer an earlier question, if one was lost: for waiting only."""
        share = self._link.timeout_s / tries if share_s is None else share_s
        seen: list[str] = []
        for _ in range(tries):
            sent = self._link.send(STATUS, end="")
            self._asked += 1
            until = time.monotonic() + share
            while (text := self._link.read_line(until)) is not None:
                found = parse_report(text, (sent + self._link.clock.now_ns()) // 2)
                if found is not None:
                    self._answered = min(self._answered + 1, self._asked)
                    return found
                if not self.take(text, line):
                    seen.append(text)
        shown = f"; saw {'; '.join(seen[:3])[:100]!r}" if seen else ""
        raise _NoReportError(
            f"the controller sent no status report in {self._link.timeout_s:g} s{shown}",
            hint="check cable and power, then turnscan rig check RIG",
        )

    def feed_hold(self) -> None:
        """Brake now."""
        self._link.send(HOLD, end="")

    def in_step(self) -> None:
        """Make sure that no reply is owed, by a reset if one is."""
        if self.owed:
            self.reset()
        while (text := self._link.read_line(0.0)) is not None:
            if parse_report(text, 0) is not None:
                self._answered = min(self._answered + 1, self._asked)
            self.take(text, "")

    def settle(self) -> None:
        """Let a board that was just switched on say so: that banner is no reply to a reset."""
        self._link.drain(0.05, self._link.timeout_s / 2)

    def reset(self) -> None:
        """0x18, and wait for the banner. Lasers are off then; a motion is torn off."""
        seen: list[str] = []
        until = time.monotonic() + self._link.timeout_s
        self.owed = 0
        found, sent = False, 0
        while not found and time.monotonic() < until:
            # A board that boots (opening the port resets some) does not hear the first one.
            self._link.send(RESET, end="")
            sent += 1
            wait = min(until, time.monotonic() + self._link.timeout_s / 2)
            while (text := self._link.read_line(wait)) is not None:
                seen.append(text)
                if self._banner.match(text):
                    found = True
                    break
        if not found:
            raise no_banner(self._link, self._wanted, seen)
        self._answered = self._asked
        self._given_up = False
        # A second banner may follow a second reset, and the word that it is locked, any.
        quiet = 0.05 if sent == 1 else min(0.3, self._link.timeout_s / 4)
        seen += self._link.drain(quiet, self._link.timeout_s)
        if any(t.startswith("ALARM") for t in seen):
            self.origin_lost = True
        self.locked = any("to unlock" in t for t in seen)
        self.on_reset()

    def unlock(self) -> None:
        """``$X`` if the board is locked."""
        if self.locked:
            self.command("$X")
            self.locked = False

    def refuse_lost(self) -> None:
        """DeviceError if the board's count means nothing any more."""
        if self.origin_lost:
            raise DeviceError(
                "the controller was torn out of a motion or restarted; its position is lost",
                hint="turn the table to its zero, and connect again",
            )

    # -- settings -----------------------------------------------------------------------------------

    def settings(self) -> dict[int, float]:
        """What ``$$`` lists."""
        found = (_SETTING.match(line) for line in self.command("$$"))
        return {int(m[1]): float(m[2]) for m in found if m}

    def set(self, wanted: dict[int, float]) -> dict[int, float]:
        """Write the settings that differ (they live in EEPROM, which wears), and read them back."""
        have = self.settings()
        changed = False
        for number, value in wanted.items():
            # Listed with three digits only: what needs more is always written.
            if have.get(number) == round(value, 3) and abs(value - round(value, 3)) < 1e-9:
                continue
            text = f"{value:.6f}".rstrip("0").rstrip(".")
            self.command(f"${number}={text}")
            changed = True
        if not changed and wanted.keys() <= have.keys():
            return have
        have = self.settings()
        for number, value in wanted.items():
            if not abs(have.get(number, float("nan")) - value) <= 0.001:
                raise DeviceError(
                    f"the controller did not take ${number}={value:g}: it says {have.get(number)}",
                    hint="is its firmware the one that docs/controllers.md names?",
                )
        return have
