"""Image files become a sealed scan: original bytes, angles, lasers, and where it all came from."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError, ConflictError, InputError
from ..schemas.events import (
    Exposure,
    LaserState,
    LogLine,
    ScanEnd,
    ScanStart,
    TurntableAngle,
)
from ..schemas.manifests import ScanSummary
from ..schemas.software import SOFTWARE
from ..store import Archive
from ..store.log_writer import LogWriter
from .image_reading import ImageFile, read_image
from .poses import Pose, with_times

Advance = Callable[[int, int], None]

# Decoding to check an image takes longer than anything else here, and OpenCV lets other threads run;
# so few are read ahead that memory stays flat.
_THREADS = 2
_AHEAD = 4


@dataclass(frozen=True)
class ImportPlan:
    """What is to be imported, and what is said of it."""

    poses: Sequence[Pose]
    rig: str
    label: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    calibration: Calibration | None = None
    started_ns: int | None = None
    again: bool = False


def import_images(archive: Archive, plan: ImportPlan, advance: Advance | None = None) -> ScanSummary:
    """Make a scan of the images; each is checked by decoding it once, and kept byte for byte.

    Orientation tags are ignored, here and on reading: a calibration is true of pixels as the
    sensor stored them.

    Raises
    ------
    InputError
        An image cannot be read whole, or differs from the first one in size, channels or depth.
    CalibrationError
        The images have another size than the calibration.
    ConflictError
        The archive has a scan with the same content already.
    """
    started_ns, time_source = _start_time(plan)
    timed = with_times(plan.poses, started_ns)
    with archive.new_scan() as draft:
        with LogWriter(draft.part) as writer:
            _write_head(writer, plan, draft.scan, timed[0][0], time_source)
            _write_frames(writer, timed, plan.calibration, advance)
            end = ScanEnd(t_ns=timed[-1][0], ended="complete", frames=len(timed))
            writer.write_event(end)
        facts = draft.examine()
        known = archive.same_content(facts.frames_sha256)
        if known is not None and not plan.again:
            raise ConflictError(
                f"these images, with these angles, are scan {known} already",
                hint="nothing was imported; --again imports them once more",
            )
        return archive.seal(draft, facts)


def _start_time(plan: ImportPlan) -> tuple[int, str]:
    if plan.poses[0].t_ns is not None:
        return plan.poses[0].t_ns, "csv"
    if plan.started_ns is not None:
        return plan.started_ns, "given, frames a nominal second apart"
    try:
        oldest = min(p.path.stat().st_mtime_ns for p in plan.poses)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})") from error
    return max(oldest, 0), "oldest file, frames a nominal second apart"


def _write_head(writer: LogWriter, plan: ImportPlan, scan: str, t_ns: int, time_source: str) -> None:
    lasers = sorted({n for p in plan.poses for n in p.lasers_on})
    start = ScanStart(
        t_ns=t_ns,
        scan=scan,
        rig=plan.rig,
        label=plan.label,
        tags=plan.tags,
        source="imported images",
        time_source=time_source,
        software=SOFTWARE,
        lasers=tuple(lasers),
    )
    writer.write_event(start)
    if plan.calibration is not None:
        writer.write_calibration(plan.calibration, t_ns)
    text = f"imported at t_ns {time.time_ns()}"
    writer.write_event(LogLine(t_ns=t_ns, level="info", message=text))


def _write_frames(
    writer: LogWriter,
    timed: Sequence[tuple[int, Pose]],
    calibration: Calibration | None,
    advance: Advance | None,
) -> None:
    first: ImageFile | None = None
    lit: tuple[int, ...] = ()
    angle: float | None = None
    for frame, ((t_ns, pose), image) in enumerate(
        zip(timed, _read_ahead([p.path for _, p in timed]), strict=True)
    ):
        if first is None:
            first = image
            _check_calibration(image, calibration)
        elif image.kind != first.kind:
            raise InputError(
                f"{image.path} is {image.kind}; {first.path} is {first.kind}",
                hint="all images of a scan come from one camera with one setting",
            )
        for laser in sorted({*lit, *pose.lasers_on}):
            if (laser in lit) != (laser in pose.lasers_on):
                state = LaserState(t_ns=t_ns, laser=laser, on=laser in pose.lasers_on)
                writer.write_event(state)
        lit = pose.lasers_on
        if pose.angle_deg != angle:
            angle = pose.angle_deg
            writer.write_event(TurntableAngle(t_ns=t_ns, commanded_rad=math.radians(angle)))
        exposure = Exposure(t_ns=t_ns, frame=frame, lasers_on=pose.lasers_on, file=_shown(pose.path))
        writer.write_image(exposure, data=image.data, encoding=image.encoding)
        if advance is not None:
            advance(frame + 1, len(timed))


def _shown(path: Path) -> str:
    """The file's name; bytes in it that are no UTF-8, which JSON cannot hold, as escapes."""
    return os.fsencode(path.name).decode("utf-8", "backslashreplace")


def _check_calibration(image: ImageFile, calibration: Calibration | None) -> None:
    if calibration is None or calibration.camera is None:
        return
    camera = calibration.camera
    if (image.width_px, image.height_px) != (camera.width_px, camera.height_px):
        raise CalibrationError(
            f"{image.path} is {image.width_px} x {image.height_px}, calibration "
            f"{calibration.calibration_id()} is for {camera.width_px} x {camera.height_px}",
            hint="use the calibration of this camera at this resolution; orientation tags are ignored",
        )


def _read_ahead(paths: Sequence[Path]) -> Iterator[ImageFile]:
    """Checked images in order, a few of them read ahead."""
    waiting: deque[Future[ImageFile]] = deque()
    with ThreadPoolExecutor(_THREADS) as pool:
        try:
            for path in paths:
                waiting.append(pool.submit(read_image, path))
                if len(waiting) > _AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for task in waiting:
                task.cancel()
