"""``turnscan calibration``: add, list, show, certify, withdraw, diff."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ..schemas.errors import UsageError
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit
from .places import (
    complete_calibration,
    open_archive,
    parse_time,
    read_calibration_file,
    show_time,
)

calibration_app = typer.Typer(
    no_args_is_help=True,
    help="The archive's calibrations.",
    epilog="Examples: turnscan calibration add cal.json --certify; turnscan calibration list",
)

IdArgument = Annotated[
    str,
    typer.Argument(metavar="ID", help="Id or unique prefix.", autocompletion=complete_calibration),
]
RigOption = Annotated[str | None, typer.Option("--rig", help="Rig id; else the calibration's own.")]
FromOption = Annotated[str | None, typer.Option("--from", metavar="TIME", help="From then on.")]
ToOption = Annotated[str | None, typer.Option("--to", metavar="TIME", help="Until then, exclusive.")]


@calibration_app.command("add", epilog="Example: turnscan calibration add cal.json --certify")
def add_calibration(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="JSON; docs/format.md shows it.")],
    certify: Annotated[
        bool, typer.Option("--certify", help="Also state that it holds for its rig, always.")
    ] = False,
    rig: RigOption = None,
) -> None:
    """Add a calibration document (also the paper's f, L, D, theta, c) and print its id."""
    archive = open_archive()
    if rig is not None and not certify:
        raise UsageError("--rig goes with --certify", hint="the document names its own rig")
    name = archive.add_calibration(read_calibration_file(file))
    if certify:
        event = archive.certify(name, rig=rig)
        current_session().say(f"certified for rig {event.rig} by event {event.id}")
    sys.stdout.write(name + "\n")


@calibration_app.command("list", epilog="Example: turnscan calibration list --json")
def list_calibrations(style: FormatOption = Format.table, as_json: JsonOption = False) -> None:
    """List calibrations and what they are certified for."""
    archive = open_archive()
    rows = []
    for row in archive.calibration_rows():
        name = row["calibration"]
        document = archive.calibration(name)
        standing = [
            f"{e.rig} {show_time(e.from_ns)}..{show_time(e.to_ns)}"
            for e in archive.certifications()
            if e.calibration == name
        ]
        rows.append(
            {
                "calibration": name,
                "rig": row["rig"],
                "parts": list(document.parts()),
                "certified": "; ".join(standing) or None,
                "note": row["note"],
            }
        )
    emit(rows, ["calibration", "rig", "parts", "certified", "note"], chosen(style, as_json))


@calibration_app.command("show", epilog="Example: turnscan calibration show c-162 > cal.json")
def show_calibration(calibration: IdArgument) -> None:
    """Write a calibration document as JSON."""
    from ..schemas.document import dump_json

    sys.stdout.write(dump_json(open_archive().calibration(calibration).plain()).decode())


@calibration_app.command(
    "certify",
    epilog="Example: turnscan calibration certify c-162 --from 2026-05-01 --to 2026-09-01",
)
def certify_calibration(
    calibration: IdArgument,
    rig: RigOption = None,
    from_time: FromOption = None,
    to_time: ToOption = None,
    note: Annotated[str, typer.Option("--note", help="Why.")] = "",
) -> None:
    """State that a calibration holds for a rig over a half-open time range."""
    archive = open_archive()
    begin, end = parse_time(from_time, "--from"), parse_time(to_time, "--to")
    if begin is not None and end is not None and end <= begin:
        raise UsageError(
            f"--to {to_time} is not after --from {from_time}", hint="give the earlier time to --from"
        )
    event = archive.certify(calibration, rig=rig, from_ns=begin, to_ns=end, note=note)
    current_session().say(f"certified {event.calibration} for rig {event.rig} by event {event.id}")


@calibration_app.command("withdraw", epilog="Example: turnscan calibration withdraw c-162")
def withdraw_calibration(
    calibration: IdArgument,
    rig: Annotated[str | None, typer.Option("--rig", help="Only for this rig.")] = None,
    note: Annotated[str, typer.Option("--note", help="Why.")] = "",
) -> None:
    """Take back that a calibration holds. Nothing is deleted: an event is recorded."""
    for event in open_archive().withdraw(calibration, rig=rig, note=note):
        current_session().say(f"withdrew {event.calibration} (certification {event.after})")


@calibration_app.command("diff", epilog="Example: turnscan calibration diff c-162 c-81")
def diff_calibrations(
    first: IdArgument,
    second: IdArgument,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Show which values of two calibrations differ."""
    archive = open_archive()
    a, b = (_flat(archive.calibration(w).plain()) for w in (first, second))
    rows = [
        {"value": k, "first": a.get(k), "second": b.get(k)}
        for k in sorted({*a, *b})
        if a.get(k) != b.get(k)
    ]
    if not rows:
        current_session().say("they are the same")
    emit(rows, ["value", "first", "second"], chosen(style, as_json))


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        pairs = [(f"{name}.{k}" if name else k, v) for k, v in value.items()]
    elif isinstance(value, list):
        pairs = [(f"{name}[{i}]", v) for i, v in enumerate(value)]
    else:
        return {name: value}
    return {k: v for key, item in pairs for k, v in _flat(item, key).items()}
