"""What both ways of scanning share: devices, the recorder, facts for whoever watches, and putting
everything to rest.
"""

from __future__ import annotations

import contextlib
import logging
import time
from typing import Final

from ...schemas.errors import DeviceError, StorageError
from ...schemas.events import Exposure, LaserState, LogLine, TurntableAngle
from ..devices.contracts import Position, Shot
from .interrupts import Interrupts
from .order import Devices, Missed, Order, Progress, Show, Truth
from .recorder import Recorder

LOG = logging.getLogger("turnscan")

_ALIVE_EVERY_S: Final = 0.5
_SHOW_EVERY_S: Final = 0.1
_REST_ATTEMPTS: Final = 3
_LASERS: Final = "the lasers could not be switched off"


class Floor:
    """The running session: every fact goes through here into the log."""

    def __init__(
        self, order: Order, devices: Devices, recorder: Recorder, interrupts: Interrupts, show: Show
    ) -> None:
        self.order = order
        self.devices = devices
        self.recorder = recorder
        self.interrupts = interrupts
        self.missed: list[Missed] = []
        self.retried = 0
        #: Frames that the camera lost, beside those that the recorder dropped.
        self.lost = 0
        self._show = show
        self._lit: set[int] = set()
        self._next_frame = order.earlier.next_frame if order.earlier else 0
        self._began = time.monotonic()
        self._shown = self._alive = 0.0
        self._angle_rad = 0.0

    # -- facts ------------------------------------------------------------------------------------

    def remark(self, level: str, message: str) -> None:
        """A remark in the log, and in the program's own."""
        LOG.log(logging.WARNING if level in ("warning", "error") else logging.INFO, "%s", message)
        event = LogLine.model_validate(
            {"t_ns": self.devices.clock.now_ns(), "level": level, "message": message[:4000]}
        )
        self.recorder.put(event)

    def angle(self, commanded_rad: float, position: Position) -> None:
        """Where the table stands, as commanded and as reported."""
        reported = position.angle_rad if self.devices.turntable.reports_position else None
        self._angle_rad = commanded_rad if reported is None else reported
        self.recorder.put(
            TurntableAngle(
                t_ns=position.t_ns,
                commanded_rad=commanded_rad,
                reported_rad=reported,
                moving=True if position.moving else None,
            )
        )

    def frame(
        self, shot: Shot, lasers: tuple[int, ...], exposure_us: float | None, *, wait: bool
    ) -> None:
        """One frame; frames that were lost before it are counted and said."""
        exposure_ns = shot.exposure_ns
        if exposure_ns is None and exposure_us is not None:
            exposure_ns = round(exposure_us * 1000)
        exposure = Exposure(
            t_ns=shot.t_ns,
            frame=self._next_frame,
            camera=self.order.camera_id,
            lasers_on=lasers,
            exposure_ns=exposure_ns,
        )
        if shot.dropped:
            self.lost += shot.dropped
            self.remark("warning", f"the camera lost {shot.dropped} frames before its {shot.number}.")
        truth: Truth | None = shot.truth
        events = (
            ()
            if truth is None
            else tuple(truth.events(t_ns=shot.t_ns, frame=exposure.frame, camera=exposure.camera))
        )
        if self.recorder.put_frame(exposure, shot.image, events, wait=wait):
            self._next_frame += 1
        else:
            self.remark("warning", f"frame {shot.number} of the camera was dropped: the disk is behind")

    @property
    def dropped(self) -> int:
        """Frames that are not in the log and should be."""
        return self.lost + self.recorder.dropped

    def progress(self, done: float, total: float) -> None:
        """Show how far it is, a few times a second."""
        now = time.monotonic()
        if now - self._shown < _SHOW_EVERY_S and done < total:
            return
        self._shown = now
        took = now - self._began
        self._show(
            Progress(
                angle_rad=self._angle_rad,
                done=done,
                total=total,
                frames=self.recorder.frames,
                frames_per_s=self.recorder.frames / took if took > 0 else 0.0,
                dropped=self.dropped,
                failed_poses=len(self.missed),
                backlog_bytes=self.recorder.backlog_bytes,
                left_s=took / done * (total - done) if done > 0 else None,
            )
        )

    # -- lasers -----------------------------------------------------------------------------------

    def light(self, lasers: tuple[int, ...]) -> None:
        """Have exactly ``lasers`` lit."""
        for laser in sorted(self._lit - set(lasers)):
            self._switch(laser, on=False)
        for laser in lasers:
            if laser not in self._lit:
                self._switch(laser, on=True)

    def _switch(self, laser: int, *, on: bool) -> None:
        if on:
            # Counted as lit from here on: if the command fails, nobody knows.
            self._lit.add(laser)
        with self.interrupts.let_in():
            self.devices.lasers.switch(laser, on=on)
        if not on:
            self._lit.discard(laser)
        self.recorder.put(LaserState(t_ns=self.devices.clock.now_ns(), laser=laser, on=on))
        self._alive = time.monotonic()

    def keep_alive(self) -> None:
        """Hold off the firmware's watchdog while a laser is lit."""
        if self._lit and time.monotonic() - self._alive >= _ALIVE_EVERY_S:
            with self.interrupts.let_in():
                self.devices.lasers.keep_alive()
            self._alive = time.monotonic()

    def dark(self) -> None:
        """All lasers off, whatever is believed of them; DeviceError if a device does not confirm it."""
        last: DeviceError | None = None
        for _ in range(_REST_ATTEMPTS):
            try:
                self.devices.lasers.all_off()
            except DeviceError as error:
                last = error
                continue
            self._say_dark()
            return
        assert last is not None
        raise last

    def _say_dark(self) -> None:
        now = self.devices.clock.now_ns()
        for laser in sorted(self._lit):
            self.recorder.put(LaserState(t_ns=now, laser=laser, on=False))
        self._lit.clear()

    def rest(self) -> list[str]:
        """Put every device to rest (:func:`put_to_rest`); the log says so while it can be written."""
        failed = put_to_rest(self.devices)
        if _LASERS not in " ".join(failed) and self.recorder.failure is None:
            with contextlib.suppress(StorageError):  # The recorder tells it when it is closed.
                self._say_dark()
        return failed


def put_to_rest(devices: Devices) -> list[str]:
    """Lasers off, table stopped, motor released, ports closed: each, whatever became of the others.

    A command cut short by an interrupt may spoil the one after it, so each is tried a few times.
    Returns what failed, in words. May be called again: devices that are closed are left alone.
    """
    failed = []
    table = devices.turntable
    for what, step in (
        (_LASERS, devices.lasers.all_off),
        ("the turntable could not be stopped", table.stop),
        ("the motor could not be released", table.release),
        ("the port could not be closed", table.close),
        ("the camera could not be closed", devices.camera.close),
    ):
        for attempt in range(_REST_ATTEMPTS):
            try:
                step()
            except DeviceError as error:
                if attempt == _REST_ATTEMPTS - 1:
                    failed.append(f"{what}: {error.message}")
            else:
                break
    return failed
