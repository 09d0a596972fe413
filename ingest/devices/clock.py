"""The session's clock: UTC nanoseconds that never run backwards."""

from __future__ import annotations

import time


class SystemClock:
    """The system's UTC time at the start, carried on by the monotonic clock.

    A step of the system's time (NTP, summer time set by hand) during a scan therefore moves nothing.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """The present time; later calls give equal or later times."""
        return time.monotonic_ns() + self._offset_ns

    def sleep_s(self, duration_s: float) -> None:
        """Wait at least ``duration_s``."""
        if duration_s > 0:
            time.sleep(duration_s)
