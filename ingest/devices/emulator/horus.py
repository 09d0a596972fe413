"""Horus firmware 0.2 as it runs on Ciclop boards: ``ok`` to G1 comes when the motion has ended."""

from __future__ import annotations

from collections import deque

from .body import Body
from .faults import Command
from .gcode import HOLD, REAL_TIME, RESET, RESUME, STATUS, Axis, Motion, setting, sort, tidy, words
from .port import Emit

BANNER = "\r\nHorus 0.2 ['$' for help]\r\n"
#: A laser is cut off so long after it was switched on, and only M70 resets that timer.
CUT_OFF_S = 255.0
_NS = 1_000_000_000
_UNITS = {100: "x, step/deg", 110: "x max rate, deg/sec", 120: "x accel, deg/sec^2"}


class HorusFirmware:
    """Two lasers, one motor, lines in turn; only real-time characters act while a motion lasts."""

    real_time = REAL_TIME
    usb_powered = True

    def __init__(
        self, body: Body, emit: Emit, *, cut_off_s: float = CUT_OFF_S, early_ok: bool = False
    ) -> None:
        self.baud = 115200
        self._body = body
        self._emit = emit
        #: Send ok to G1 when it is planned, as builds near to Grbl's own do.
        self.early_ok = early_ok
        self._cut_off_ns = round(cut_off_s * _NS)
        self._settings: dict[int, float] = {100: 176.0, 110: 180.0, 120: 180.0}
        self._axis = Axis(body, 176.0, 180.0)
        self._lines: deque[Command] = deque()
        self._alarm = False
        self._feed_deg_s = 0.0
        self._motor = False
        self._lit_ns: dict[int, int] = {}

    def boot(self) -> None:
        """Power on."""
        self._emit(BANNER, None)

    def sort(self, line: str) -> str:
        """What sort of command this is."""
        return sort(line)

    def refuse(self, command: Command) -> None:
        """An error reply, and nothing done."""
        self._emit("error: Unsupported command\r\n", command)

    def take_line(self, command: Command) -> None:
        """Lines wait for each other; empty ones get no reply."""
        self._lines.append(command)
        self._go_on()

    def tick(self) -> None:
        """End of motion, waiting lines, the lasers' cut-off timer."""
        ended = self._axis.tick()
        if ended is not None:
            self._rest()
            if not self.early_ok:
                self._emit("ok\r\n", ended.command)
        self._go_on()
        now = self._body.clock.now_ns()
        for output, since in self._lit_ns.items():
            if output in self._body.lit and now - since > self._cut_off_ns:
                self._body.switch(output, on=False)

    def take_byte(self, command: Command) -> None:
        """Status, feed hold, resume and reset act at once."""
        if command.text == STATUS:
            x = f"{self._axis.position_deg:.3f}"
            place = f"{x},0.000,0.000"
            self._emit(f"<{self._state()},MPos:{place},WPos:{place}>\r\n", command)
        elif command.text == HOLD:
            self._axis.hold(at_rest=False)
        elif command.text == RESUME:
            self._axis.resume()
        elif command.text == RESET:
            self._reset(command)

    def _reset(self, command: Command) -> None:
        if self._axis.abort():
            self._alarm = True
            self._emit("ALARM: Abort during cycle\r\n", command)
        self._lines.clear()
        self._body.all_off()
        self._motor = False
        self._body.hold(on=False)
        self._emit(BANNER, command)
        if self._alarm:
            self._emit("['$H'|'$X' to unlock]\r\n", command)

    def _state(self) -> str:
        if self._alarm:
            return "Alarm"
        if self._axis.held:
            return "Hold" if self._body.moving else "Queue"
        return "Run" if self._axis.busy else "Idle"

    def _rest(self) -> None:
        self._body.hold(on=self._motor)

    def _go_on(self) -> None:
        while self._lines and not self._axis.busy:
            self._obey(self._lines.popleft())

    def _obey(self, command: Command) -> None:
        line = tidy(command.text)
        if not line:
            return
        if line.startswith("$"):
            self._dollar(line, command)
        elif self._alarm:
            self._emit("error: Alarm lock\r\n", command)
        else:
            self._code(line, command)

    def _dollar(self, line: str, command: Command) -> None:
        given = setting(line)
        if line == "$$":
            for number, value in sorted(self._settings.items()):
                self._emit(f"${number}={value:.3f} ({_UNITS[number]})\r\n", command)
        elif line == "$X":
            if self._alarm:
                self._emit("[Caution: Unlocked]\r\n", command)
            self._alarm = False
        elif given is not None and given[0] in self._settings:
            self._settings[given[0]] = given[1]
            self._axis.steps_per_degree = self._settings[100]
            self._axis.acceleration_deg_s2 = self._settings[120]
        else:
            self._emit("error: Invalid statement\r\n", command)
            return
        self._emit("ok\r\n", command)

    def _code(self, line: str, command: Command) -> None:
        found = words(line)
        if not found:
            self._emit("error: Expected command letter\r\n", command)
            return
        value = dict(found)
        if value.get("F", 0) > 0:
            self._feed_deg_s = min(value["F"], self._settings[110])
        if "G" in value and value["G"] not in (0, 1, 50):
            self._emit("error: Unsupported command\r\n", command)
            return
        if "M" in value and not self._miscellaneous(int(value["M"]), int(value.get("T", 0))):
            self._emit("error: Unsupported command\r\n", command)
            return
        if value.get("G") == 50:
            self._body.recount(0)
        if "X" in value:
            if self._feed_deg_s <= 0:
                self._emit("error: Undefined feed rate\r\n", command)
                return
            self._axis.queue.append(Motion(value["X"], self._feed_deg_s, command))
            if self.early_ok:
                self._emit("ok\r\n", command)
            return  # else ok follows when the motion has ended
        self._emit("ok\r\n", command)

    def _miscellaneous(self, code: int, output: int) -> bool:
        if code in (17, 18):
            self._motor = code == 17
            self._body.hold(on=self._motor)
        elif code in (70, 71) and output in (1, 2):
            self._body.switch(output, on=code == 71)
            if code == 71:
                self._lit_ns.setdefault(output, self._body.clock.now_ns())
            else:
                self._lit_ns.pop(output, None)
        else:
            return False
        return True
