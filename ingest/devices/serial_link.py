"""A serial port as lines: opened once, exclusively, every line heard by the scan log.

pyserial does the port; this file turns its many failures into DeviceErrors that say what to try.
"""

from __future__ import annotations

import contextlib
import errno
import termios
import time

import serial
from serial.tools import list_ports

from ...schemas.errors import DeviceError
from .contracts import Clock, LineHeard

#: A line longer than this is garbage, whatever it is.
_LONGEST = 512
_POLL_S = 0.02


def port_names() -> list[str]:
    """The serial ports of this machine."""
    return sorted(p.device for p in list_ports.comports())


class SerialLink:
    """One serial port; every method but ``close`` raises DeviceError when the port fails."""

    def __init__(
        self,
        port: str,
        baud: int,
        *,
        timeout_s: float,
        clock: Clock,
        device: str = "turntable",
        heard: LineHeard | None = None,
    ) -> None:
        self.port = port
        self.baud = baud
        self.timeout_s = timeout_s
        self.clock = clock
        self._device = device
        self._heard = heard
        self._serial: serial.Serial | None = None
        self._pending = bytearray()

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._serial is not None

    def check_open(self) -> None:
        """DeviceError unless the port is open."""
        self._opened()

    def open(self) -> None:
        """Open the port, alone; what waited in it is thrown away."""
        self.close()
        try:
            port = serial.Serial(
                self.port,
                self.baud,
                timeout=_POLL_S,
                write_timeout=self.timeout_s,
                exclusive=True,
            )
        except (OSError, ValueError, termios.error) as error:
            raise self._not_opened(error) from error
        self._serial = port
        self._pending.clear()
        # Boards that reset when DTR falls would forget their position whenever a program ends.
        with contextlib.suppress(termios.error, OSError):
            attributes = termios.tcgetattr(port.fileno())
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)

    def close(self) -> None:
        """Give the port back; never fails."""
        port, self._serial = self._serial, None
        if port is not None:
            with contextlib.suppress(OSError, termios.error):
                port.close()

    def send(self, text: str, *, end: str = "\n") -> int:
        """Send a line (or with ``end = ""`` single characters); returns when, as t_ns."""
        port = self._opened()
        t_ns = self.clock.now_ns()
        try:
            port.write((text + end).encode("ascii"))
        except (OSError, termios.error) as error:
            raise self._gone(error) from error
        self._tell("sent", text.encode("ascii"), t_ns)
        return t_ns

    def read_line(self, until_s: float) -> str | None:
        """The next line without its end, or None at ``until_s`` (of ``time.monotonic``).

        Bytes that are not printable come in hex, so that garbage stays visible and matches nothing.
        Empty lines are not reported.
        """
        port = self._opened()
        while True:
            line = self._next_line()
            if line is not None:
                return line
            if time.monotonic() >= until_s:
                return None
            try:
                data = port.read(port.in_waiting or 1)
            except (OSError, termios.error) as error:
                raise self._gone(error) from error
            self._pending += data

    def drain(self, quiet_s: float, longest_s: float) -> list[str]:
        """Lines until nothing came for ``quiet_s``, at most ``longest_s`` long."""
        lines = []
        until = time.monotonic() + longest_s
        while time.monotonic() < until:
            line = self.read_line(min(time.monotonic() + quiet_s, until))
            if line is None:
                break
            lines.append(line)
        return lines

    def partial(self) -> str:
        """What came of a line that has no end yet."""
        return _shown(bytes(self._pending))

    def _next_line(self) -> str | None:
        while True:
            ends = [i for i in (self._pending.find(b"\n"), self._pending.find(b"\r")) if i >= 0]
            if not ends:
                if len(self._pending) <= _LONGEST:
                    return None
                ends = [_LONGEST]
            data = bytes(self._pending[: min(ends)])
            del self._pending[: min(ends) + 1]
            if data:
                self._tell("received", data, self.clock.now_ns())
                return _shown(data)

    def _tell(self, direction: str, data: bytes, t_ns: int) -> None:
        if self._heard is not None:
            self._heard(self._device, direction, _shown(data), t_ns)

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise DeviceError(
                f"{self._device}: the port {self.port} is not open", hint="connect to the rig first"
            )
        return self._serial

    def _gone(self, error: Exception) -> DeviceError:
        self.close()
        if isinstance(error, serial.SerialTimeoutException):
            return DeviceError(
                f"{self._device}: {self.port} took no data for {self.timeout_s:g} s",
                hint="is the controller switched on?",
            )
        return DeviceError(
            f"{self._device}: {self.port} hung up",
            hint="check cable and power, then turnscan rig check RIG",
        )

    def _not_opened(self, error: Exception) -> DeviceError:
        number = _number(error)
        start = f"{self._device}: cannot open {self.port}"
        if number == errno.ENOENT:
            here = ", ".join(port_names()) or "none"
            return DeviceError(
                f"{start}: there is no such port; ports here: {here}",
                hint="plug it in, and see turnscan rig ports",
            )
        if number in (errno.EBUSY, errno.EAGAIN):
            return DeviceError(
                f"{start}: the port is busy",
                hint="another program has it open: end that, or give another port",
            )
        if number in (errno.EACCES, errno.EPERM):
            return DeviceError(
                f"{start}: no permission",
                hint="on Debian, add yourself to the group dialout and log in again",
            )
        if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
            return DeviceError(
                f"{start}: it is no serial port, or does not know {self.baud} baud",
                hint="turnscan rig ports lists the serial ports",
            )
        return DeviceError(f"{start}: {error}", hint="turnscan rig ports lists the serial ports")


def _number(error: BaseException | None) -> int | None:
    """The errno behind an error; pyserial hides some in the error that it was made from."""
    while error is not None:
        first = error.args[0] if error.args else None
        number = getattr(error, "errno", None) or (first if isinstance(first, int) else None)
        if number is not None:
            return int(number)
        error = error.__context__
    return None


def _shown(data: bytes) -> str:
    """Printable text; other bytes as backslash, x and two hex digits."""
    return "".join(chr(b) if 32 <= b < 127 else f"\\x{b:02X}" for b in data)
