"""Ctrl-C, SIGTERM and hang-up of the terminal, let in only where a session can take them.

A signal that comes at any other time (while the laser is switched off, while a message is written)
waits for the next such place. Nothing that ends the session can be interrupted again.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class InterruptedSession(KeyboardInterrupt):
    """The user (or the system) asked the session to end."""


class Interrupts:
    """A context in which the signals belong to the session; in threads other than the first it does
    nothing, since signals never reach those.
    """

    def __init__(self) -> None:
        self._before: dict[int, Any] = {}
        self._open = False
        #: How often an end was asked for.
        self.asked = 0
        self._heeded = 0

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                self._before[number] = signal.signal(number, self._heard)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _heard(self, _number: int, _frame: FrameType | None) -> None:
        self.asked += 1
        if self._open:
            self._raise()

    def _raise(self) -> None:
        self._open = False
        self._heeded = self.asked
        raise InterruptedSession

    def check(self) -> None:
        """Raise InterruptedSession if an end was asked for since the last time."""
        if self.asked > self._heeded:
            self._raise()

    @contextmanager
    def let_in(self) -> Iterator[None]:
        """Signals interrupt what runs in here, at once: waiting for a device, or for time."""
        self._open = True
        try:
            self.check()
            yield
        finally:
            self._open = False
