"""The rhythm in which frames arrive: which of them may be late, how many are missing, whether it slows.

A source that does not say when it exposed a frame is known by arrivals alone. After a pause the frames
that queued up on the way come all at once, and their arrival says nothing of their age. So a frame is
believed only if it came in rhythm; what comes after a pause, or too soon after another, is in doubt.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

#: Intervals between these multiples of the period are in rhythm.
_SHORTEST: Final = 0.5
_LONGEST: Final = 1.5
#: The period is known after so many intervals, or after fewer that took this long together.
_ENOUGH: Final = 12
_FEW: Final = 3
_LONG_NS: Final = 500_000_000
#: In less time than this, frames may all have waited somewhere.
_SHORT_NS: Final = 100_000_000
#: The rate is judged over this time, or over so many periods if they are longer.
_WINDOW_NS: Final = 1_300_000_000
_WINDOW_PERIODS: Final = 6


class Pace:
    """Learns the period from the first intervals, then judges each arrival by it."""

    def __init__(self) -> None:
        self._first: list[int] = []
        self._last_ns: int | None = None
        self._recent: deque[int] = deque()
        self._since_ns = 0
        self._owed = 0
        self._early = 0
        #: The learned period; None until it is known.
        self.period_ns: int | None = None

    def note(self, arrived_ns: int) -> tuple[bool, int]:
        """Whether this frame came in rhythm, and how many frames before it are missing for good."""
        last, self._last_ns = self._last_ns, arrived_ns
        if last is None:
            return False, 0
        interval = arrived_ns - last
        if self.period_ns is None:
            self._learn(interval, arrived_ns)
            return False, 0
        self._recent.append(arrived_ns)
        while self._recent[0] < arrived_ns - self._window_ns():
            self._recent.popleft()
        if interval > _LONGEST * self.period_ns:
            self._owed += round(interval / self.period_ns) - 1
            return False, 0
        if interval < _SHORTEST * self.period_ns:
            self._come_early()
            return False, 0
        missing, self._owed = self._owed, 0
        self._early = 0
        return True, missing

    def _come_early(self) -> None:
        if self._owed:
            # One of those that seemed missing was only late.
            self._owed -= 1
            return
        self._early += 1
        if self._early >= _ENOUGH:
            # Nothing is owed, and still they come: the source has become faster.
            self.period_ns = None
            self._first.clear()
            self._early = 0

    def _learn(self, interval: int, arrived_ns: int) -> None:
        self._first.append(interval)
        known, took_ns = self._first, sum(self._first)
        if took_ns < _SHORT_NS or (len(known) < _ENOUGH and (len(known) < _FEW or took_ns < _LONG_NS)):
            return
        # Frames buffered while opening come at once and would pull a median down.
        period_ns = int(np.quantile(known, 0.75, method="higher"))
        if period_ns < _SHORTEST * took_ns / len(known):
            # Most of them came at once, after a pause: no rhythm.
            del known[: len(known) // 2]
            return
        self.period_ns = period_ns
        self._since_ns = arrived_ns
        self._recent.clear()

    def rate_hz(self, now_ns: int) -> float | None:
        """Frames a second over the last window; None until a whole one has passed in a known rhythm."""
        window_ns = self._window_ns()
        if self.period_ns is None or now_ns - self._since_ns < window_ns:
            return None
        return sum(1 for t in self._recent if t >= now_ns - window_ns) * 1e9 / window_ns

    def _window_ns(self) -> int:
        return max(_WINDOW_NS, _WINDOW_PERIODS * (self.period_ns or 0))
