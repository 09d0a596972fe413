"""``turnscan rig``: a commented rig file, whether a rig answers, and what ports there are."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from ..schemas.errors import ConflictError, DeviceError, StorageError
from .output import Format, FormatOption, JsonOption, chosen, counted, current_session, emit

rig_app = typer.Typer(
    no_args_is_help=True,
    help="Rigs: turntable, lasers and camera, as a rig.toml describes them.",
    epilog="Examples: turnscan rig new --driver simulated -o rig.toml; turnscan rig check rig.toml",
)


class DriverWord(StrEnum):
    """What --driver takes."""

    serial = "serial"
    simulated = "simulated"


class DialectWord(StrEnum):
    """What --dialect takes."""

    turnscan = "turnscan"
    horus = "horus"
    grbl = "grbl"


@rig_app.command(
    "new",
    epilog="Examples: turnscan rig new --dialect horus -o rig.toml; "
    "turnscan rig new --driver simulated",
)
def new_rig(
    driver: Annotated[
        DriverWord, typer.Option("--driver", help="A real serial port, or no hardware at all.")
    ] = DriverWord.serial,
    dialect: Annotated[
        DialectWord, typer.Option("--dialect", help="What the controller's firmware speaks.")
    ] = DialectWord.turnscan,
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Of the rig.")] = "rig",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write it there instead of to stdout."),
    ] = None,
) -> None:
    """Write a commented rig file to start from."""
    from ..schemas.rig import parse_rig
    from ..schemas.rig_template import rig_template

    text = rig_template(driver.value, dialect.value, name)
    parse_rig(text.encode(), where="--name")
    if output is None:
        sys.stdout.write(text)
        return
    try:
        with output.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConflictError(f"{output} exists", hint="give another --output") from error
    except OSError as error:
        raise StorageError(
            f"cannot write {output}: {error.strerror}", hint="give another --output"
        ) from error
    current_session().say(f"wrote {output}; look through it, then: turnscan rig check {output}")


@rig_app.command("check", epilog="Example: turnscan rig check rig.toml --no-move --json")
def check_rig(
    rig: Annotated[Path, typer.Argument(metavar="FILE", help="The rig file.")],
    move: Annotated[
        bool, typer.Option("--move/--no-move", help="Turn the table by five degrees and back.")
    ] = True,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Talk to each device, move a little, blink, take a frame, and say what is wrong.

    Exits with 1 if anything is wrong.
    """
    from ..ingest.devices.building import build_devices, read_rig
    from ..ingest.devices.checking import Trial

    session = current_session()
    found: list[dict[str, Any]] = []
    trial = Trial(build_devices(read_rig(rig)), move=move)
    for finding in trial.run():
        found.append(
            {
                "check": finding.check,
                "result": "ok" if finding.ok else "wrong",
                "seen": finding.seen,
                "hint": finding.hint,
            }
        )
        if not finding.ok:
            session.say(f"{finding.check}: {finding.seen}")
            session.say(f"  try: {finding.hint}")
    emit(found, ["check", "result", "seen"], chosen(style, as_json))
    wrong = [f for f in found if f["result"] == "wrong"]
    if wrong:
        raise DeviceError(
            f"{rig}: {counted(len(wrong), 'check')} of {len(found)} went wrong: "
            + ", ".join(f["check"] for f in wrong),
            hint=wrong[0]["hint"] or "see above",
        )


@rig_app.command("ports", epilog="Example: turnscan rig ports --json")
def list_rig_ports(style: FormatOption = Format.table, as_json: JsonOption = False) -> None:
    """List the serial ports of this machine."""
    from serial.tools import list_ports

    rows = [
        {"port": p.device, "description": p.description, "hardware": p.hwid}
        for p in sorted(list_ports.comports(), key=lambda p: p.device)
    ]
    emit(rows, ["port", "description", "hardware"], chosen(style, as_json))
    if not rows:
        current_session().say("no serial port; is the controller plugged in?")
