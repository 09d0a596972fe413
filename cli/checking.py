"""``calibration check``: does the calibration still fit this scan?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import InputError, UsageError
from .exporting import points_of
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit, emit_object
from .places import CalibrationOption, ScanArgument, open_archive
from .recipes import RecipeOption

if TYPE_CHECKING:
    from ..process.drift import Target
    from ..store import Archive

_MANY_SIGMAS = 3.0
_COLUMNS = ["check", "points", "change_mm", "sigmas", "limit_mm", "fits", "why"]


def check_calibration(
    scan: ScanArgument,
    target: Annotated[
        list[str] | None,
        typer.Option(
            "--target", metavar="X,Y,Z[,SD]", help="A point on a surface of the scene, mm; repeatable."
        ),
    ] = None,
    limit_mm: Annotated[
        float | None,
        typer.Option("--limit-mm", min=0, help="Changes below do not matter; else 3 sigma of a point."),
    ] = None,
    recipe: RecipeOption = None,
    calibration: CalibrationOption = "current",
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Say whether the calibration still fits a scan; exit 1 if it does not.

    A scan of more than one turn sees some angles twice: its first and last sweep must agree. Targets
    are points on flat spots whose place in the scene is known: given here, or recorded as references of
    the kind target (scan reference). A change counts when it is above both the limit and 3 sigma.
    """
    from ..process.batches import columns_of
    from ..process.drift import sweep_overlap, target_offsets

    archive = open_archive()
    (made,) = points_of(archive, [scan], recipe, calibration)
    targets = [_parse_target(t) for t in target or []] + _recorded(archive, made.scan)

    def read() -> Iterator[dict[str, Any]]:
        return (columns_of(batch) for batch in archive.read(made))

    rows: list[dict[str, Any]] = []
    try:
        drift = sweep_overlap(read)
    except InputError as error:
        if not targets:
            raise
        current_session().say(f"no comparison of sweeps: {error}")
    else:
        limit = 3.0 * drift.noise_mm if limit_mm is None else limit_mm
        rows.append(
            {"check": "first and last sweep", **_judged(drift.drift_mm, drift.sigmas, limit)}
            | {"points": drift.points, "overlap": asdict(drift)}
        )
    for found in target_offsets(read(), targets) if targets else []:
        name = f"target {found.target.name}"
        if found.offset_mm is None or found.sigma_mm is None or found.sigmas is None:
            why = f"no surface within {found.target.within_mm:g} mm of it"
            rows.append({"check": name, "points": 0, "fits": None, "why": why})
            continue
        limit = 3.0 * found.sigma_mm if limit_mm is None else limit_mm
        rows.append(
            {"check": name, **_judged(found.offset_mm, found.sigmas, limit)}
            | {"points": found.points, "target": asdict(found.target)}
        )
    _show(rows, made.scan, str(made.calibration), chosen(style, as_json))


def _judged(change_mm: float, sigmas: float, limit_mm: float) -> dict[str, Any]:
    fits = abs(change_mm) <= limit_mm or sigmas <= _MANY_SIGMAS
    return {"change_mm": change_mm, "sigmas": sigmas, "limit_mm": limit_mm, "fits": fits}


def _show(rows: list[dict[str, Any]], scan: str, calibration: str, style: Format) -> None:
    bad = [r["check"] for r in rows if r["fits"] is False]
    known = [r for r in rows if r["fits"] is not None]
    fits = None if not known else not bad
    if style is Format.json:
        emit_object({"scan": scan, "calibration": calibration, "fits": fits, "checks": rows}, style)
    else:
        emit(rows, _COLUMNS, style)
    if bad:
        current_session().complain(
            f"calibration {calibration} does not fit scan {scan} any more: {', '.join(bad)}",
            hint="calibrate the rig again and certify the result from when it moved",
        )
        raise typer.Exit(1)
    if fits is None:
        raise InputError(
            f"scan {scan} shows no surface at any target, so nothing can be said",
            hint="are the targets in scene space, in mm? turnscan export SCAN cloud.png shows them",
        )
    current_session().say(f"calibration {calibration} fits scan {scan}")


def _parse_target(text: str) -> Target:
    from ..process.drift import Target

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if (
        len(numbers) not in (3, 4)
        or not all(abs(n) < 1e9 for n in numbers)
        or min(numbers[3:] or [0]) < 0
    ):
        raise UsageError(
            f"--target {text!r}: expected X,Y,Z or X,Y,Z,SD in mm", hint="such as --target 0,500,80,0.5"
        )
    return Target(text, *numbers)


def _recorded(archive: Archive, scan: str) -> list[Target]:
    """References of the kind ``target`` that were recorded for the scan."""
    from ..process.drift import Target
    from ..schemas.archive_events import Referenced

    out = []
    for event in archive.events("referenced"):
        if (
            not isinstance(event, Referenced)
            or event.scan != scan
            or event.value.get("kind") != "target"
        ):
            continue
        names = ("x_mm", "y_mm", "z_mm", "sd_mm", "within_mm")
        values = {n: event.value[n] for n in names if n in event.value}
        try:
            out.append(
                Target(
                    str(event.value.get("name", event.id)), **{n: float(v) for n, v in values.items()}
                )
            )
        except (TypeError, ValueError) as error:
            raise InputError(
                f"reference {event.id} is no target: {error}",
                hint="a target has x_mm, y_mm, z_mm, and may have sd_mm, within_mm and name",
            ) from error
    return out
