"""Grbl 1.1: ``ok`` to G1 means planned, not finished; M3, M5 and settings wait for the motions' end."""

from __future__ import annotations

from collections import deque

from .body import Body
from .faults import Command
from .gcode import HOLD, REAL_TIME, RESET, RESUME, STATUS, Axis, Motion, setting, sort, tidy, words
from .port import Emit

BANNER = "\r\nGrbl 1.1h ['$' for help]\r\n"
LOCKED = "[MSG:'$H'|'$X' to unlock]\r\n"
#: Motions that the planner holds before a further one has to wait for its ok.
PLANNER = 15
_DEFAULTS = {
    0: 10.0,
    1: 25.0,
    10: 1.0,
    13: 0.0,
    20: 0.0,
    30: 1000.0,
    32: 0.0,
    100: 250.0,
    110: 500.0,
    120: 10.0,
}
_WHOLE = frozenset({0, 1, 10, 13, 20, 30, 32})


class GrblFirmware:
    """One axis in degrees (Grbl's millimetres), the spindle's pin as the laser."""

    real_time = REAL_TIME
    usb_powered = True

    def __init__(self, body: Body, emit: Emit) -> None:
        self.baud = 115200
        self._body = body
        self._emit = emit
        self._settings = dict(_DEFAULTS)
        self._axis = Axis(body, self._settings[100], self._settings[120])
        self._lines: deque[Command] = deque()
        self._alarm = False
        self._asleep = False
        self._feed_deg_min = 0.0
        self._reports = 0

    def boot(self) -> None:
        """Power on."""
        self._emit(BANNER, None)

    def sort(self, line: str) -> str:
        """What sort of command this is. An empty line is a command to Grbl, but no fault hits it."""
        return sort(line)

    def refuse(self, command: Command) -> None:
        """An error reply, and nothing done."""
        self._emit("error:20\r\n", command)

    def take_line(self, command: Command) -> None:
        """Lines wait for each other; asleep, none is heard."""
        if not self._asleep:
            self._lines.append(command)
            self._go_on()

    def tick(self) -> None:
        """Motions in turn, and lines that waited for them."""
        if self._axis.tick() is not None and not self._axis.busy:
            self._body.hold(on=self._settings[1] == 255)
        self._go_on()

    def take_byte(self, command: Command) -> None:
        """Status, feed hold, resume and reset act at once."""
        if command.text == STATUS:
            self._emit(self._report(), command)
        elif command.text == HOLD:
            self._axis.hold(at_rest=True)
        elif command.text == RESUME:
            self._axis.resume()
        elif command.text == RESET:
            self._reset(command)

    def _reset(self, command: Command) -> None:
        if self._axis.abort():
            self._alarm = True
            self._emit("ALARM:3\r\n", command)
        self._alarm = self._alarm or self._asleep
        self._asleep = False
        self._lines.clear()
        self._body.all_off()
        self._body.hold(on=self._settings[1] == 255 and not self._alarm)
        self._emit(BANNER, command)
        if self._alarm:
            self._emit(LOCKED, command)

    def _report(self) -> str:
        self._reports += 1
        fields = [self._state(), f"MPos:{self._axis.position_deg:.3f},0.000,0.000", "FS:0,0"]
        if self._reports % 30 == 1:
            fields.append("WCO:0.000,0.000,0.000")
        elif self._reports % 30 == 2:
            fields.append("Ov:100,100,100")
        return f"<{'|'.join(fields)}>\r\n"

    def _state(self) -> str:
        if self._asleep:
            return "Sleep"
        if self._alarm:
            return "Alarm"
        if self._axis.held:
            return "Hold:1" if self._body.moving else "Hold:0"
        return "Run" if self._axis.busy else "Idle"

    def _go_on(self) -> None:
        while self._lines:
            line = tidy(self._lines[0].text)
            if self._axis.busy and not self._passes(line):
                return
            self._obey(line, self._lines.popleft())

    def _passes(self, line: str) -> bool:
        """Whether Grbl takes this line while it moves: motions to plan, and what it refuses."""
        if line.startswith("$"):
            return True  # answered with error:8
        return sort(line) in ("move", "empty") and len(self._axis.queue) < PLANNER

    def _obey(self, line: str, command: Command) -> None:
        if not line:
            self._emit("ok\r\n", command)
        elif line.startswith("$"):
            self._dollar(line, command)
        elif self._alarm:
            self._emit("error:9\r\n", command)
        else:
            self._code(line, command)

    def _dollar(self, line: str, command: Command) -> None:
        given = setting(line)
        if line == "$X":
            if self._alarm:
                self._emit("[MSG:Caution: Unlocked]\r\n", command)
            self._alarm = False
            self._body.hold(on=self._settings[1] == 255)
        elif self._axis.busy:
            self._emit("error:8\r\n", command)
            return
        elif line == "$$":
            for number, value in sorted(self._settings.items()):
                self._emit(f"${number}={value:.{0 if number in _WHOLE else 3}f}\r\n", command)
        elif line == "$SLP":
            self._emit("ok\r\n", command)
            self._asleep = True
            self._body.all_off()
            self._body.hold(on=False)
            self._emit("[MSG:Sleeping]\r\n", command)
            return
        elif given is not None and given[0] in self._settings:
            self._settings[given[0]] = given[1]
            self._axis.steps_per_degree = self._settings[100]
            self._axis.acceleration_deg_s2 = self._settings[120]
            self._body.hold(on=self._settings[1] == 255)
        else:
            self._emit("error:3\r\n", command)
            return
        self._emit("ok\r\n", command)

    def _code(self, line: str, command: Command) -> None:
        found = words(line)
        if not found:
            self._emit("error:1\r\n", command)
            return
        codes = {(a, v) for a, v in found if a in "GM"}
        value = {a: v for a, v in found if a not in "GM"}
        known = {("G", 0), ("G", 1), ("G", 21), ("G", 53), ("G", 90), ("G", 94), ("M", 3), ("M", 5)}
        if not codes <= known:
            self._emit("error:20\r\n", command)
            return
        self._feed_deg_min = value.get("F", self._feed_deg_min)
        if ("M", 5) in codes or (("M", 3) in codes and not value.get("S")):
            self._body.switch(1, on=False)
        elif ("M", 3) in codes:
            self._body.switch(1, on=True)
        if "X" in value:
            if self._feed_deg_min <= 0:
                self._emit("error:22\r\n", command)
                return
            speed = min(self._feed_deg_min, self._settings[110]) / 60
            self._axis.queue.append(Motion(value["X"], speed, command))
        self._emit("ok\r\n", command)
