"""A video file becomes a scan: frames as the decoder gives them, kept without further loss.

A video with one image file a packet (Motion JPEG) keeps those bytes; every other is decoded once and
kept as raw pixels, grey where the video is grey.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from ..schemas.calibration import Calibration
from ..schemas.errors import InputError
from ..schemas.events import LogEvent, TurntableAngle
from ..schemas.manifests import ScanSummary
from ..store import Archive
from .image_reading import check_image
from .poses import Pose, poses_by_step, poses_of_frames
from .sealing import (
    ImportedFrame,
    ImportHead,
    check_calibration,
    image_kind,
    laser_switches,
    origin_note,
    seal_import,
)
from .video_file import VideoFacts, decoded, video_facts

Advance = Callable[[int, int], None]

_MS_NS = 1_000_000
_NOMINAL_FPS = 1.0


@dataclass(frozen=True)
class VideoPlan:
    """What is to be imported, and what is said of it: angles from a step, or from a CSV."""

    path: Path
    step_deg: float | None = None
    start_deg: float = 0.0
    angles: Path | None = None
    laser: int = 0
    rig: str = "unknown"
    label: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    calibration: Calibration | None = None
    started_ns: int | None = None
    again: bool = False


@dataclass(frozen=True)
class VideoContent:
    """What a first decoding found, with the pose of every frame."""

    plan: VideoPlan
    facts: VideoFacts
    poses: Sequence[tuple[int, Pose]]
    time_source: str
    remarks: tuple[str, ...]


def read_content(plan: VideoPlan) -> VideoContent:
    """Decode the video once, and give every frame its angle and time. Writes nothing.

    Raises
    ------
    InputError
        It is no video, the CSV does not fit its frames, or images differ in size.
    CalibrationError
        The frames have another size than the calibration.
    StorageError
        The file cannot be read.
    """
    facts = video_facts(plan.path)
    count = _whole_frames(plan.path, facts)
    remarks = []
    if facts.missing_bytes:
        remarks.append(
            f"the video is cut off: {facts.missing_bytes} bytes are missing; {count} whole frames"
            + (f" of about {facts.promised}" if facts.promised > count else "")
        )
    elif facts.promised > count + 1:  # An estimate from length and rate may be off by one.
        remarks.append(f"the video speaks of {facts.promised} frames, it holds {count}")
    if plan.angles is not None:
        poses = poses_of_frames(plan.path, count, plan.angles, remark="; ".join(remarks))
    else:
        step = plan.step_deg if plan.step_deg is not None else math.nan
        poses = poses_by_step(
            [plan.path] * count, step_deg=step, start_deg=plan.start_deg, laser=plan.laser
        )
    times, source = _times(plan, facts, poses)
    content = VideoContent(plan, facts, list(zip(times, poses, strict=True)), source, tuple(remarks))
    first = next(_frames(content))
    check_calibration(first.where, first.width_px, first.height_px, plan.calibration)
    return content


def _whole_frames(path: Path, facts: VideoFacts) -> int:
    """How many frames are what was written. A decoder makes up what is missing of the last one of a
    cut file, and steps over a frame that it cannot decode: all angles behind it would be wrong.
    """
    lost = facts.stored - facts.frames
    cut = bool(facts.missing_bytes)
    within = [i for i in facts.damaged if not cut or i < facts.stored - 1]
    if within or lost > cut:
        what = f"frame {within[0]} is damaged" if within else f"{lost} of {facts.stored} are damaged"
        raise InputError(
            f"{path}: {what}", hint="copy it again from its source; frames are never left out silently"
        )
    count = facts.frames
    if cut and not lost and (facts.damaged or not _last_is_whole(path, facts)):
        count -= 1
    if count < 1:
        raise InputError(f"{path}: cut off within its first frame", hint="copy it again")
    return count


def _last_is_whole(path: Path, facts: VideoFacts) -> bool:
    """Whether the last frame of a cut video can be proven whole: only image files can be."""
    if not facts.files:
        return False
    (last,) = deque(decoded(path, facts), maxlen=1)
    try:
        check_image(last.tobytes(), where=str(path), claimed=facts.files)
    except InputError:
        return False
    return True


def _times(plan: VideoPlan, facts: VideoFacts, poses: Sequence[Pose]) -> tuple[list[int], str]:
    """t_ns of every frame, and where it is from."""
    if poses[0].t_ns is not None:
        times = [p.t_ns or 0 for p in poses]
        if any(b < a for a, b in pairwise(times)):
            raise InputError(f"{plan.angles}: t_ns steps back; frames of a video are in order")
        return times, "csv"
    if plan.started_ns is not None:
        begin, source = plan.started_ns, "given start"
    else:
        begin, source = max(plan.path.stat().st_mtime_ns, 0), "file's time"
    ms = facts.times_ms[: len(poses)]
    steady = all(b > a for a, b in pairwise(ms))
    if steady and ms[0] >= 0 and all(math.isfinite(t) for t in ms):
        return [begin + round((t - ms[0]) * _MS_NS) for t in ms], f"{source}, times of the video"
    fps = facts.fps if math.isfinite(facts.fps) and 0 < facts.fps <= 1e5 else _NOMINAL_FPS
    nominal = [begin + round(i / fps * 1e9) for i in range(len(poses))]
    return nominal, f"{source}, frames a nominal 1/{fps:g} s apart"


def import_video(
    archive: Archive, content: VideoContent, advance: Advance | None = None
) -> ScanSummary:
    """Make a scan of a video that was looked through.

    Raises
    ------
    InputError
        A frame cannot be kept, frames differ in size, or the file has changed.
    ConflictError
        The archive has a scan with the same content already.
    """
    plan, facts = content.plan, content.facts
    kept = f"{facts.files} files as they are" if facts.files else "decoded, without further loss"
    cut = bool(facts.missing_bytes)
    head = ImportHead(
        t_ns=content.poses[0][0],
        rig=plan.rig,
        source="imported video",
        time_source=content.time_source,
        label=plan.label,
        tags=plan.tags,
        lasers=tuple(sorted({n for _, p in content.poses for n in p.lasers_on})),
        calibration=plan.calibration,
        again=plan.again,
        notes=(origin_note(plan.path), f"codec {facts.codec}, {facts.fps:g} frames/s; kept: {kept}"),
        remarks=content.remarks,
        ended="interrupted" if cut else "complete",
        note=content.remarks[0] if cut else "",
    )
    return seal_import(archive, head, _items(content, advance))


def _items(content: VideoContent, advance: Advance | None) -> Iterator[LogEvent | ImportedFrame]:
    lit: tuple[int, ...] = ()
    angle: float | None = None
    for number, frame in enumerate(_frames(content)):
        pose = content.poses[number][1]
        yield from laser_switches(frame.t_ns, lit, pose.lasers_on)
        lit = pose.lasers_on
        if pose.angle_deg != angle:
            angle = pose.angle_deg
            yield TurntableAngle(t_ns=frame.t_ns, commanded_rad=math.radians(angle))
        yield frame
        if advance is not None:
            advance(number + 1, len(content.poses))


def _frames(content: VideoContent) -> Iterator[ImportedFrame]:
    path, facts = content.plan.path, content.facts
    pixels = decoded(path, facts)
    number = 0
    for number, ((t_ns, pose), image) in enumerate(zip(content.poses, pixels, strict=False), 1):
        where = f"{path}, frame {number - 1}"
        if facts.files:
            file = check_image(image.tobytes(), where=where, claimed=facts.files)
            yield file.as_frame(t_ns, pose.lasers_on)
            continue
        height, width = image.shape[:2]
        channels = 1 if image.ndim == 2 else image.shape[2]
        if channels not in (1, 3) or image.dtype not in ("uint8", "uint16"):
            raise InputError(f"{where}: decodes to {image.shape} of {image.dtype}")
        yield ImportedFrame(
            t_ns=t_ns,
            lasers_on=pose.lasers_on,
            where=where,
            kind=image_kind(width, height, channels, 8 * image.dtype.itemsize),
            width_px=width,
            height_px=height,
            pixels=image,
        )
    if number != len(content.poses):
        raise InputError(f"{path}: gave {len(content.poses)} frames before, now {number}")
