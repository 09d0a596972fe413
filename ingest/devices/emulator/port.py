"""A firmware on a pseudo-terminal of its own: bytes in, bytes out, with delays and damage on the way.

The driver opens ``port`` with pyserial as it would a USB converter. Replies keep their order, as on a
wire: one that is late makes all after it late. The baud rate that the driver set is read back from the
terminal, and another than the firmware's makes garbage of both directions.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import termios
import threading
import tty
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from ....schemas.rig import Fault
from .body import Body, PhysicalState
from .faults import Command, FaultPlan

_NS = 1_000_000_000
#: How often the firmware's timers are looked at while nothing comes in.
_TICK_S = 0.002

#: Hand text to the wire; the command that it answers decides what goes wrong with it on the way.
Emit = Callable[[str, Command | None], None]


class Firmware(Protocol):
    """What an emulated firmware does with what it hears. Called from the emulator's thread only."""

    baud: int
    #: Single bytes that are acted on at once, outside of lines.
    real_time: frozenset[int]
    #: Whether the board lives on the USB cable's current and dies with it.
    usb_powered: bool

    def boot(self) -> None:
        """Power was switched on."""

    def sort(self, line: str) -> str:
        """What sort of command this is (see :class:`Command`)."""

    def take_line(self, command: Command) -> None:
        """Act on a line, without its end."""

    def take_byte(self, command: Command) -> None:
        """Act on a real-time byte."""

    def refuse(self, command: Command) -> None:
        """Refuse a line without acting on it (fault ``nak``)."""

    def tick(self) -> None:
        """Look at timers and motions."""


class Emulator:
    """A running emulated controller. A context manager; ``stop`` may be called more than once."""

    def __init__(
        self,
        firmware: Callable[[Body, Emit], Firmware],
        body: Body,
        faults: tuple[Fault, ...] = (),
        *,
        seed: int = 1,
    ) -> None:
        self.body = body
        self.plan = FaultPlan(faults)
        self.port = ""
        self._firmware = firmware(body, self._emit)
        self._random = random.Random(seed)  # noqa: S311 - noise, no secret
        self._out: deque[tuple[int, bytes]] = deque()
        self._line = bytearray()
        self._ends: list[int] = []
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        #: Why the emulation ended, if it was a bug of its own.
        self.failure: BaseException | None = None

    def start(self) -> Self:
        """Open the pseudo-terminal and switch the board on."""
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        # The slave stays open here: else the master would see a hang-up whenever the driver closes.
        self._ends = [master, slave]
        self.port = os.ttyname(slave)
        self._firmware.boot()
        self._thread = threading.Thread(target=self._run, name="controller-emulator", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Switch off: everything goes dark and the port disappears."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=5)
        self._close()
        self.body.stop()
        self.body.all_off()
        self.body.hold(on=False)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.stop()

    def state(self, t_ns: int | None = None) -> PhysicalState:
        """What is, or was, really so (see :class:`PhysicalState`)."""
        return self.body.state(t_ns)

    def say(self, data: bytes) -> None:
        """Put bytes on the wire that nobody asked for."""
        self._out.append((self.body.clock.now_ns(), data))

    # -- the wire -----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                self._firmware.tick()
                self._send_due()
                if not self._ends:  # the cable is out, the firmware goes on
                    self._stopping.wait(_TICK_S)
                    continue
                if select.select([self._ends[0]], [], [], _TICK_S)[0]:
                    self._hear()
        except Exception as error:  # noqa: BLE001 - shown by whoever looks at the emulator
            self.failure = error
        finally:
            self._close()

    def _hear(self) -> None:
        try:
            data = os.read(self._ends[0], 4096)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            self._close()
            return
        if self._wrong_baud():
            self._out.append((self.body.clock.now_ns(), self._garbage(max(len(data), 8))))
            return
        for byte in data:
            if not self._ends:
                return
            if byte in self._firmware.real_time:
                self._act(chr(byte), self._firmware.take_byte)
            elif byte in b"\r\n":
                line = self._line.decode("ascii", "replace")
                self._line.clear()
                self._act(line, self._firmware.take_line)
            elif len(self._line) < 256:
                self._line.append(byte)

    def _act(self, text: str, act: Callable[[Command], None]) -> None:
        command = Command(text, self._firmware.sort(text))
        if command.sort == "empty":
            act(command)
            return
        self.plan.meet(command)
        if command.fault("hang-up"):
            self._hang_up()
        elif command.fault("lost-command"):
            return
        elif command.fault("nak") and act == self._firmware.take_line:
            self._firmware.refuse(command)
        else:
            act(command)

    def _emit(self, text: str, command: Command | None) -> None:
        data = text.encode("ascii")
        due = self.body.clock.now_ns()
        if command is not None:
            if command.fault("lost-reply"):
                return
            if command.fault("garbage"):
                data = self._garbage(len(data))
            delay = command.fault("delay")
            if delay is not None:
                due += round(delay.delay_s * _NS)
        self._out.append((due, self._garbage(len(data)) if self._wrong_baud() else data))

    def _send_due(self) -> None:
        while self._out and self._out[0][0] <= self.body.clock.now_ns():
            _, data = self._out.popleft()
            if self._ends:
                with contextlib.suppress(BlockingIOError):  # nobody reads: a real wire forgets, too
                    os.write(self._ends[0], data)

    def _garbage(self, count: int) -> bytes:
        noise = bytes(
            self._random.choice(b"\x00\xff\xc3~#x\x80\xfe|") for _ in range(max(count - 2, 1))
        )
        return noise + b"\r\n"

    def _wrong_baud(self) -> bool:
        if not self._ends:
            return False
        speed = termios.tcgetattr(self._ends[1])[5]
        return speed in _BAUDS and _BAUDS[speed] != self._firmware.baud

    def _hang_up(self) -> None:
        self._close()
        self._out.clear()
        if self._firmware.usb_powered:
            self.body.stop()
            self.body.all_off()
            self.body.hold(on=False)

    def _close(self) -> None:
        ends, self._ends = self._ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                os.close(end)


#: Terminal speed constants and what they stand for; a fresh pseudo-terminal says 38400 or 0.
_BAUDS = {
    getattr(termios, f"B{n}"): n
    for n in (9600, 19200, 57600, 115200, 230400, 460800, 921600)
    if hasattr(termios, f"B{n}")
}
