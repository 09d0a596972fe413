"""What a command shows: data on stdout as table, JSON or CSV; words and progress on stderr."""

from __future__ import annotations

import csv
import json
import logging
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from ..schemas.errors import StorageError, UsageError

LOG = logging.getLogger("turnscan")


class Format(StrEnum):
    """How data is written to stdout."""

    table = "table"
    json = "json"
    csv = "csv"


FormatOption = Annotated[
    Format, typer.Option("--format", help="How data is written to stdout.", show_default=True)
]
JsonOption = Annotated[bool, typer.Option("--json", help="Short for --format json.")]


class Advance(Protocol):
    """Called with the number of steps done so far and the number in all."""

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps are done."""


@dataclass
class Session:
    """The global options of one call."""

    archive: Path | None = None
    verbose: int = 0
    quiet: bool = False
    debug: bool = False

    def start_log(self, log_file: Path | None) -> None:
        """Send the program's log to stderr (from -v) and to ``log_file``."""
        for handler in LOG.handlers[:]:
            LOG.removeHandler(handler)
            handler.close()
        LOG.propagate = False
        LOG.setLevel(logging.DEBUG if self.verbose > 1 or log_file else logging.INFO)
        shown = logging.StreamHandler(sys.stderr)
        level = [logging.WARNING, logging.INFO, logging.DEBUG][min(self.verbose, 2)]
        shown.setLevel(logging.ERROR if self.quiet else level)
        shown.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
        LOG.addHandler(shown)
        if log_file is not None:
            try:
                kept = logging.FileHandler(log_file, encoding="utf-8")
            except OSError as error:
                raise StorageError(
                    f"cannot write the log file {log_file}: {error.strerror}",
                    hint="give another --log-file",
                ) from error
            formatter = logging.Formatter("%(asctime)sZ %(levelname)s %(message)s")
            formatter.converter = time.gmtime
            kept.setFormatter(formatter)
            LOG.addHandler(kept)

    def say(self, text: str) -> None:
        """A line for the person, on stderr; none with -q."""
        LOG.debug("said: %s", text)
        if not self.quiet:
            sys.stderr.write(text + "\n")

    def complain(self, text: str, *, hint: str | None) -> None:
        """An error and its way out, on stderr."""
        LOG.debug("error: %s", text)
        red, plain = ("\033[31m", "\033[0m") if _coloured(sys.stderr) else ("", "")
        sys.stderr.write(f"{red}error:{plain} {text}\n")
        if hint:
            sys.stderr.write(f"hint: {hint}\n")

    @contextmanager
    def progress(self, what: str) -> Iterator[Advance]:
        """A progress bar on stderr; nothing when stderr is not a terminal or with -q."""
        if self.quiet or not sys.stderr.isatty():

            def silent(done: int, total: int) -> None:
                LOG.debug("%s: %d of %d", what, done, total)

            yield silent
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

        columns = (
            "[progress.description]{task.description}",
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=None)

            def advance(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            yield advance


_SESSION = [Session()]


def current_session() -> Session:
    """The options of the running call."""
    return _SESSION[0]


def set_session(session: Session) -> None:
    """Make ``session`` the options of the running call."""
    _SESSION[0] = session


def _coloured(stream: Any) -> bool:
    return stream.isatty() and not os.environ.get("NO_COLOR")


def chosen(style: Format, as_json: bool) -> Format:
    """The output format that --format and --json together ask for."""
    if as_json and style is Format.csv:
        raise UsageError("--json and --format csv contradict each other", hint="give one of them")
    return Format.json if as_json else style


def emit(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], style: Format) -> None:
    """Write ``rows`` to stdout; in a table, floats are rounded to six digits."""
    if style is Format.json:
        _write_json([dict(r) for r in rows])
    elif style is Format.csv:
        writer = csv.DictWriter(sys.stdout, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: _flat(v) for k, v in r.items()} for r in rows)
    else:
        _emit_table(rows, columns)


def emit_object(value: Mapping[str, Any], style: Format) -> None:
    """Write one thing to stdout: JSON object, or one ``name  value`` line a field."""
    if style is Format.json:
        _write_json(dict(value))
    elif style is Format.csv:
        emit([value], list(value), style)
    else:
        width = max((len(k) for k in value), default=0)
        for key, item in value.items():
            sys.stdout.write(f"{key:<{width}}  {_cell(item)}\n")


def _write_json(value: Any) -> None:
    json.dump(_finite(value), sys.stdout, indent=2, ensure_ascii=False, allow_nan=False, default=str)
    sys.stdout.write("\n")


def _finite(value: Any) -> Any:
    """``value`` with null for NaN and infinity, which JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return value


def counted(number: int, noun: str) -> str:
    """``number`` and ``noun`` with an s where it wants one."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _flat(value: Any) -> Any:
    if isinstance(value, (dict, list, tuple)):
        return json.dumps(value, ensure_ascii=False, default=str)
    return value


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return " ".join(f"{k}={v}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ",".join(_cell(v) for v in value)
    return str(value)


def _emit_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    cells = [[_cell(r.get(c)) for c in columns] for r in rows]
    number = [all(_is_number(r.get(c)) for r in rows) and bool(rows) for c in columns]
    width = [max([len(c), *(len(line[i]) for line in cells)]) for i, c in enumerate(columns)]

    def line(values: Sequence[str]) -> str:
        parts = [v.rjust(width[i]) if number[i] else v.ljust(width[i]) for i, v in enumerate(values)]
        return "  ".join(parts).rstrip() + "\n"

    bold, plain = ("\033[1m", "\033[0m") if _coloured(sys.stdout) else ("", "")
    sys.stdout.write(bold + line(list(columns)).rstrip("\n") + plain + "\n")
    for values in cells:
        sys.stdout.write(line(values))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
