"""``turnscan process`` and ``turnscan status``: derive what is missing, say what is stale and why."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import CalibrationError, TurnscanError, UsageError
from .output import Format, FormatOption, JsonOption, chosen, counted, current_session, emit
from .places import (
    CalibrationOption,
    WhereOption,
    chosen_recipe,
    chosen_scans,
    complete_scan,
    open_archive,
)
from .recipes import RecipeOption

if TYPE_CHECKING:
    from ..process.pipeline import Outcome
    from ..store import Archive

ScansArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[SCAN...]",
        help="Ids, prefixes, labels, latest; else all scans.",
        autocompletion=complete_scan,
    ),
]


def process(
    scans: ScansArgument = None,
    everything: Annotated[
        bool, typer.Option("--all", help="All scans; what happens anyway when none is named.")
    ] = False,
    stale: Annotated[
        bool, typer.Option("--stale", help="Only scans that something is to be derived of.")
    ] = False,
    where: WhereOption = None,
    recipe: RecipeOption = None,
    calibration: CalibrationOption = "current",
    workers: Annotated[int, typer.Option("--workers", "-j", min=1, help="Processes; a scan each.")] = 1,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be derived, and why.")
    ] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Derive what is missing: STRIPES from frames, POINTS from stripes.

    What exists under the same key is not derived again. A moved laser plane derives POINTS alone.
    """
    if everything and (scans or where):
        raise UsageError("--all excludes SCAN and --where", hint="give one of them")
    archive = open_archive()
    chosen_style = chosen(style, as_json)
    picked = chosen_scans(archive, scans, where)
    made_with = chosen_recipe(archive, recipe)
    session = current_session()
    if stale:
        plans = archive.plan(picked, made_with, calibration)
        picked = [
            scan
            for scan, plan in zip(picked, plans, strict=True)
            if isinstance(plan, TurnscanError) or not plan.done
        ]
    if not picked:
        session.say("no scan to process")
        emit([], ["scan", "did"], chosen_style)
        return
    if dry_run:
        rows = _stale_rows(archive, picked, made_with, calibration)
        tables = sum(len(r["table"].split(" and ")) for r in rows if r["stale"])
        session.say(f"would derive {tables} of {2 * len(picked)} tables")
        emit(rows, ["scan", "label", "table", "stale", "why"], chosen_style)
        _raise_first(rows)
        return
    from ..process.pipeline import derive

    outcomes = []
    with session.progress("processing") as advance:
        for outcome in derive(
            archive, picked, made_with, calibration, workers=workers, advance=advance
        ):
            outcomes.append(outcome)
            for warning in outcome.warnings:
                session.say(f"warning: {outcome.scan}: {warning}")
    _report(outcomes, chosen_style)


def _report(outcomes: list[Outcome], style: Format) -> None:
    session = current_session()
    rows = []
    for o in outcomes:
        did = (
            "failed" if o.error else ("derived " + " and ".join(o.derived) if o.derived else "nothing")
        )
        rows.append(
            {
                "scan": o.scan,
                "did": did,
                "points": o.points,
                "frames": o.frames,
                "seconds": round(o.seconds, 2),
                "why": str(o.error) if o.error else "; ".join(dict.fromkeys(o.reasons.values())),
            }
        )
    failed = [o for o in outcomes if o.error]
    derived = [o for o in outcomes if o.derived]
    if not failed and not derived:
        session.say(f"nothing to do: {counted(len(outcomes), 'scan')} up to date")
        rows = rows if style is not Format.table else []
    if rows or style is not Format.table:
        emit(rows, ["scan", "did", "points", "frames", "seconds", "why"], style)
    if failed:
        for o in failed[1:]:
            session.complain(str(o.error), hint=None)
        assert failed[0].error is not None
        raise failed[0].error


def _stale_rows(
    archive: Archive, picked: list[Any], recipe: Any, calibration: str
) -> list[dict[str, Any]]:
    """One row a scan: which of its tables are stale, and why in one line."""
    rows: list[dict[str, Any]] = []
    for scan, plan in zip(picked, archive.plan(picked, recipe, calibration), strict=True):
        row: dict[str, Any] = {"scan": scan.scan, "label": scan.label}
        if isinstance(plan, TurnscanError):
            row |= {"table": "points", "stale": True, "why": str(plan), "error": plan.message}
        else:
            tables = " and ".join(plan.missing)
            row |= {"table": tables, "stale": not plan.done, "why": archive.why_stale(plan)}
        rows.append(row)
    return rows


def _raise_first(rows: list[dict[str, Any]]) -> None:
    errors = [r["error"] for r in rows if "error" in r]
    if errors:
        raise CalibrationError(errors[0], hint="turnscan calibration list shows what there is")


def status(
    scans: ScansArgument = None,
    where: WhereOption = None,
    recipe: RecipeOption = None,
    calibration: CalibrationOption = "current",
    check: Annotated[bool, typer.Option("--check", help="Exit 1 if anything is stale.")] = False,
    show_all: Annotated[bool, typer.Option("--all", help="Also list what is up to date.")] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """List the scans that are stale, each with the reason in one line."""
    archive = open_archive()
    picked = chosen_scans(archive, scans, where)
    rows = _stale_rows(archive, picked, chosen_recipe(archive, recipe), calibration)
    stale = [r for r in rows if r["stale"]]
    current_session().say(
        f"stale: {len(stale)} of {counted(len(picked), 'scan')}"
        if stale
        else f"{counted(len(picked), 'scan')} up to date"
    )
    shown = rows if show_all else stale
    chosen_style = chosen(style, as_json)
    if shown or chosen_style is not Format.table:
        emit(shown, ["scan", "label", "table", "stale", "why"], chosen_style)
    if check and stale:
        raise typer.Exit(1)
