"""The ``turnscan`` dialect: numbered requests with CRC; lost and damaged ones are just repeated."""

from __future__ import annotations

import contextlib
import time

from ....schemas.errors import DeviceError
from ..contracts import DeviceInfo
from ..serial_link import SerialLink
from .contract import Setup, Status, no_banner
from .turnscan_lines import PROTOCOL, RESET, Line, parse_line

_ATTEMPTS = 3
_WANTED = f"turnscan firmware, protocol {PROTOCOL}"


class TurnscanDialect:
    """Speaks the protocol of docs/controllers.md."""

    def __init__(self, link: SerialLink, setup: Setup) -> None:
        self._link = link
        self._setup = setup
        self._number = 0
        self._encoder = False
        self._held = False
        self._origin_lost = False
        self._sent_ns = 0

    @property
    def sees_missed_steps(self) -> bool:
        """With an encoder on the motor's shaft."""
        return self._encoder

    def wake(self) -> DeviceInfo:
        """Reset, ask who is there, set speeds, limits and watchdog, hold the motor."""
        self._held = False
        self._reset()
        facts = self._request("HELLO").values()
        self._encoder = facts.get("encoder") == "1"
        lasers = int(facts.get("lasers", "0"))
        if max(self._setup.outputs) > lasers:
            raise DeviceError(
                f"the board has {lasers} laser outputs, the rig file names {max(self._setup.outputs)}",
                hint="correct output in [[lasers]]",
            )
        s, k = self._setup, self._setup.microsteps_per_degree
        self._request(
            "SET",
            f"speed={max(round(s.speed_deg_s * k), 1)}",
            f"accel={max(round(s.acceleration_deg_s2 * k), 1)}",
            f"watchdog={round(s.watchdog_s * 1000)}",
            f"min={round(s.min_deg * k)}",
            f"max={round(s.max_deg * k)}",
        )
        self._origin_lost = False
        self.hold()
        kept = {"1": "yes", "0": "no"}.get(facts.get("kept", ""), "unknown")
        return DeviceInfo(
            f"turnscan controller, firmware {facts.get('fw', 'unknown')}",
            {**facts, "position_kept": kept},
        )

    def hold(self) -> None:
        """MOTOR on."""
        if not self._held:
            self._request("MOTOR", "on")
            self._held = True

    def release(self) -> None:
        """MOTOR off, after STOP if it turns."""
        self.stop()
        self._held = False
        self._request("MOTOR", "off")

    def start(self, angle_deg: float, speed_deg_s: float) -> None:
        """MOVE; a step counter that lags behind the encoder is set right before."""
        self._refuse_lost()
        self.hold()
        k = self._setup.microsteps_per_degree
        if self._encoder:
            values = self._request("STAT").values()
            if values["pos"] != values["enc"]:
                self._request("SYNC")
        self._request("MOVE", f"{round(angle_deg * k)}", f"{max(round(speed_deg_s * k), 1)}")

    def status(self, *, waiting: bool = False) -> Status:  # noqa: ARG002 - numbers tell replies apart
        """STAT; the encoder's position where there is one."""
        line = self._request("STAT")
        t_ns = (self._sent_ns + self._link.clock.now_ns()) // 2
        values = line.values()
        steps = values["enc"] if self._encoder else values["pos"]
        angle = int(steps) / self._setup.microsteps_per_degree
        return Status(t_ns, angle, line.words[1] == "busy")

    def stop(self) -> None:
        """STOP, and wait for the braking to end."""
        self._request("STOP")
        until = time.monotonic() + self._link.timeout_s + self._braking_s()
        while self.status().moving:
            if time.monotonic() > until:
                raise DeviceError("the turntable does not stop", hint="switch its power off")
            time.sleep(0.01)

    def _braking_s(self) -> float:
        return self._setup.speed_deg_s / self._setup.acceleration_deg_s2

    def laser(self, output: int, *, on: bool) -> None:
        """LASER; the reply's mask must say the same."""
        word = "on" if on else "off"
        mask = int(self._request("LASER", str(output), word).values().get("lasers", "0"), 16)
        if bool(mask >> (output - 1) & 1) != on:
            raise DeviceError(
                f"laser output {output} was switched {word}, the board says lasers={mask:02X}",
                hint="a laser may be lit: switch its power off, and check the board",
            )

    def dark(self) -> None:
        """CAN: the firmware switches everything off at once and says READY."""
        self._held = False
        self._reset()
        # Torn out of a motion, a board without encoder has lost its place.
        self._origin_lost = True
        lasers = self._request("STAT").values().get("lasers")
        if lasers != "00":
            raise DeviceError(f"after a reset the board says lasers={lasers}", hint="switch it off")
        with contextlib.suppress(DeviceError):
            self._origin_lost = self._request("HELLO").values().get("kept") != "1"

    def keep_alive(self) -> None:
        """PING: every good request resets the watchdog."""
        self._request("PING")

    # -- lines --------------------------------------------------------------------------------------

    def _reset(self) -> None:
        seen: list[str] = []
        until = time.monotonic() + self._link.timeout_s
        for attempt in range(_ATTEMPTS):
            # The line end closes what damaged bytes may have begun.
            self._link.send(RESET)
            wait = time.monotonic() + self._link.timeout_s * (attempt + 1) / _ATTEMPTS
            while True:
                text = self._link.read_line(min(wait, until))
                if text is None:
                    break
                line = parse_line(text)
                if line is not None and line.words[:2] == ("READY", "turnscan"):
                    if line.values().get("proto") != str(PROTOCOL):
                        raise no_banner(self._link, _WANTED, [text])
                    if line.values().get("cause") == "reset":
                        return
                seen.append(text)
        raise no_banner(self._link, _WANTED, seen)

    def _refuse_lost(self) -> None:
        if self._origin_lost:
            raise DeviceError(
                "the controller restarted by itself; its position is lost",
                hint="check its power, turn the table to its zero, and connect again",
            )

    def _request(self, *words: str) -> Line:
        """The OK reply to a request; repeated under the same number until it comes.

        STAT gets a new number each time: a repeated reply would be an old position.
        """
        timeout = self._link.timeout_s
        until = time.monotonic() + timeout
        seen: list[str] = []
        line = self._numbered(words)
        for attempt in range(_ATTEMPTS):
            if attempt and words[0] == "STAT":
                line = self._numbered(words)
            self._sent_ns = self._link.send(line.text())
            share = timeout * (attempt + 1) / (_ATTEMPTS * (_ATTEMPTS + 1) / 2)
            last = attempt == _ATTEMPTS - 1
            reply = self._reply_to(line, until if last else time.monotonic() + share, seen)
            if reply is not None:
                return reply
        what = " ".join(words)
        shown = f"; saw {'; '.join(seen[:3])[:100]!r}" if seen else ""
        raise DeviceError(
            f"the controller did not answer {what!r} in {timeout:g} s, asked {_ATTEMPTS} times{shown}",
            hint="check cable and power, then turnscan rig check RIG",
        )

    def _numbered(self, words: tuple[str, ...]) -> Line:
        self._number = self._number % 0xFFFF + 1
        return Line(">", self._number, words)

    def _reply_to(self, request: Line, until: float, seen: list[str]) -> Line | None:
        """The reply, or None if the request must be sent again."""
        while True:
            text = self._link.read_line(until)
            if text is None:
                return None
            line = parse_line(text)
            if line is None:
                seen.append(text)
            elif line.mark == "!":
                self._event(line)
            elif line.words[0] == "NAK":
                seen.append(text)
                return None
            elif line.number == request.number:
                return self._accepted(request, line)
            # Another number: the late reply to a request that was given up. Not ours.

    def _event(self, line: Line) -> None:
        # One that a reset of ours caused may come late, and means nothing more.
        if line.words[0] == "READY" and line.values().get("cause") != "reset":
            self._held = False
            self._origin_lost = True
            self._refuse_lost()
        if line.words[0] == "WATCHDOG":
            raise DeviceError(
                f"the controller's watchdog switched the lasers off after {self._setup.watchdog_s:g} s",
                hint="the computer was too slow or asleep; watchdog_s in [turntable] sets the time",
            )

    def _accepted(self, request: Line, reply: Line) -> Line:
        if reply.words[0] == "OK":
            return reply
        raise DeviceError(
            f"the controller refused {' '.join(request.words)!r}: {' '.join(reply.words[1:])}",
            hint="docs/controllers.md lists what NO codes mean",
        )
