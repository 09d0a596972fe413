"""``turnscan verify`` and ``turnscan repair``: is every byte what was written, and what if not."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from .output import Format, FormatOption, JsonOption, chosen, current_session, emit
from .places import open_archive


def verify(style: FormatOption = Format.table, as_json: JsonOption = False) -> None:
    """Check every digest, CRC, page checksum and manifest. Exit 1 and a list if anything is damaged."""
    from ..store.verify import verify as verify_archive

    archive = open_archive()
    session = current_session()
    with session.progress("verifying") as advance:
        findings = verify_archive(archive, advance)
    chosen_style = chosen(style, as_json)
    if findings or chosen_style is not Format.table:
        emit([asdict(f) for f in findings], ["path", "what", "hint"], chosen_style)
    if findings:
        session.say(f"{len(findings)} things are not as they were written")
        raise typer.Exit(1)
    session.say("everything is as it was written")


def repair(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done.")] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Salvage unfinished scans, move damaged tables to quarantine/, rebuild the catalogue.

    Sealed logs, calibrations and events are never touched.
    """
    from ..store.repair import repair as repair_archive

    done = repair_archive(open_archive(), dry_run=dry_run)
    emit([asdict(r) for r in done], ["path", "did"], chosen(style, as_json))
