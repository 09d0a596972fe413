"""``turnscan calibration``: add, list, show; the group's other commands stand in files of their own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ..schemas.errors import UsageError
from .calibration_difference import diff_calibrations
from .certifying import (
    ForceOption,
    ReasonOption,
    RigOption,
    carry_out,
    certify_calibration,
    forced_reason,
    withdraw_calibration,
)
from .checking import check_calibration
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit
from .places import CalibrationArgument, open_archive, read_calibration_file, show_time

calibration_app = typer.Typer(
    no_args_is_help=True,
    help="The archive's calibrations.",
    epilog="Examples: turnscan calibration add cal.json --certify; turnscan calibration list",
)


@calibration_app.command("add", epilog="Example: turnscan calibration add cal.json --certify")
def add_calibration(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="JSON; docs/format.md shows it.")],
    certify: Annotated[
        bool, typer.Option("--certify", help="Also state that it holds for its rig, always.")
    ] = False,
    rig: RigOption = None,
    force: ForceOption = False,
    reason: ReasonOption = None,
) -> None:
    """Add a calibration document (also the paper's f, L, D, theta, c) and print its id.

    One that failed an acceptance limit is kept as failed, and is not certified without --force.
    """
    archive = open_archive()
    for option, given in (("--rig", rig is not None), ("--force", force)):
        if given and not certify:
            raise UsageError(f"{option} goes with --certify", hint="the document names its own rig")
    why = forced_reason(reason, force=force)
    document = read_calibration_file(file)
    meant = archive.would_certify(document, rig=rig) if certify else None
    # What failed its limits is worth keeping; what was meant for a rig that does not exist is a slip.
    if meant is not None and not document.failed_gates():
        meant.check(why)
    sys.stdout.write(archive.add_calibration(document) + "\n")
    for part, gate in document.failed_gates():
        current_session().say(f"warning: failed: {part}: {gate.sentence()}")
    if meant is not None:
        carry_out(archive, meant, from_ns=None, to_ns=None, reason=why)


@calibration_app.command("list", epilog="Example: turnscan calibration list --picture timeline.png")
def list_calibrations(
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="PNG", help="Also draw the timelines.")
    ] = None,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """List calibrations, and for each rig which of them holds when.

    In the timelines = is where a certification holds, - where a newer one has replaced it, x one that
    was withdrawn; < and > are open ends, ^ are scans.
    """
    from .calibration_timeline import draw_timelines, entry_row, text_timeline

    archive = open_archive()
    rigs = archive.timeline()
    entries = [e for of_rig in rigs.values() for e in of_rig]
    rows: list[dict[str, Any]] = []
    for row in archive.calibration_rows():
        name = row["calibration"]
        mine = [e for e in entries if e.certified.calibration == name]
        standing = [e.certified for e in mine if e.state != "withdrawn"]
        rows.append(
            {
                "calibration": name,
                "rig": row["rig"],
                "parts": list(archive.calibration(name).parts()),
                "verdict": row["verdict"],
                "certified": "; ".join(
                    f"{e.rig} {show_time(e.from_ns)}..{show_time(e.to_ns)}" for e in standing
                )
                or None,
                "note": row["note"],
                "certifications": [entry_row(e) for e in mine],
            }
        )
    chosen_style = chosen(style, as_json)
    emit(rows, ["calibration", "rig", "parts", "verdict", "certified", "note"], chosen_style)
    scans: dict[str, list[int]] = {}
    for scan in archive.scan_rows():
        scans.setdefault(scan["rig"], []).append(scan["started_ns"])
    if chosen_style is Format.table:
        for rig, of_rig in rigs.items():
            sys.stdout.write("\n" + text_timeline(rig, of_rig, scans.get(rig, [])))
    if picture is not None:
        draw_timelines({rig: (e, scans.get(rig, [])) for rig, e in rigs.items()}, picture)
        current_session().say(f"wrote {picture}")


@calibration_app.command("show", epilog="Example: turnscan calibration show c-162 > cal.json")
def show_calibration(calibration: CalibrationArgument) -> None:
    """Write a calibration document as JSON."""
    from ..schemas.document import dump_json

    sys.stdout.write(dump_json(open_archive().calibration(calibration).plain()).decode())


calibration_app.command(
    "certify",
    epilog="Example: turnscan calibration certify c-162 --from 2026-05-01 --to 2026-09-01",
)(certify_calibration)
calibration_app.command("withdraw", epilog="Example: turnscan calibration withdraw c-162")(
    withdraw_calibration
)
calibration_app.command("diff", epilog="Example: turnscan calibration diff c-162 c-81")(
    diff_calibrations
)
calibration_app.command("check", epilog="Example: turnscan calibration check latest --target 0,500,80")(
    check_calibration
)
