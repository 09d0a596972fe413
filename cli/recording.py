"""``turnscan record``: drive a rig, write the log, extract while it turns."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import CalibrationError, TurnscanError, UsageError
from .output import Format, FormatOption, JsonOption, chosen, counted, current_session, emit_object
from .places import (
    chosen_recipe,
    complete_scan,
    open_archive,
    parse_tags,
    read_calibration_file,
)
from .recipes import RecipeOption

if TYPE_CHECKING:
    from ..ingest.session.order import Begun, Order, Recorded
    from ..process.live import LiveExtraction
    from ..schemas.calibration import Calibration
    from ..schemas.events import ScanStart
    from ..schemas.recipe import Recipe
    from ..schemas.rig import Rig, ScanSettings
    from ..store import Archive


def record(
    rig: Annotated[
        Path, typer.Option("--rig", metavar="FILE", help="The rig file (turnscan rig new makes one).")
    ] = Path("rig.toml"),
    from_deg: Annotated[float | None, typer.Option("--from-deg", help="Instead of the file's.")] = None,
    to_deg: Annotated[float | None, typer.Option("--to-deg", help="Instead of the file's.")] = None,
    step_deg: Annotated[float | None, typer.Option("--step-deg", help="Instead of the file's.")] = None,
    resume: Annotated[
        str | None,
        typer.Option(
            "--resume",
            metavar="SCAN",
            help="Go on with a scan at what is missing of it.",
            autocompletion=complete_scan,
        ),
    ] = None,
    at_zero: Annotated[
        bool,
        typer.Option("--at-zero", help="With --resume: the table stands where it did at the start."),
    ] = False,
    label: Annotated[str, typer.Option("--label", help="A name for the scan.")] = "",
    tag: Annotated[list[str] | None, typer.Option("--tag", metavar="K=V", help="May repeat.")] = None,
    recipe: RecipeOption = None,
    extract: Annotated[
        bool, typer.Option("--extract/--no-extract", help="Derive stripes while the table turns.")
    ] = True,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Record a scan. Lasers are off and the motor is released however it ends.

    Ctrl-C ends it well: what was taken is a scan, and --resume goes on with it.
    """
    from ..ingest.devices.building import read_rig
    from ..ingest.session.session import NothingMissingError

    changes = {"from_deg": from_deg, "to_deg": to_deg, "step_deg": step_deg}
    given = {k: v for k, v in changes.items() if v is not None}
    if resume is not None and (given or label or tag):
        raise UsageError(
            "--resume goes on with the plan, label and tags that the scan was begun with",
            hint="leave out --from-deg, --to-deg, --step-deg, --label and --tag",
        )
    archive = open_archive()
    chosen_style = chosen(style, as_json)
    document = _with_changes(read_rig(rig), given, where=str(rig))
    order = order_for(archive, document, resume, label=label, tags=parse_tags(tag), at_zero=at_zero)
    made_with = chosen_recipe(archive, recipe) if extract else None
    try:
        row = run(archive, document, order, made_with, rig)
    except NothingMissingError as error:
        assert order.earlier is not None
        last = archive.scan(order.earlier.scan)
        if last.salvaged_from is None:
            raise
        # It was cut off after its last pose: with the salvage everything is done.
        current_session().say(str(error))
        row = {"scan": last.scan, "label": order.label or None, "ended": last.ended}
        row |= {"continues": last.continues, "frames": last.frames}
    emit_object(row, chosen_style)


def _with_changes(rig: Rig, changes: dict[str, float], *, where: str) -> Rig:
    """The rig document with another range of angles, checked as the file was."""
    from ..schemas.document import validate
    from ..schemas.rig import Rig as Model

    value = rig.model_dump()
    value["scan"] |= changes
    return validate(Model, value, where=f"{where} with {', '.join(changes)}") if changes else rig


def order_for(
    archive: Archive,
    rig: Rig,
    resume: str | None,
    *,
    label: str,
    tags: dict[str, str],
    at_zero: bool = False,
) -> Order:
    """What the session is asked to do: all that the rig file says, or what is missing of a scan."""
    from ..ingest.session.order import Order

    simulated = rig.camera.driver == "simulated"
    order = Order(
        rig=rig.name,
        lasers=tuple(laser.number for laser in rig.lasers),
        scan=rig.scan,
        camera_id=rig.camera.id,
        source="simulated" if simulated else "recorded",
        label=label,
        tags=tags,
        calibration=_calibration(archive, rig),
        stall_s=rig.camera.timeout_s,
        # A simulated table is a new one each time, and stands at its zero.
        at_zero=at_zero or rig.turntable.driver == "simulated",
    )
    return order if resume is None else _resumed(archive, order, resume)


def _resumed(archive: Archive, order: Order, word: str) -> Order:
    """``order`` for what is missing of an earlier scan."""
    from dataclasses import replace

    from ..ingest.session.earlier import read_earlier
    from ..schemas.errors import ConflictError, InputError
    from ..store.resumable import begun, scan_to_resume

    session = current_session()
    start = begun(archive, word)
    try:
        logs = scan_to_resume(archive, word)
    except InputError as error:
        session.say(f"{error}; recording from the beginning")
        return _from_the_beginning(order, start)
    first = logs[0]
    if first.rig != order.rig:
        raise ConflictError(
            f"scan {first.scan} is of rig {first.rig!r}, this rig file is of {order.rig!r}",
            hint="resume with the rig file that it was begun with",
        )
    if logs[-1].salvaged_from is not None:
        session.say(f"scan {logs[-1].salvaged_from} was cut off: salvaged into {logs[-1].scan}")
    earlier, plan = read_earlier(archive, logs)
    _say_other_plan(plan, order.scan)
    row = next(r for r in archive.scan_rows(retired=True) if r["scan"] == first.scan)
    return replace(order, scan=plan, earlier=earlier, label=row["label"], tags=row["tags"])


def _from_the_beginning(order: Order, start: ScanStart | None) -> Order:
    """``order`` with plan, label and tags of a scan that was cut off before its first frame."""
    from dataclasses import replace

    from ..schemas.document import validate
    from ..schemas.rig import ScanSettings

    if start is None or start.plan is None or start.rig != order.rig:
        return order
    plan = validate(ScanSettings, start.plan, where=f"{start.scan}: plan")
    _say_other_plan(plan, order.scan)
    return replace(order, scan=plan, label=start.label, tags=start.tags)


def _say_other_plan(plan: ScanSettings, file: ScanSettings) -> None:
    """The scan goes on as it was begun; what the rig file says now is not silently left out."""
    now, then = file.plain(), plan.plain()
    differ = [f"{k} {then.get(k)} (the file: {now.get(k)})" for k in then if then[k] != now.get(k)]
    if differ:
        current_session().say(f"going on with the scan's own plan: {', '.join(differ)}")


def _calibration(archive: Archive, rig: Rig) -> Calibration | None:
    """The rig file's calibration, else the one that is certified for the rig now."""
    session = current_session()
    if rig.calibration is not None:
        found: Calibration | None = read_calibration_file(Path(rig.calibration))
    elif rig.camera.driver == "simulated":
        from ..ingest.room.opening import true_calibration

        found = true_calibration(rig, folder=Path(), where=f"rig {rig.name}")
    else:
        import time

        now = time.time_ns()
        standing = [c for c in archive.certifications() if c.rig == rig.name and c.covers(now)]
        found = archive.calibration(standing[-1].calibration) if standing else None
    if found is None:
        session.say(
            f"warning: no calibration for rig {rig.name!r}: frames are recorded, but give no points yet"
        )
        return None
    for laser in rig.lasers:
        try:
            found.plane_or_fail(laser.number)
        except CalibrationError as error:
            session.say(f"warning: {error}")
    return found


def run(
    archive: Archive, rig: Rig, order: Order, recipe: Recipe | None, rig_file: Path | None
) -> dict[str, Any]:
    """Record with live progress; what to show of the result. Errors of the session are raised after
    everything that can be kept is kept.
    """
    from ..ingest.devices.building import build_devices
    from ..ingest.session.interrupts import InterruptedSession, Interrupts
    from ..ingest.session.order import Devices
    from ..ingest.session.session import SerialLines
    from ..ingest.session.session import record as record_scan
    from ..process.live import LiveExtraction
    from ..process.pipeline import LiveStart
    from .recording_progress import Shown

    session = current_session()
    live: list[LiveExtraction] = []

    def beside(begun: Begun) -> LiveExtraction | None:
        if recipe is None:
            return None
        try:
            calibration = archive.effective(begun, "current").calibration
        except CalibrationError as error:
            session.say(f"no extraction beside the recording: {error}")
            return None
        camera = begun.camera
        start = LiveStart(
            begun.scan,
            begun.camera_id,
            recipe,
            calibration,
            width_px=camera.width_px,
            height_px=camera.height_px,
            encoding=camera.encoding,
        )
        live.append(LiveExtraction(archive.root, start))
        return live[0]

    lines = SerialLines()
    with Interrupts() as interrupts, Shown(session, live) as shown:
        built = build_devices(rig, heard=lines)
        try:
            devices = Devices(built.clock, built.controller, built.controller, built.camera)
            result = record_scan(
                archive,
                order,
                devices,
                lines,
                interrupts=interrupts,
                show=shown.show,
                make_beside=beside,
            )
        finally:
            built.close()
        outcome = None
        if live and result.scan is not None:
            shown.say_what("publishing")
            try:
                with interrupts.let_in():
                    outcome = live[0].sealed()
            except InterruptedSession:
                live[0].stop()
    _report(result, live[0] if live else None, rig_file)
    row = _row(result, order)
    if outcome is not None:
        row |= {"points": outcome.points, "frames_without_stripe": outcome.frames_without_stripe}
    if result.unsafe:
        raise TurnscanError(
            "; ".join(result.unsafe), hint="switch the lasers off at their supply, and look"
        )
    if result.error is not None:
        raise result.error
    if result.interrupted:
        raise InterruptedSession
    return row


def _report(result: Recorded, live: LiveExtraction | None, rig_file: Path | None) -> None:
    """Everything that went otherwise than planned, in words."""
    session = current_session()
    for missed in result.missed:
        session.say(f"skipped {math.degrees(missed.angle_rad):g} deg: {missed.why}")
    if result.retried:
        session.say(f"{counted(result.retried, 'pose')} needed another try")
    if result.dropped:
        session.say(f"warning: {counted(result.dropped, 'frame')} dropped; the log says where")
    for what in result.unsafe:
        session.say(f"warning: {what}")
    if result.scan is None:
        session.say(f"the log is unsealed: {result.part}; turnscan repair salvages it")
        return
    scan = result.scan.scan
    session.say(f"sealed scan {scan}, {result.scan.ended}, {counted(result.scan.frames, 'frame')}")
    if live is not None and live.failure is not None:
        session.say(f"extraction beside the recording failed: {live.failure}")
        session.say(f"the recording is whole: turnscan process {scan}")
    elif live is None or live.outcome is None:
        session.say(f"no points yet: turnscan process {scan}")
    elif live.outcome.warnings:
        for warning in live.outcome.warnings:
            session.say(f"warning: {warning}")
    if result.interrupted or result.error is not None or result.missed:
        again = f" --rig {rig_file}" if rig_file is not None else ""
        session.say(f"to go on with what is missing: turnscan record{again} --resume {scan}")


def _row(result: Recorded, order: Order) -> dict[str, Any]:
    scan = result.scan
    return {
        "scan": scan.scan if scan else None,
        "label": order.label or None,
        "ended": scan.ended if scan else None,
        "continues": order.earlier.scan if order.earlier else None,
        "frames": scan.frames if scan else result.frames,
        "dropped": result.dropped,
        "retried": result.retried,
        "skipped_deg": [round(math.degrees(m.angle_rad), 6) for m in result.missed],
    }
