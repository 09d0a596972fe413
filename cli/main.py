"""The ``turnscan`` command: global options, exit codes, and one place where errors are shown.

Exit codes: 0 done, 1 failed, 2 usage, 130 interrupted. Data goes to stdout, all else to stderr.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from typer.exceptions import TyperException

from ..schemas.errors import (
    DamageError,
    DocumentError,
    InputError,
    StorageError,
    TurnscanError,
    UsageError,
)
from ..schemas.software import SOFTWARE
from .commands import LazyGroup
from .output import Session, current_session, set_session

app = typer.Typer(
    name="turnscan",
    cls=LazyGroup,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help=(
        "Laser-triangulation scans as immutable logs, and point tables derived from them.\n\n"
        "Start with [bold]turnscan demo[/bold]: it needs no hardware and no data."
    ),
    epilog="Examples: turnscan init lab; cd lab; turnscan import images photos --step-deg 1.125; "
    "turnscan process; turnscan export latest cloud.ply",
)
#: The way out where an error names none of its own.
_WAYS_OUT: tuple[tuple[type[TurnscanError], str], ...] = (
    (InputError, "correct or leave out what is named, then run the command again"),
    (DocumentError, "correct what is named; docs/format.md shows the form"),
    (DamageError, "turnscan verify lists what is damaged"),
    (StorageError, "does it exist, may you read and write there, is there room?"),
    (UsageError, "turnscan --help lists the commands, and COMMAND --help what each takes"),
)


def _show_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"{SOFTWARE}\n")
        raise typer.Exit


@app.callback()
def options(
    archive: Annotated[
        Path | None,
        typer.Option(
            "--archive",
            metavar="DIR",
            help="The archive; else TURNSCAN_ARCHIVE, else the nearest folder upward that is one.",
        ),
    ] = None,
    verbose: Annotated[
        int, typer.Option("-v", "--verbose", count=True, help="Say more; -vv for debugging.")
    ] = 0,
    quiet: Annotated[
        bool, typer.Option("-q", "--quiet", help="Say nothing but errors and data.")
    ] = False,
    log_file: Annotated[
        Path | None, typer.Option("--log-file", metavar="FILE", help="Write a log there, too.")
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Version.")
    ] = False,
) -> None:
    """Options that every command shares."""
    set_session(Session(archive=archive, verbose=verbose, quiet=quiet, debug=debug))
    current_session().start_log(log_file)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the console script; exits the process."""
    set_session(Session(debug="--debug" in (sys.argv[1:] if arguments is None else arguments)))
    try:
        code = app(args=arguments, prog_name="turnscan", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        code = 130
    except TurnscanError as error:
        way_out = next((hint for kind, hint in _WAYS_OUT if isinstance(error, kind)), None)
        code = _failed(error, error.hint or way_out, error.exit_code)
    except TyperException as error:
        code = _usage(error)
    except OSError as error:
        code = _failed(error, _way_out(error), 1)
    except SystemExit as stop:
        # Typer turns a broken pipe into exit code 1 by itself.
        if not isinstance(stop.__context__, BrokenPipeError):
            raise
        code = 0
    if code == 130:  # Typer's word for Ctrl-C, and ours.
        current_session().complain("interrupted", hint=None)
    _let_go_of_stdout()
    sys.exit(code if isinstance(code, int) else 0)


def _let_go_of_stdout() -> None:
    """Flush; a reader that went away, such as ``head``, is no failure of ours."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        # Else the interpreter would flush once more on its way out, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _usage(error: TyperException) -> int:
    text = error.format_message()
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        sys.stderr.write(text + "\n")
        return 2
    command = context.command_path if context is not None else "turnscan"
    return _failed(TurnscanError(text), f"{command} --help shows what it takes", error.exit_code)


def _failed(error: Exception, hint: str | None, code: int) -> int:
    session = current_session()
    if session.debug:
        logging.getLogger("turnscan").debug("failed", exc_info=error)
        import traceback

        traceback.print_exception(error)
    session.complain(str(error), hint=hint)
    return code


def _way_out(error: OSError) -> str:
    name = error.filename or "the file system"
    return f"check {name}: does it exist, may you write there, is there room?"
