"""From what the user typed to things: the archive, scans, times, tags; and words for completion."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import StorageError, TurnscanError, UsageError
from .output import current_session

if TYPE_CHECKING:
    from ..schemas.calibration import Calibration
    from ..schemas.manifests import ScanSummary
    from ..schemas.recipe import Recipe
    from ..store import Archive


def open_archive() -> Archive:
    """--archive, else TURNSCAN_ARCHIVE, else the nearest folder upward that is an archive."""
    from ..store import Archive

    named = current_session().archive or os.environ.get("TURNSCAN_ARCHIVE")
    return Archive.open(named) if named else Archive.find()


def complete_scan(incomplete: str) -> list[str]:
    """Ids and labels of scans, for tab completion; nothing where there is no archive."""
    try:
        rows = open_archive().scan_rows()
    except TurnscanError:
        return []
    words = ["latest", *(r["label"] for r in rows if r["label"]), *(r["scan"] for r in rows)]
    return [w for w in words if w.startswith(incomplete)]


def complete_calibration(incomplete: str) -> list[str]:
    """Ids of calibrations, and the two words that choose one."""
    try:
        rows = open_archive().calibration_rows()
    except TurnscanError:
        return []
    words = ["current", "recorded", *(r["calibration"] for r in rows)]
    return [w for w in words if w.startswith(incomplete)]


ScanArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCAN", help="Id, unique prefix, label, or latest.", autocompletion=complete_scan
    ),
]
CalibrationArgument = Annotated[
    str,
    typer.Argument(
        metavar="CALIBRATION", help="Id or unique prefix.", autocompletion=complete_calibration
    ),
]
WhereOption = Annotated[
    str | None,
    typer.Option("--where", metavar="SQL", help="Scans that fit, such as \"rig = 'desk'\"."),
]
CalibrationOption = Annotated[
    str,
    typer.Option(
        "--calibration",
        "-c",
        metavar="ID",
        help="current (certified, else recorded), recorded, or an id.",
        autocompletion=complete_calibration,
    ),
]


def chosen_scans(archive: Archive, words: list[str] | None, where: str | None) -> list[ScanSummary]:
    """The scans that words and --where name; all that are not retired if neither is given."""
    if words and where:
        raise UsageError("SCAN and --where exclude each other", hint="give one of them")
    if words:
        # A scan that was interrupted and resumed is several logs: its name means all of them.
        named = {s.scan: s for w in words for s in archive.chain(archive.scan(w).scan)}
        return list(named.values())
    return archive.scans(where=where)


def chosen_recipe(archive: Archive, word: str | None) -> Recipe:
    """The recipe that --recipe names, else the archive's default."""
    from .recipes import load_recipe

    return load_recipe(word) if word else archive.recipe()


def read_calibration_file(path: Path) -> Calibration:
    """A calibration document from a file."""
    from ..schemas.calibration import parse_calibration

    try:
        data = path.read_bytes()
    except OSError as error:
        raise StorageError(f"cannot read {path}: {error.strerror}") from error
    return parse_calibration(data, where=str(path))


def parse_tags(words: list[str] | None) -> dict[str, str]:
    """``k=v`` words as a dict; an empty value is kept."""
    out: dict[str, str] = {}
    for word in words or []:
        key, sign, value = word.partition("=")
        if not sign or not key or not all(ch.isalnum() or ch in "_.-" for ch in key):
            raise UsageError(f"--tag {word!r}: expected name=value", hint="such as --tag owner=lab2")
        out[key] = value
    return out


def parse_time(text: str | None, option: str) -> int | None:
    """ISO 8601 (UTC unless it says otherwise) or whole nanoseconds, as t_ns."""
    if text is None:
        return None
    if text.isdigit() and len(text) > 10:
        t_ns = int(text)
    else:
        try:
            moment = datetime.fromisoformat(text)
        except ValueError as error:
            raise UsageError(
                f"{option} {text!r}: expected a time in ISO 8601 or whole nanoseconds",
                hint=f"such as {option} 2026-11-21, 2026-11-21T10:30 (both UTC), "
                "2026-11-21T11:30+01:00",
            ) from error
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=UTC)
        # Whole microseconds: a float of seconds would be off by some hundred nanoseconds.
        t_ns = (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    if not 0 <= t_ns < 2**63:
        raise UsageError(
            f"{option} {text!r} lies outside the years 1970 to 2262",
            hint=f"leave {option} out where there is no such limit",
        )
    return t_ns


def show_time(t_ns: int | None) -> str:
    """t_ns as ISO 8601 in UTC, to the second."""
    if t_ns is None:
        return "-"
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
