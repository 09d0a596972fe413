"""One recording from the first word to the sealed scan, whatever happens on the way."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from typing import Final

from ...schemas.errors import (
    CalibrationError,
    ConflictError,
    DeviceError,
    StorageError,
    TurnscanError,
)
from ...schemas.events import DeviceLine, Ended, LogLine, ScanStart
from ...schemas.software import SOFTWARE
from ...store import Archive
from ...store.bytes import STAGING
from ...store.drafts import ScanDraft
from ...store.log_digest import LogFacts
from ...store.log_writer import LogWriter
from ..devices.contracts import CameraInfo, DeviceInfo
from .floor import Floor, put_to_rest
from .interrupts import InterruptedSession, Interrupts
from .order import Begun, Beside, Devices, MakeBeside, Order, Recorded, Show
from .plan import PoseWork, Sweep, frames_of, sweeps_of, work_of
from .recorder import QUEUE_BYTES, Recorder
from .room import KeptBack, check_room, needed_bytes, size_text
from .stepping import step_through
from .turning import turn_through

LOG = logging.getLogger("turnscan")

#: Where the camera does not say how fast it is, for the estimate of the room.
_FPS: Final = 30.0

Work = tuple[tuple[PoseWork, ...], tuple[Sweep, ...]]


class NothingMissingError(ConflictError):
    """Every pose of the plan is in the logs already."""


class SerialLines:
    """A :data:`..devices.contracts.LineHeard`: lines go to the log, or wait until there is one."""

    def __init__(self) -> None:
        self._waiting: list[DeviceLine] = []
        self._recorder: Recorder | None = None

    def __call__(self, device: str, direction: str, line: str, t_ns: int) -> None:
        """Take one line; see LineHeard."""
        LOG.debug("%s %s: %s", device, direction, line)
        event = DeviceLine.model_validate(
            {"t_ns": t_ns, "device": device, "direction": direction, "line": line}
        )
        if self._recorder is None:
            self._waiting.append(event)
        elif self._recorder.failure is None:
            self._recorder.put(event)

    def go_to(self, recorder: Recorder | None) -> None:
        """From now on to ``recorder`` (None: nowhere any more)."""
        self._recorder = recorder
        if recorder is not None:
            for event in self._waiting:
                recorder.put(event)
            self._waiting.clear()


def record(
    archive: Archive,
    order: Order,
    devices: Devices,
    lines: SerialLines,
    *,
    interrupts: Interrupts,
    show: Show = lambda _: None,
    make_beside: MakeBeside = lambda *_: None,
    queue_bytes: int = QUEUE_BYTES,
) -> Recorded:
    """Carry out ``order``: connect, check the room, scan, put everything to rest, seal the log.

    However it ends, lasers are off and the motor is released, and what was taken is a scan (its log
    says ``interrupted``). An error that ended it early stands in the result beside the scan.

    Raises
    ------
    TurnscanError
        Nothing was recorded: a device does not answer, there is no room, the calibration is for
        another frame size, nothing is missing.
    InterruptedSession
        The user ended it before the first frame.
    """
    started_ns = devices.clock.now_ns()
    work = _missing(order)
    check_room(archive.root, needed_bytes(0, 0, 0, "mono8"))
    try:
        with interrupts.let_in():
            camera = devices.camera.open()
        _check_size(order, camera)
        frames = frames_of(order.scan, *work, _fps(camera))
        needed = needed_bytes(frames, camera.width_px, camera.height_px, camera.encoding)
        free = check_room(archive.root, needed)
        LOG.info("about %d frames: %s of %s", frames, size_text(needed), size_text(free))
        with interrupts.let_in():
            controller = devices.turntable.connect()
        _check_zero(order, controller)
        with archive.new_scan() as draft:
            return _Run(archive, order, devices, draft, interrupts, queue_bytes).run(
                started_ns, work, (controller, camera), lines, show, make_beside
            )
    finally:
        # After a run everything is at rest by now; this is for what failed before it.
        put_to_rest(devices)


class _Run:
    """The part of a recording that has a log."""

    def __init__(
        self,
        archive: Archive,
        order: Order,
        devices: Devices,
        draft: ScanDraft,
        interrupts: Interrupts,
        queue_bytes: int,
    ) -> None:
        self._archive = archive
        self._order = order
        self._devices = devices
        self._draft = draft
        self._interrupts = interrupts
        self._result = Recorded()
        self._kept_back = KeptBack(archive.store.local(f"{STAGING}/{os.getpid()}-{draft.scan}.room"))
        self._recorder = Recorder(LogWriter(draft.part), queue_bytes=queue_bytes)

    def run(
        self,
        started_ns: int,
        work: Work,
        said: tuple[DeviceInfo, CameraInfo],
        lines: SerialLines,
        show: Show,
        make_beside: MakeBeside,
    ) -> Recorded:
        """Scan, put everything to rest, end the log, seal it."""
        result, recorder = self._result, self._recorder
        floor = Floor(self._order, self._devices, recorder, self._interrupts, show)
        beside: Beside | None = None
        try:
            self._head(started_ns, said)
            lines.go_to(recorder)
            # At once on the disk: what this is and what it plans is known even if it is killed now.
            recorder.settle(started_ns)
            beside = self._begin_beside(started_ns, said[1], make_beside)
            try:
                self._scan(floor, work, beside)
            finally:
                result.unsafe = floor.rest()
                lines.go_to(None)
            result.frames, result.dropped = recorder.frames, floor.dropped
            result.missed, result.retried = floor.missed, floor.retried
            _some_frame(result)
            self._draft.keep_part = True
            self._seal(beside)
        except BaseException:
            self._draft.keep_part = recorder.frames > 0
            recorder.abandon()
            if beside is not None:
                beside.stop()
            raise
        finally:
            self._kept_back.give_back()
        return result

    def _head(self, started_ns: int, said: tuple[DeviceInfo, CameraInfo]) -> None:
        """What every log begins with."""
        order, (controller, camera) = self._order, said
        start = ScanStart(
            t_ns=started_ns,
            scan=self._draft.scan,
            rig=order.rig,
            label=order.label,
            tags=order.tags,
            source=order.source,
            time_source="clock",
            software=SOFTWARE,
            cameras=(order.camera_id,),
            lasers=order.lasers,
            continues=order.earlier.scan if order.earlier else None,
            plan=order.scan.plain(),
        )
        self._recorder.put(start)
        if order.calibration is not None:
            self._archive.add_calibration(order.calibration)
            self._recorder.put_calibration(order.calibration, started_ns, order.camera_id)
        facts: list[tuple[str, Mapping[str, object]]] = [
            (controller.name, controller.facts),
            (camera.name, camera.settings),
        ]
        for name, values in facts:
            text = ", ".join(f"{k} {v}" for k, v in values.items())
            message = f"{name}: {text}" if text else name
            line = LogLine(t_ns=started_ns, level="info", message=message)
            self._recorder.put(line)

    def _begin_beside(
        self, started_ns: int, camera: CameraInfo, make_beside: MakeBeside
    ) -> Beside | None:
        order = self._order
        name = None if order.calibration is None else order.calibration.calibration_id()
        beside = make_beside(
            Begun(self._draft.scan, order.rig, started_ns, name, order.camera_id, camera)
        )
        if beside is not None:
            beside.begin(self._draft.part)
        return beside

    def _scan(self, floor: Floor, work: Work, beside: Beside | None) -> None:
        """Scan until it is done, or until something ends it: then the result says what."""
        poses, sweeps = work
        try:
            if beside is not None:
                with self._interrupts.let_in():
                    beside.ready()
            if self._order.scan.mode == "step":
                step_through(floor, poses)
            else:
                turn_through(floor, sweeps)
        except InterruptedSession:
            self._result.interrupted = True
        except TurnscanError as error:
            self._result.error = error

    def _seal(self, beside: Beside | None) -> None:
        result = self._result
        ended: Ended = "interrupted" if result.interrupted or result.error else "complete"
        self._kept_back.give_back()
        try:
            self._recorder.close(self._devices.clock.now_ns(), ended, _note(result))
            facts, log_sha256 = self._facts(beside)
            result.scan = self._archive.seal(self._draft, facts, log_sha256)
        except StorageError as error:
            result.error = result.error or error
            result.part = self._draft.part
            if beside is not None:
                beside.stop()

    def _facts(self, beside: Beside | None) -> tuple[LogFacts, str | None]:
        """From whoever read the log while it grew, else by reading it now."""
        if beside is not None:
            try:
                with self._interrupts.let_in():
                    found = beside.finish()
            except InterruptedSession:
                beside.stop()
                found = None
            if found is not None:
                return found
        return self._draft.examine(), None


def _some_frame(result: Recorded) -> None:
    """A session without a frame left nothing to keep: what ended it is all that there is to say."""
    if result.frames:
        return
    if result.interrupted:
        raise InterruptedSession
    if result.missed and result.error is None:
        raise DeviceError(
            f"no pose could be taken: {result.missed[0].why}",
            hint="turnscan rig check says what is wrong",
        )
    assert result.error is not None
    raise result.error


def _note(result: Recorded) -> str:
    parts = []
    if result.interrupted:
        parts.append("interrupted by the user or the system")
    if result.error is not None:
        parts.append(result.error.message)
    if result.missed:
        angles = ", ".join(f"{math.degrees(m.angle_rad):g}" for m in result.missed[:20])
        parts.append(f"{len(result.missed)} poses skipped (deg): {angles}")
    if result.dropped:
        parts.append(f"{result.dropped} frames dropped")
    parts += result.unsafe
    return "; ".join(parts)


def _missing(order: Order) -> Work:
    """What is still to be taken; a ConflictError if that is nothing."""
    earlier = order.earlier
    if order.scan.mode == "step":
        work = work_of(order.scan, order.lasers, earlier.taken if earlier else ())
        out: Work = (work, ())
    else:
        out = ((), sweeps_of(order.scan, order.lasers, earlier.reached if earlier else None))
    if not any(out):
        where = f" of scan {earlier.scan}" if earlier else ""
        raise NothingMissingError(
            f"no pose{where} is missing: there is nothing to record",
            hint="turnscan scan show says what there is",
        )
    return out


def _fps(camera: CameraInfo) -> float:
    """Frames a second, for the estimate alone."""
    value = camera.settings.get("fps", _FPS)
    return float(value) if isinstance(value, (int, float)) and value > 0 else _FPS


def _check_zero(order: Order, controller: DeviceInfo) -> None:
    """A scan may go on only in the angles that it was begun in."""
    kept = controller.facts.get("position_kept", "yes")
    if order.earlier is None or order.at_zero or kept == "yes":
        return
    raise ConflictError(
        f"scan {order.earlier.scan} cannot simply go on: the controller's position was not kept since "
        f"({controller.name} says: {kept}), so the same angles may be other ones now",
        hint="turn the table to where it stood when the scan was begun, then add --at-zero",
    )


def _check_size(order: Order, camera: CameraInfo) -> None:
    """Frames of another size than the calibration's, or than earlier ones, would be worth nothing."""
    earlier, size = order.earlier, (camera.width_px, camera.height_px)
    if earlier is not None and (earlier.width_px, earlier.height_px) != size:
        raise ConflictError(
            f"scan {earlier.scan} has frames of {earlier.width_px} x {earlier.height_px}, the camera "
            f"gives {size[0]} x {size[1]}",
            hint="set camera.width_px and height_px as they were, or record a new scan",
        )
    known = order.calibration.camera if order.calibration is not None else None
    if known is None or (known.width_px, known.height_px) == size:
        return
    assert order.calibration is not None
    raise CalibrationError(
        f"the camera gives {camera.width_px} x {camera.height_px}, calibration "
        f"{order.calibration.calibration_id()} is for {known.width_px} x {known.height_px}",
        hint="set camera.width_px and height_px, or calibrate at this resolution",
    )
