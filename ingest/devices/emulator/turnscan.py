"""The reference firmware of the ``turnscan`` protocol, as docs/controllers.md specifies it."""

from __future__ import annotations

from ..dialects.turnscan_lines import PROTOCOL, RESET, Line, parse_line
from .body import Body
from .faults import Command
from .port import Emit

LASERS = 8
_SORTS = {"MOVE": "move", "LASER": "laser", "MOTOR": "motor", "STAT": "status"}
_LIMIT = 2**31 - 1


class _Refusal(Exception):  # noqa: N818 - a reply, no failure of the program
    """A request that is answered with NO and a code."""


class TurnscanFirmware:
    """Step counter, encoder, lasers with a watchdog, limits; every request answered once."""

    real_time = frozenset(RESET.encode())
    usb_powered = False

    def __init__(self, body: Body, emit: Emit, *, baud: int = 115200, encoder: bool = True) -> None:
        self.baud = baud
        self._body = body
        self._emit = emit
        self._has_encoder = encoder
        self._kept = False
        self._last: tuple[str, str] | None = None
        self._speed, self._acceleration = 800.0, 4000.0
        self._low, self._high = -_LIMIT, _LIMIT
        self._watchdog_ms = 5000
        self._heard_ns = body.clock.now_ns()

    def boot(self) -> None:
        """Power on: dark, unheld, at 0, and says READY."""
        self._ready("power")

    def sort(self, line: str) -> str:
        """What sort of command this is."""
        words = line.split("*", maxsplit=1)[0].split()
        return "empty" if not words else _SORTS.get(words[1] if len(words) > 1 else "", "other")

    def take_byte(self, command: Command) -> None:
        """CAN: all off, stop dead, forget the last request."""
        if self._body.moving:
            self._body.stop()
            self._kept = self._kept and self._has_encoder
        self._body.all_off()
        self._body.hold(on=False)
        self._last = None
        self._ready("reset", command)

    def _ready(self, cause: str, command: Command | None = None) -> None:
        words = ("READY", "turnscan", f"proto={PROTOCOL}", f"cause={cause}")
        self._send(Line("!", 0, words), command)

    def refuse(self, command: Command) -> None:
        """As if the line had come damaged."""
        self._send(Line("<", 0, ("NAK",)), command)

    def take_line(self, command: Command) -> None:
        """Answer a request; the same number and text again gets the same reply and does nothing."""
        if not command.text:
            return
        line = parse_line(command.text)
        if line is None or line.mark != ">":
            self.refuse(command)
            return
        self._heard_ns = self._body.clock.now_ns()
        if self._last is not None and self._last[0] == command.text:
            self._emit(self._last[1], command)
            return
        try:
            words: tuple[str, ...] = ("OK", *self._act(line, command))
        except _Refusal as refusal:
            words = ("NO", *str(refusal).split())
        reply = Line("<", line.number, words).text() + "\n"
        self._last = (command.text, reply)
        self._emit(reply, command)

    def tick(self) -> None:
        """The watchdog: lasers off when nothing good was heard for too long."""
        if self._body.lit:
            silence_ms = (self._body.clock.now_ns() - self._heard_ns) / 1e6
            if silence_ms > self._watchdog_ms:
                self._body.all_off()
                self._send(Line("!", 0, ("WATCHDOG",)), None)

    def _send(self, line: Line, command: Command | None) -> None:
        self._emit(line.text() + "\n", command)

    # -- requests -----------------------------------------------------------------------------------

    def _act(self, line: Line, command: Command) -> tuple[str, ...]:
        word, *arguments = line.words
        act = {
            "HELLO": self._hello,
            "SET": self._set,
            "MOTOR": self._motor,
            "MOVE": self._move,
            "STOP": self._stop,
            "STAT": self._stat,
            "LASER": self._laser,
            "PING": self._ping,
            "SYNC": self._sync,
        }.get(word)
        if act is None:
            raise _Refusal("1 unknown-request")
        return act(arguments, command)

    def _hello(self, _arguments: list[str], _command: Command) -> tuple[str, ...]:
        kept = int(self._kept)
        self._kept = True
        return (
            "turnscan",
            f"proto={PROTOCOL}",
            "fw=emulator-1.0",
            f"lasers={LASERS}",
            f"encoder={int(self._has_encoder)}",
            f"kept={kept}",
        )

    def _set(self, arguments: list[str], _command: Command) -> tuple[str, ...]:
        given: dict[str, int] = {}
        for argument in arguments:
            name, _, value = argument.partition("=")
            if name not in ("speed", "accel", "min", "max", "watchdog"):
                raise _Refusal(f"2 unknown-setting {name}")
            given[name] = _integer(value)
        if any(given.get(n, 1) < 1 for n in ("speed", "accel", "watchdog")):
            raise _Refusal("2 not-positive")
        self._speed = given.get("speed", self._speed)
        self._acceleration = given.get("accel", self._acceleration)
        self._low, self._high = given.get("min", self._low), given.get("max", self._high)
        self._watchdog_ms = given.get("watchdog", self._watchdog_ms)
        return ()

    def _motor(self, arguments: list[str], _command: Command) -> tuple[str, ...]:
        on = _switch(arguments)
        if self._body.moving:
            raise _Refusal("4 busy")
        self._body.hold(on=on)
        return ()

    def _move(self, arguments: list[str], command: Command) -> tuple[str, ...]:
        if len(arguments) not in (1, 2):
            raise _Refusal("2 arguments")
        target = _integer(arguments[0])
        speed = _integer(arguments[1]) if len(arguments) == 2 else self._speed
        if speed < 1:
            raise _Refusal("2 not-positive")
        if not self._low <= target <= self._high:
            raise _Refusal(f"3 limit {self._low} {self._high}")
        if self._body.moving:
            raise _Refusal("4 busy")
        if not self._body.held:
            raise _Refusal("5 motor-off")
        missed = command.fault("missed-steps")
        self._body.move(
            target,
            speed,
            self._acceleration,
            missed=missed.steps if missed else 0,
            stall=command.fault("stall") is not None,
        )
        return ()

    def _stop(self, _arguments: list[str], _command: Command) -> tuple[str, ...]:
        self._body.stop(self._acceleration)
        return ()

    def _stat(self, _arguments: list[str], _command: Command) -> tuple[str, ...]:
        mask = sum(1 << (n - 1) for n in self._body.lit)
        return (
            "busy" if self._body.moving else "idle",
            f"pos={self._body.counted}",
            f"enc={self._body.encoder}" if self._has_encoder else "enc=-",
            f"motor={'on' if self._body.held else 'off'}",
            f"lasers={mask:02X}",
        )

    def _laser(self, arguments: list[str], _command: Command) -> tuple[str, ...]:
        if len(arguments) != 2:
            raise _Refusal("2 arguments")
        number = _integer(arguments[0])
        if not 1 <= number <= LASERS:
            raise _Refusal(f"6 no-such-laser {number}")
        self._body.switch(number, on=_switch(arguments[1:]))
        return (f"lasers={sum(1 << (n - 1) for n in self._body.lit):02X}",)

    def _ping(self, _arguments: list[str], _command: Command) -> tuple[str, ...]:
        return ()

    def _sync(self, _arguments: list[str], _command: Command) -> tuple[str, ...]:
        if not self._has_encoder:
            raise _Refusal("7 no-encoder")
        if self._body.moving:
            raise _Refusal("4 busy")
        self._body.recount(self._body.encoder)
        return ()


def _integer(text: str) -> int:
    digits = text.removeprefix("-")
    if not (digits.isascii() and digits.isdigit()) or abs(int(text)) > _LIMIT:
        raise _Refusal("2 not-a-number")
    return int(text)


def _switch(arguments: list[str]) -> bool:
    if arguments not in (["on"], ["off"]):
        raise _Refusal("2 on-or-off")
    return arguments == ["on"]
