"""What every import has in common: a head, events and frames in time order, a sealed scan."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError, ConflictError, InputError, StorageError
from ..schemas.events import Exposure, LaserState, LogEvent, LogLine, ScanEnd, ScanStart
from ..schemas.manifests import ScanSummary
from ..schemas.software import SOFTWARE
from ..store import Archive
from ..store.log_writer import LogWriter

if TYPE_CHECKING:
    import numpy.typing as npt


@dataclass(frozen=True)
class ImportHead:
    """What a log says before its first frame, and what is known of its end.

    ``notes`` go into ``/log`` beside the time of the import; ``remarks`` are what a person should
    know of it, as warnings. ``note`` stands in the end event.
    """

    t_ns: int
    rig: str
    source: str
    time_source: str
    label: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    lasers: tuple[int, ...] = (0,)
    calibration: Calibration | None = None
    again: bool = False
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    ended: Literal["complete", "interrupted"] = "complete"
    note: str = ""


@dataclass(frozen=True)
class ImportedFrame:
    """One frame: pixels as :meth:`LogWriter.write_image` takes them, or a file's ``data`` and
    ``encoding``. ``where`` names it in errors; ``kind`` is its size, channels and depth in words.
    """

    t_ns: int
    lasers_on: tuple[int, ...]
    where: str
    kind: str
    width_px: int
    height_px: int
    file: str | None = None
    pixels: npt.NDArray[Any] | None = None
    data: bytes | memoryview = b""
    encoding: str = ""


def image_kind(width_px: int, height_px: int, channels: int, bits: int) -> str:
    """Size, channels and depth in words; all images of a scan must have the same."""
    colour = {1: "grey", 3: "colour", 4: "colour with alpha"}[channels]
    return f"{width_px} x {height_px}, {colour}, {bits} bit"


def laser_switches(t_ns: int, before: tuple[int, ...], after: tuple[int, ...]) -> Iterator[LaserState]:
    """The events between two frames with these lasers on."""
    for laser in sorted({*before, *after}):
        if (laser in before) != (laser in after):
            yield LaserState(t_ns=t_ns, laser=laser, on=laser in after)


def seal_import(
    archive: Archive, head: ImportHead, items: Iterable[LogEvent | ImportedFrame]
) -> ScanSummary:
    """Write ``items``, which are in time order, as one scan; nothing is left of it if that fails.

    Raises
    ------
    InputError
        A frame differs from the first one in size, channels or depth; or there is none.
    CalibrationError
        The frames have another size than the calibration.
    ConflictError
        The archive has a scan with the same content already.
    """
    with archive.new_scan() as draft:
        with LogWriter(draft.part) as writer:
            _write_head(writer, head, draft.scan)
            frames, last_ns = _write_items(writer, head, items)
            end = ScanEnd(t_ns=last_ns, ended=head.ended, frames=frames, note=head.note)
            writer.write_event(end)
        facts = draft.examine()
        known = archive.same_content(facts.frames_sha256)
        if known is not None and not head.again:
            raise ConflictError(
                f"these images, with these angles, are scan {known} already",
                hint="nothing was imported; --again imports them once more",
            )
        return archive.seal(draft, facts)


def _write_head(writer: LogWriter, head: ImportHead, scan: str) -> None:
    start = ScanStart(
        t_ns=head.t_ns,
        scan=scan,
        rig=head.rig,
        label=head.label,
        tags=head.tags,
        source=head.source,
        time_source=head.time_source,
        software=SOFTWARE,
        lasers=head.lasers,
    )
    writer.write_event(start)
    if head.calibration is not None:
        writer.write_calibration(head.calibration, head.t_ns)
    for text in (f"imported at t_ns {time.time_ns()}", *head.notes):
        writer.write_event(LogLine(t_ns=head.t_ns, level="info", message=text))
    for text in head.remarks:
        writer.write_event(LogLine(t_ns=head.t_ns, level="warning", message=text))


def _write_items(
    writer: LogWriter, head: ImportHead, items: Iterable[LogEvent | ImportedFrame]
) -> tuple[int, int]:
    """How many frames there were, and the time of the last item."""
    first: ImportedFrame | None = None
    frames, last_ns = 0, head.t_ns
    for item in items:
        last_ns = item.t_ns
        if not isinstance(item, ImportedFrame):
            writer.write_event(item)
            continue
        if first is None:
            first = item
            check_calibration(item.where, item.width_px, item.height_px, head.calibration)
        elif item.kind != first.kind:
            raise InputError(
                f"{item.where} is {item.kind}; {first.where} is {first.kind}",
                hint="all images of a scan come from one camera with one setting",
            )
        exposure = Exposure(t_ns=item.t_ns, frame=frames, lasers_on=item.lasers_on, file=item.file)
        if item.pixels is not None:
            writer.write_image(exposure, item.pixels)
        else:
            writer.write_image(exposure, data=item.data, encoding=item.encoding)
        frames += 1
    return frames, last_ns


def check_calibration(
    where: str, width_px: int, height_px: int, calibration: Calibration | None
) -> None:
    """A CalibrationError if the image ``where`` has another size than the camera it is said to be."""
    if calibration is None or calibration.camera is None:
        return
    camera = calibration.camera
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise CalibrationError(
            f"{where} is {width_px} x {height_px}, calibration "
            f"{calibration.calibration_id()} is for {camera.width_px} x {camera.height_px}",
            hint="use the calibration of this camera at this resolution; orientation tags are ignored",
        )


def origin_note(path: Path) -> str:
    """Name, size and digest of the source, so that it can be found again."""
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror})") from error
    return f"source: {path.name}, {path.stat().st_size} bytes, SHA-256 {digest}"
