"""Another program's MCAP recording becomes a scan: its images, angles and laser states as they are.

The file is read twice: once to know what it holds (mcap_survey.py), once to write it. Nothing is
interpolated: pairing a frame with its angle is done when processing, as for every scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..schemas.calibration import Calibration
from ..schemas.errors import InputError
from ..schemas.events import LaserState, LogEvent
from ..schemas.manifests import ScanSummary
from ..store import Archive
from .mcap_choice import Choice, choose, choose_camera
from .mcap_items import (
    Mode,
    angle_events,
    frames,
    frames_between_angles,
    frames_with_state,
    items,
    laser_events,
    lit_at,
)
from .mcap_survey import Asked, Survey, Track, survey_file
from .mcap_times import Clock, Times, choose_clock, most_waiting
from .sealing import ImportedFrame, ImportHead, check_calibration, origin_note, seal_import

Advance = Callable[[int, int], None]

#: Frames out of order that may be held back at once; memory stays below this many frames.
_MOST_WAITING = 64


@dataclass(frozen=True)
class McapPlan:
    """What is to be imported, and what is said of it.

    ``mode`` "continuous" marks the table as turning between two different angles, "step" as never
    turning; None believes the messages (a joint's velocity). ``laser`` is the number of the laser
    that is lit, or that ``laser_topic`` switches.
    """

    path: Path
    asked: Asked = field(default_factory=Asked)
    times: Times = "auto"
    mode: Mode | None = None
    laser: int = 0
    rig: str | None = None
    label: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    calibration: Calibration | None = None
    again: bool = False


@dataclass(frozen=True)
class McapContent:
    """What a first reading found of the plan in its file, ready to be written."""

    plan: McapPlan
    survey: Survey
    choice: Choice
    clock: Clock
    order: Sequence[int]
    size_px: tuple[int, int]
    calibration: Calibration | None
    notes: tuple[str, ...]
    remarks: tuple[str, ...]

    def angle_range_deg(self) -> tuple[float, float]:
        """Least and greatest angle."""
        both = zip(self.choice.angles.commanded, self.choice.angles.reported, strict=True)
        values = [commanded if math.isnan(reported) else reported for commanded, reported in both]
        return math.degrees(min(values)), math.degrees(max(values))

    def images(self) -> Iterator[ImportedFrame]:
        """The frames, in time order; each call reads the file anew."""
        lit = lit_at(self.lasers()) if self.choice.laser else lambda _: (self.plan.laser,)
        cut = bool(self.survey.lost)
        return frames(self.plan.path, self.choice, self.clock, self.order, lit, cut=cut)

    def lasers(self) -> list[LaserState]:
        """What the laser's topic says, in time order."""
        if self.choice.laser is None:
            return []
        return laser_events(self.clock, self.choice.laser, self.plan.laser)


def read_content(plan: McapPlan) -> McapContent:
    """Look through the file: topics, times, angles, the first image. Writes nothing.

    Raises
    ------
    DamageError
        The file is damaged. (One that is merely cut off gives what is whole, and a remark.)
    InputError
        The topics cannot be chosen, a message on them cannot be used, images and angles have no
        moment in common, or the images are too far out of order.
    CalibrationError
        The images have another size than the calibration.
    """
    survey = survey_file(plan.path, plan.asked)
    choice = choose(survey, plan.asked)
    clock = choose_clock(plan.times, _tracks(choice))
    order, early = frames_with_state(clock, choice)
    _check_order(plan, choice, clock, order)
    found = McapContent(plan, survey, choice, clock, order, (0, 0), plan.calibration, (), ())
    first = next(found.images())
    size = (first.width_px, first.height_px)
    check_calibration(first.where, *size, plan.calibration)
    calibration, said = _calibration(plan, survey, size)
    remarks = [f"the recording is cut off: {survey.lost}"] * bool(survey.lost)
    if early:
        what = "angle or laser state" if choice.laser else "angle"
        remarks.append(f"frames left out, because they come before the first {what}: {early}")
    between = frames_between_angles(clock, choice, order) if plan.mode is None else 0
    if between:
        remarks.append(
            f"frames between two different angles: {between}; each gets the earlier one. If the "
            "table was turning, import with --mode continuous, else with --mode step"
        )
    if choice.images.image_encoding in ("bgra8", "rgba8"):
        remarks.append("the alpha channel of the images is constant and is left out")
    notes = [
        f"times are {clock.source} ({clock.why})",
        *(f"read from {track.described()}" for track in _tracks(choice)),
    ]
    for text in said:
        (remarks if "ignored" in text else notes).append(text)
    return replace(
        found, size_px=size, calibration=calibration, notes=tuple(notes), remarks=tuple(remarks)
    )


def _tracks(choice: Choice) -> list[Track]:
    return [t for t in (choice.images, choice.angles, choice.laser) if t is not None]


def _check_order(plan: McapPlan, choice: Choice, clock: Clock, order: Sequence[int]) -> None:
    waiting = most_waiting(order)
    if waiting > _MOST_WAITING:
        raise InputError(
            f"{plan.path}: images on {choice.images.topic} are up to {waiting} places out of order "
            f"by their {clock.source}",
            hint="sort the file first (mcap sort), or use --times log",
        )


def _calibration(
    plan: McapPlan, survey: Survey, size: tuple[int, int]
) -> tuple[Calibration | None, list[str]]:
    """The calibration to keep, and in words what became of those in the file."""
    if plan.calibration is not None:
        given = "is ignored: --calibration is given"
        return plan.calibration, [f"camera calibration on {t} {given}" for t in survey.cameras]
    camera, said = choose_camera(survey, *size)
    if camera is None:
        return None, said
    note = f"camera from {plan.path.name}"
    return Calibration(rig=plan.rig or "unknown", note=note, camera=camera), said


def import_mcap(archive: Archive, content: McapContent, advance: Advance | None = None) -> ScanSummary:
    """Make a scan of a recording that was looked through.

    Raises
    ------
    InputError
        An image cannot be kept as it is, images differ in size, channels or depth, or the file has
        changed.
    ConflictError
        The archive has a scan with the same content already.
    """
    plan, choice, clock = content.plan, content.choice, content.clock
    lasers = content.lasers()
    starts = [min(clock.times(t)) for t in (choice.angles, choice.laser) if t is not None]
    head = ImportHead(
        t_ns=min(clock.times(choice.images)[content.order[0]], *starts),
        rig=plan.rig or (plan.calibration.rig if plan.calibration else "unknown"),
        source="imported mcap",
        time_source=clock.source,
        label=plan.label,
        tags=plan.tags,
        lasers=tuple(sorted({e.laser for e in lasers})) or (plan.laser,),
        calibration=content.calibration,
        again=plan.again,
        notes=(origin_note(plan.path), *content.notes),
        remarks=content.remarks,
        ended="interrupted" if content.survey.lost else "complete",
        note=content.survey.lost,
    )
    events: list[Iterator[LogEvent]] = [
        iter(lasers),
        angle_events(clock, choice.angles, plan.mode),
    ]
    images = content.images() if advance is None else _counted(content, advance)
    switched_on = None if choice.laser else plan.laser
    return seal_import(archive, head, items(events, images, switched_on))


def _counted(content: McapContent, advance: Advance) -> Iterator[ImportedFrame]:
    for done, frame in enumerate(content.images(), 1):
        yield frame
        advance(done, len(content.order))
