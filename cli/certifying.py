"""``calibration certify`` and ``withdraw``: what they would change is said, in scans and mm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import TurnscanError, UsageError
from .output import counted, current_session
from .places import CalibrationArgument, open_archive, parse_time, show_time

if TYPE_CHECKING:
    from ..schemas.archive_events import Certified
    from ..schemas.calibration import Calibration
    from ..store import Archive
    from ..store.certifying import Certifying, Change

RigOption = Annotated[str | None, typer.Option("--rig", help="Rig id; else the calibration's own.")]
FromOption = Annotated[
    str | None,
    typer.Option("--from", metavar="TIME", help="From then on: a date or time, UTC or with offset."),
]
ToOption = Annotated[
    str | None, typer.Option("--to", metavar="TIME", help="Until then, which is no more part of it.")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="In spite of failed limits or an unknown rig; see --reason.")
]
ReasonOption = Annotated[
    str | None, typer.Option("--reason", help="With --force: why. Kept in the event for good.")
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Only say what would change.")]

_NAMED = 4
_RANGES_MM = (100.0, 200.0, 300.0, 500.0, 1000.0, 2000.0, 3000.0, 5000.0, 7000.0)


def certify_calibration(
    calibration: CalibrationArgument,
    rig: RigOption = None,
    from_time: FromOption = None,
    to_time: ToOption = None,
    force: ForceOption = False,
    reason: ReasonOption = None,
    note: Annotated[str, typer.Option("--note", help="A remark.")] = "",
    dry_run: DryRunOption = False,
) -> None:
    """State that a calibration holds for a rig over a half-open time range.

    Where certifications overlap, the newest holds; which scans change is said. A calibration that
    failed an acceptance limit, or a rig that the archive does not know, needs --force --reason.
    """
    archive = open_archive()
    begin, end = parse_time(from_time, "--from"), parse_time(to_time, "--to")
    if begin is not None and end is not None and end <= begin:
        raise UsageError(
            f"--to {to_time} is not after --from {from_time}", hint="give the earlier time to --from"
        )
    why = forced_reason(reason, force=force)
    meant = archive.would_certify(calibration, rig=rig, from_ns=begin, to_ns=end)
    if dry_run:
        _say_meaning(archive, meant)
        for objection in meant.objections:
            current_session().say(f"needs --force --reason: {objection}")
        return
    carry_out(archive, meant, from_ns=begin, to_ns=end, note=note, reason=why)


def forced_reason(reason: str | None, *, force: bool) -> str | None:
    """The reason that goes with --force; each needs the other."""
    if force and not (reason or "").strip():
        raise UsageError("--force needs --reason WHY", hint="it is kept in the event for good")
    if reason is not None and not force:
        raise UsageError("--reason goes with --force", hint="a mere remark is --note")
    return reason.strip() if reason else None


def carry_out(
    archive: Archive,
    meant: Certifying,
    *,
    from_ns: int | None,
    to_ns: int | None,
    note: str = "",
    reason: str | None = None,
) -> Certified:
    """Certify as considered, and say what it changes."""
    event = archive.certify(
        meant.calibration.calibration_id(),
        rig=meant.rig,
        from_ns=from_ns,
        to_ns=to_ns,
        note=note,
        reason=reason,
    )
    session = current_session()
    if meant.standing is not None:
        session.say(f"{event.calibration} is certified so already, by event {event.id}")
        return event
    _say_meaning(archive, meant)
    for objection in meant.objections:
        session.say(f"warning: forced, although {objection}")
    session.say(f"certified {event.calibration} for rig {event.rig} by event {event.id}")
    return event


def _say_meaning(archive: Archive, meant: Certifying) -> None:
    session = current_session()
    for text in (*meant.warnings, *_lacking(meant.calibration)):
        session.say(f"warning: {text}")
    for old in meant.overlaps:
        session.say(
            f"warning: overlaps {old.calibration}, certified for {show_range(old.from_ns, old.to_ns)} "
            f"by {old.id}: where both hold, the new one does"
        )
    _say_changes(archive, meant.changes)


def _lacking(calibration: Calibration) -> list[str]:
    """What scans that it comes to hold for will miss; a calibration may well have some parts only."""
    parts = {
        "camera": calibration.camera is not None,
        "laser's plane": bool(calibration.lasers),
        "turntable axis": calibration.turntable is not None,
    }
    missing = [name for name, there in parts.items() if not there]
    if not missing:
        return []
    return [f"it has no {' and no '.join(missing)}: no points can be made of a scan while it holds"]


def _say_changes(archive: Archive, changes: tuple[Change, ...]) -> None:
    """One line for each pair of calibrations that scans change between."""
    pairs: dict[tuple[str | None, str | None], list[Change]] = {}
    for change in changes:
        pairs.setdefault((change.before, change.after), []).append(change)
    for (before, after), some in pairs.items():
        names = ", ".join(c.label or c.scan for c in some[:_NAMED])
        more = f" and {len(some) - _NAMED} more" if len(some) > _NAMED else ""
        moves = _moves(archive, before, after) if before and after else ""
        current_session().say(
            f"{counted(len(some), 'scan')} from {before or 'no calibration'} to "
            f"{after or 'no calibration'}: {names}{more}{moves}"
        )


def _moves(archive: Archive, before: str, after: str) -> str:
    """How far points go at the nearest and the farthest range that the camera sees, if known."""
    from ..process.calibrate.difference import shifts

    try:
        found = shifts(archive.calibration(before), archive.calibration(after), _RANGES_MM)
    except TurnscanError:
        return ""
    seen = [s for s in found if s.rms_mm is not None]
    ends = dict.fromkeys([seen[0], seen[-1]]) if seen else ()
    told = [f"{s.rms_mm:.3g} mm at {s.at_mm / 1000:g} m" for s in ends]
    return f"; the stripe's points move {', '.join(told)}" if told else ""


def show_range(from_ns: int | None, to_ns: int | None) -> str:
    """A half-open range in words."""
    if from_ns is None and to_ns is None:
        return "all time"
    if from_ns is None:
        return f"all time before {show_time(to_ns)}"
    if to_ns is None:
        return f"all time from {show_time(from_ns)}"
    return f"{show_time(from_ns)} until {show_time(to_ns)}"


def withdraw_calibration(
    calibration: CalibrationArgument,
    rig: Annotated[str | None, typer.Option("--rig", help="Only for this rig.")] = None,
    note: Annotated[str, typer.Option("--note", help="Why.")] = "",
    dry_run: DryRunOption = False,
) -> None:
    """Take back that a calibration holds. Nothing is deleted: an event is recorded."""
    archive = open_archive()
    changes = archive.would_withdraw(calibration, rig=rig)
    _say_changes(archive, changes)
    if dry_run:
        return
    for event in archive.withdraw(calibration, rig=rig, note=note):
        current_session().say(f"withdrew {event.calibration} (certification {event.after})")
