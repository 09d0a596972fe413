"""Image files become a sealed scan: original bytes, angles, lasers, and where it all came from."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from ..schemas.calibration import Calibration
from ..schemas.errors import InputError
from ..schemas.events import LogEvent, TurntableAngle
from ..schemas.manifests import ScanSummary
from ..store import Archive
from .image_reading import ImageFile, read_image
from .poses import Pose, with_times
from .sealing import ImportedFrame, ImportHead, laser_switches, seal_import

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
    head = ImportHead(
        t_ns=timed[0][0],
        rig=plan.rig,
        source="imported images",
        time_source=time_source,
        label=plan.label,
        tags=plan.tags,
        lasers=tuple(sorted({n for p in plan.poses for n in p.lasers_on})),
        calibration=plan.calibration,
        again=plan.again,
    )
    return seal_import(archive, head, _items(timed, advance))


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


def _items(
    timed: Sequence[tuple[int, Pose]], advance: Advance | None
) -> Iterator[LogEvent | ImportedFrame]:
    lit: tuple[int, ...] = ()
    angle: float | None = None
    images = _read_ahead([p.path for _, p in timed])
    for frame, ((t_ns, pose), image) in enumerate(zip(timed, images, strict=True)):
        yield from laser_switches(t_ns, lit, pose.lasers_on)
        lit = pose.lasers_on
        if pose.angle_deg != angle:
            angle = pose.angle_deg
            yield TurntableAngle(t_ns=t_ns, commanded_rad=math.radians(angle))
        yield image.as_frame(t_ns, pose.lasers_on, file=_shown(pose.path))
        if advance is not None:
            advance(frame + 1, len(timed))


def _shown(path: Path) -> str:
    """The file's name; bytes in it that are no UTF-8, which JSON cannot hold, as escapes."""
    return os.fsencode(path.name).decode("utf-8", "backslashreplace")


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
