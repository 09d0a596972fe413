"""The thread that always fetches: stamps frames, keeps the newest, watches the source, counts losses.

Frames therefore never wait in a driver's or a socket's buffer where their age cannot be told.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from ....schemas.errors import DeviceError, TurnscanError
from ..contracts import CameraInfo, Clock, Shot
from .capture import Capture, DamagedFrameError, Fetched
from .pace import Pace
from .queue import ShotQueue
from .watch import BlackWatch, Limits, SilenceWatch, check_form, check_rate

Answer = TypeVar("Answer")

#: A frame may have been exposed so many periods before it arrived: sensors read one frame out while
#: they expose the next, and the path to us takes time. Where the driver stamps frames, one covers both
#: of the customs that there are (start of exposure, end of readout).
_PERIODS_ARRIVAL: Final = 2
_PERIODS_DRIVER: Final = 1
#: So many periods after it was set, an exposure begins that surely has the new exposure time: the one
#: that runs keeps the old, and sensors take a new one over with the frame after.
_PERIODS_LATCH: Final = 2
_JOIN_S: Final = 4.0


@dataclass(frozen=True)
class Taken:
    """A shot, and the earliest time at which its exposure can have begun."""

    shot: Shot
    began_ns: int


class Drain:
    """Owns the capture from :meth:`start` on, until it is closed or the source fails."""

    def __init__(
        self, capture: Capture, info: CameraInfo, clock: Clock, limits: Limits, fps: float | None
    ) -> None:
        self._capture = capture
        self._info = info
        self._clock = clock
        self._fps = fps
        self._pace = Pace()
        self._black = BlackWatch(capture.name, limits)
        self._silence = SilenceWatch(capture.name, limits)
        self._thread = threading.Thread(target=self._run, name=f"drain {capture.name}", daemon=True)
        self._news = threading.Condition()
        self._stopping = False
        self._failure: Exception | None = None
        # What was told once stays, even if frames come again: nobody knows what happened in between.
        self._told: Exception | None = None
        self._number = 0
        self._newest: Taken | None = None
        self._missing = 0
        self._queue: ShotQueue | None = None
        known = info.settings.get("exposure_us")
        self._exposure_us = float(known) if known is not None else None
        # What was read back may be rounded; asking for the same again changes nothing.
        self._asked_us = self._exposure_us
        self._wanted_us: float | None = None
        self._refusal: DeviceError | None = None
        self._latched_ns = 0

    def start(self) -> None:
        """Begin to drain."""
        self._thread.start()

    def close(self) -> None:
        """Stop draining and give the source back. A source that hangs keeps its (daemon) thread."""
        with self._news:
            self._stopping = True
            self._news.notify_all()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)

    # What the camera asks, in the thread of the one who records.

    def shot_after(self, after_ns: int, timeout_s: float) -> Shot:
        """The newest frame, once its exposure cannot have begun before ``after_ns``."""

        def ready() -> Shot | None:
            taken = self._newest
            if taken is None or taken.began_ns < max(after_ns, self._latched_ns):
                return None
            self._newest = None
            dropped, self._missing = self._missing, 0
            self._check_black(taken.shot)
            return replace(taken.shot, dropped=dropped)

        ahead_s = max(0.0, (after_ns - self._clock.now_ns()) / 1e9)
        return self._wait(ready, ahead_s + timeout_s)

    def change_exposure(self, exposure_us: float, timeout_s: float) -> None:
        """Have the thread set another exposure time; frames that may have the old one are not given."""
        with self._news:
            if exposure_us == self._asked_us:
                return
            self._wanted_us = exposure_us
            self._refusal = None

        def ready() -> bool | None:
            if self._refusal is not None:
                raise self._refusal
            return True if self._wanted_us is None else None

        self._wait(ready, timeout_s)

    def begin_queue(self) -> None:
        """Keep every frame from now on, for :meth:`next_queued`."""
        with self._news:
            self._queue = ShotQueue(self._info, self._clock.now_ns())

    def next_queued(self, timeout_s: float) -> Shot:
        """The next frame kept since :meth:`begin_queue`."""

        def ready() -> Shot | None:
            shot = None if self._queue is None else self._queue.pop()
            if shot is not None:
                self._check_black(shot)
            return shot

        return self._wait(ready, timeout_s)

    def end_queue(self) -> None:
        """Keep the newest frame only."""
        with self._news:
            self._queue = None

    def _wait(self, ready: Callable[[], Answer | None], timeout_s: float) -> Answer:
        deadline = time.monotonic() + timeout_s
        with self._news:
            while True:
                if self._told is not None:
                    raise self._again(self._told)
                answer = ready()
                if answer is not None:
                    return answer
                self._check()
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise DeviceError(
                        f"{self._capture.name}: no frame within {timeout_s:.1f} s whose time of "
                        f"exposure is sure ({self._number} frames came since it was opened)",
                        hint="frames come too slowly or too irregularly: raise timeout_s, or lower the "
                        "load on network and machine",
                    )
                # Short, because a source that falls silent wakes nobody.
                self._news.wait(min(left_s, 0.05))

    def _check(self) -> None:
        """Raise what the thread found, or that the source fell silent."""
        if self._failure is None and self._stopping:
            raise DeviceError(f"{self._capture.name}: was closed")
        if self._failure is None:
            self._failure = self._silence.found(self._slowest_s())
        if self._failure is not None:
            self._told = self._failure
            raise self._again(self._failure)

    def _check_black(self, shot: Shot) -> None:
        try:
            self._black.check_given(shot.image, time.monotonic_ns())
        except DeviceError as error:
            self._told = error
            raise

    @staticmethod
    def _again(error: Exception) -> Exception:
        """The same error anew: one that is raised twice would carry both its ways."""
        if isinstance(error, TurnscanError):
            return type(error)(error.message, hint=error.hint)
        return error

    def _slowest_s(self) -> float:
        """What one frame may take at most."""
        return max(
            (self._pace.period_ns or 0) / 1e9,
            (self._exposure_us or 0.0) / 1e6,
            0.0 if self._fps is None else 1 / self._fps,
        )

    # The thread.

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._set_wanted()
                self._fetch_one()
        except Exception as error:  # noqa: BLE001 (bugs too must reach the one who asks, not die here)
            with self._news:
                self._failure = self._failure or error
                self._news.notify_all()
        finally:
            self._capture.close()

    def _set_wanted(self) -> None:
        wanted = self._wanted_us
        if wanted is None:
            return
        refusal = None
        found = self._exposure_us
        try:
            found = self._capture.set_exposure(wanted)
        except DeviceError as error:
            refusal = error
        with self._news:
            if refusal is None:
                period_ns = self._pace.period_ns or 0
                longest_ns = round(1000 * max(wanted, self._exposure_us or 0.0))
                if longest_ns > 0.9 * period_ns:
                    self._pace = Pace()  # the exposure decides the rate
                self._exposure_us, self._asked_us = found, wanted
                self._latched_ns = self._clock.now_ns() + _PERIODS_LATCH * max(period_ns, longest_ns)
            self._refusal = refusal
            self._wanted_us = None
            self._news.notify_all()

    def _fetch_one(self) -> None:
        try:
            fetched = self._capture.fetch()
        except DamagedFrameError as error:
            with self._news:
                self._silence.note_damage(error)
                self._number += 1
            return
        if fetched is None:
            raise DeviceError(
                f"{self._capture.name}: ended: the other side hung up, or the camera was pulled out",
                hint="check its cable or network and its power; record --resume continues the scan",
            )
        check_form(self._capture.name, fetched.image, self._info)
        self._black.note(fetched.image, fetched.arrived_ns)
        with self._news:
            self._silence.note(fetched.arrived_ns)
            self._note(fetched)
            self._news.notify_all()
        check_rate(self._capture.name, self._pace, fetched.arrived_ns, self._fps)

    def _note(self, fetched: Fetched) -> None:
        stamped = fetched.taken_ns is not None
        at_ns = fetched.taken_ns if fetched.taken_ns is not None else fetched.arrived_ns
        in_rhythm, missing = self._pace.note(at_ns)
        number, self._number = self._number, self._number + 1
        self._missing += missing
        period_ns = self._pace.period_ns
        queue = self._queue
        if queue is not None:
            queue.lose(missing)
        # A stamp of the driver's own is right whenever the frame arrives.
        if period_ns is None or not (in_rhythm or stamped):
            if queue is not None:
                queue.lose(1)
            return
        t_ns = self._clock.now_ns() - (time.monotonic_ns() - at_ns)
        slack = _PERIODS_DRIVER if stamped else _PERIODS_ARRIVAL
        exposure_ns = None if self._exposure_us is None else round(1000 * self._exposure_us)
        shot = Shot(t_ns, fetched.image, number, exposure_ns)
        self._newest = Taken(shot, t_ns - slack * period_ns)
        if queue is not None:
            queue.push(shot)
