"""What happens in a session, on its way to the log: put in the order of time, written by a thread.

Compressing and syncing never hold up the camera: they run in the writer's thread, behind a queue of
bounded size. What does not fit there is dropped and counted, or waited for, as the caller wants.
"""

from __future__ import annotations

import heapq
import itertools
import threading
from collections import deque
from typing import TYPE_CHECKING, Final

from ...schemas.calibration import Calibration
from ...schemas.errors import DeviceError, StorageError, TurnscanError
from ...schemas.events import DeviceLine, Ended, Exposure, LogEvent, LogLine, ScanEnd
from ...store.log_writer import LogWriter

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

#: Frames that wait for the disk; at 40 MB/s about six seconds.
QUEUE_BYTES: Final = 256 << 20
#: Remarks may come from other threads, a moment after what they are about.
_REMARKS: Final = (DeviceLine, LogLine)

_Item = tuple[LogEvent, "npt.NDArray[np.generic] | None", tuple[LogEvent, ...]]


class _CalibrationFact(LogEvent):
    """A calibration on its way to the log, where it becomes several messages."""

    calibration: Calibration
    camera: str


class Recorder:
    """Takes events and frames from any thread; :meth:`settle` lets them go to the log in time order."""

    def __init__(self, writer: LogWriter, *, queue_bytes: int = QUEUE_BYTES) -> None:
        self._writer = writer
        self._queue_bytes = queue_bytes
        self._lock = threading.Condition()
        self._early: list[tuple[int, int, _Item]] = []
        self._count = itertools.count()
        self._ready: deque[_Item] = deque()
        self._held_bytes = 0
        self._settled_ns = -1
        self._closing = False
        self._failure: BaseException | None = None
        #: Frames put so far, and those that did not fit the queue or came too late.
        self.frames = 0
        self.dropped = 0
        self._thread = threading.Thread(target=self._write_all, name="log-writer", daemon=True)
        self._thread.start()

    @property
    def backlog_bytes(self) -> int:
        """Frames that wait to be written, in bytes."""
        return self._held_bytes

    @property
    def failure(self) -> BaseException | None:
        """What stopped the writer, if anything did."""
        return self._failure

    def put(self, event: LogEvent) -> None:
        """Take an event; it is written when the time up to it has been settled.

        Raises
        ------
        StorageError
            The log cannot be written any more.
        DeviceError
            A fact is older than what was settled already: clocks that do not agree.
        """
        with self._lock:
            self._check()
            if event.t_ns < self._settled_ns:
                if not isinstance(event, _REMARKS):
                    raise DeviceError(
                        f"a {type(event).__name__} of t_ns {event.t_ns} came after {self._settled_ns}",
                        hint="the device's times must come from the session's clock",
                    )
                event = event.model_copy(update={"t_ns": self._settled_ns})
            heapq.heappush(self._early, (event.t_ns, next(self._count), (event, None, ())))

    def put_frame(
        self,
        exposure: Exposure,
        image: npt.NDArray[np.generic],
        truth: tuple[LogEvent, ...] = (),
        *,
        wait: bool,
    ) -> bool:
        """Take a frame, which then belongs to the recorder; whether it will be written.

        With ``wait`` a full queue is waited for; else the frame is dropped, and so is one that is
        older than what was settled. Errors as :meth:`put`.
        """
        with self._lock:
            self._check()
            while wait and self._held_bytes > self._queue_bytes:
                self._lock.wait(0.1)
                self._check()
            if self._held_bytes > self._queue_bytes or exposure.t_ns < self._settled_ns:
                self.dropped += 1
                return False
            self._held_bytes += image.nbytes
            self.frames += 1
            heapq.heappush(self._early, (exposure.t_ns, next(self._count), (exposure, image, truth)))
            return True

    def put_calibration(self, calibration: Calibration, t_ns: int, camera: str) -> None:
        """Take the calibration that holds; it is written with whatever viewers can show of it."""
        with self._lock:
            self._check()
            item = (_CalibrationFact(t_ns=t_ns, calibration=calibration, camera=camera), None, ())
            heapq.heappush(self._early, (t_ns, next(self._count), item))

    def settle(self, t_ns: int) -> None:
        """Nothing older than ``t_ns`` will come any more: what is not younger may be written."""
        with self._lock:
            self._check()
            moved = False
            while self._early and self._early[0][0] <= t_ns:
                self._ready.append(heapq.heappop(self._early)[2])
                moved = True
            self._settled_ns = max(self._settled_ns, t_ns)
            if moved:
                self._lock.notify_all()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _write_all(self) -> None:
        try:
            while True:
                with self._lock:
                    if not self._ready:
                        if self._closing:
                            return
                        idle = True
                    else:
                        idle = False
                if idle:
                    # Nothing waits: what was written may as well survive a kill from here on.
                    self._writer.flush()
                    with self._lock:
                        while not self._ready and not self._closing:
                            self._lock.wait()
                    continue
                self._write(self._ready.popleft())
        except TurnscanError as error:
            self._fail(error)
        except OSError as error:
            self._fail(StorageError(f"{self._writer.path}: writing failed ({error.strerror})"))
        except BaseException as error:
            self._fail(error)
            raise

    def _fail(self, error: BaseException) -> None:
        with self._lock:
            self._failure = error
            self._lock.notify_all()

    def _write(self, item: _Item) -> None:
        event, image, truth = item
        if isinstance(event, _CalibrationFact):
            self._writer.write_calibration(event.calibration, event.t_ns, camera=event.camera)
            return
        if image is None:
            self._writer.write_event(event)
            return
        assert isinstance(event, Exposure)
        self._writer.write_image(event, image)
        for each in truth:
            self._writer.write_event(each)
        with self._lock:
            self._held_bytes -= image.nbytes
            self._lock.notify_all()

    def close(self, t_ns: int, ended: Ended, note: str) -> None:
        """Write what waits and the end event, and finish the log.

        After a refused write (a full disk) the log ends with the last chunk that got there whole, and
        says so.

        Raises
        ------
        StorageError
            There is not even room for the log's end: the ``.part`` stays, to be salvaged.
        """
        with self._lock:
            while self._early:
                self._ready.append(heapq.heappop(self._early)[2])
            self._closing = True
            self._lock.notify_all()
        self._thread.join()
        writer = self._writer
        if self._failure is not None:
            if not isinstance(self._failure, StorageError):
                writer.abandon()
                raise self._failure
            lost = writer.drop_unwritten() + len(self._ready)
            ended, note = "interrupted", f"{note}; {self._failure.message}; {lost} messages lost"
        end = ScanEnd(
            t_ns=max(t_ns, writer.last_t_ns), ended=ended, frames=writer.images, note=note[:2000]
        )
        writer.write_event(end)
        writer.finish()

    def abandon(self) -> None:
        """Let go of the log without an end. May be called more than once, and after :meth:`close`."""
        with self._lock:
            self._closing = True
            self._ready.clear()
            self._lock.notify_all()
        self._thread.join()
        self._writer.abandon()
