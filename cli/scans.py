"""``turnscan scan``: list, show, tag, reference, retire."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import UsageError
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit, emit_object
from .places import ScanArgument, WhereOption, open_archive, parse_tags, show_time

if TYPE_CHECKING:
    from ..schemas.manifests import ScanSummary

scan_app = typer.Typer(
    no_args_is_help=True,
    help="The archive's scans.",
    epilog="Examples: turnscan scan list; turnscan scan show latest",
)


@scan_app.command("list", epilog="Example: turnscan scan list --where \"rig = 'desk'\" --json")
def list_scans(
    where: WhereOption = None,
    retired: Annotated[bool, typer.Option("--retired", help="Also those out of use.")] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """List scans, oldest first."""
    rows = [
        {
            "scan": r["scan"],
            "label": r["label"],
            "rig": r["rig"],
            "started": show_time(r["started_ns"]),
            "frames": r["frames"],
            "size_px": f"{r['width_px']}x{r['height_px']}",
            "ended": r["ended"],
            "calibration": r["calibration"],
            "tags": r["tags"],
            "continues": r["continues"],
            **({"retired": r["retired"]} if retired else {}),
        }
        for r in open_archive().scan_rows(where=where, retired=retired)
    ]
    columns = ["scan", "label", "rig", "started", "frames", "size_px", "ended"]
    columns += ["calibration", "tags", "continues"]
    emit(rows, columns + (["retired"] if retired else []), chosen(style, as_json))


@scan_app.command("show", epilog="Example: turnscan scan show latest")
def show_scan(
    scan: ScanArgument, style: FormatOption = Format.table, as_json: JsonOption = False
) -> None:
    """Show one scan: what it is, its calibration, what was derived from it.

    A scan that was interrupted and resumed is several logs, which are shown as one.
    """
    import json

    archive = open_archive()
    summary = archive.scan(scan)
    logs = archive.chain(summary.scan)
    row = next(r for r in archive.scan_rows(retired=True) if r["scan"] == summary.scan)
    made = [m for log in logs for m in archive.derivations(log.scan)]
    derived = [
        {
            **({"scan": m.scan} if len(logs) > 1 else {}),
            "table": m.kind,
            "recipe": m.recipe_document.get("name", m.recipe),
            "calibration": m.calibration,
            "rows": m.rows,
            "key": m.key[:12],
            "made": show_time(m.created_ns),
        }
        for m in sorted(made, key=lambda m: (m.created_ns, m.kind))
    ]
    value: dict[str, Any] = json.loads(summary.model_dump_json())
    value |= {"label": row["label"], "tags": row["tags"], "retired": row["retired"]}
    chosen_style = chosen(style, as_json)
    if chosen_style is not Format.table:
        whole = {"logs": [log_row(log) for log in logs]} if len(logs) > 1 else {}
        emit_object(value | whole | {"derivations": derived}, chosen_style)
        return
    low = math.degrees(min(log.angle_min_rad for log in logs))
    high = math.degrees(max(log.angle_max_rad for log in logs))
    frames = sum(log.frames for log in logs)
    dark = sum(log.background_frames for log in logs)
    first, last = logs[0], logs[-1]
    shown = {
        "scan": first.scan,
        "label": row["label"] or None,
        "tags": row["tags"] or None,
        "rig": summary.rig,
        "source": summary.source,
        "started": show_time(first.started_ns),
        "ended": f"{show_time(last.ended_ns)}, {last.ended}",
        "frames": f"{frames}, of them {dark} with the laser off",
        "images": f"{summary.width_px} x {summary.height_px} {summary.encoding}",
        "angles_deg": f"{low:.6g} to {high:.6g}",
        "lasers": sorted({n for log in logs for n in log.lasers}),
        "calibration": summary.calibration,
        "log": "; ".join(f"{archive.log(x.scan).path} ({x.log_bytes} bytes)" for x in logs),
        "content": ", ".join(log.content_sha256[:12] for log in logs),
        "salvaged_from": first.salvaged_from,
        "retired": row["retired"],
    }
    emit_object(shown, chosen_style)
    if len(logs) > 1:
        typer.echo()
        emit(
            [log_row(log) for log in logs],
            ["scan", "continues", "started", "ended", "frames", "from_deg", "to_deg"],
            chosen_style,
        )
    if derived:
        typer.echo()
        columns = ["table", "recipe", "calibration", "rows", "key", "made"]
        emit(derived, (["scan"] if len(logs) > 1 else []) + columns, chosen_style)


def log_row(log: ScanSummary) -> dict[str, Any]:
    """One of the logs of a scan that was resumed."""
    return {
        "scan": log.scan,
        "continues": log.continues,
        "started": show_time(log.started_ns),
        "ended": log.ended,
        "frames": log.frames,
        "from_deg": round(math.degrees(log.angle_min_rad), 6),
        "to_deg": round(math.degrees(log.angle_max_rad), 6),
    }


@scan_app.command("tag", epilog="Example: turnscan scan tag latest owner=lab2 --label bust")
def tag_scan(
    scan: ScanArgument,
    tags: Annotated[
        list[str] | None, typer.Argument(metavar="K=V...", help="An empty value removes the tag.")
    ] = None,
    label: Annotated[str | None, typer.Option("--label", help="A new name.")] = None,
) -> None:
    """Set tags and label of a scan. The log is not touched: an event is recorded."""
    if not tags and label is None:
        raise UsageError("nothing to set", hint="give K=V words or --label")
    archive = open_archive()
    summary = archive.scan(scan)
    for log in archive.chain(summary.scan):
        archive.tag(log.scan, parse_tags(tags), label)
    current_session().say(f"tagged {summary.scan}")


@scan_app.command(
    "reference",
    epilog="Example: turnscan scan reference latest target x_mm=0 y_mm=500 z_mm=80 sd_mm=0.5",
)
def add_reference(
    scan: ScanArgument,
    kind: Annotated[str, typer.Argument(metavar="KIND", help="What it is, such as target.")],
    values: Annotated[
        list[str], typer.Argument(metavar="K=V...", help="Its values; numbers where they are numbers.")
    ],
    note: Annotated[str, typer.Option("--note", help="How it was measured.")] = "",
) -> None:
    """Record a trusted measurement of what a scan shows. The log is not touched: an event is recorded.

    A target is a point on a flat spot of the scene, for calibration check: x_mm, y_mm, z_mm, and, where
    known, sd_mm, within_mm, name.
    """
    from ..schemas.archive_events import Referenced

    value: dict[str, Any] = {"kind": kind}
    for name, text in parse_tags(values).items():
        try:
            value[name] = float(text)
        except ValueError:
            value[name] = text
        if isinstance(value[name], float) and not math.isfinite(value[name]):
            raise UsageError(f"{name}={text}: expected a finite number", hint="such as x_mm=120.5")
    _check_target(value)
    archive = open_archive()
    summary = archive.scan(scan)
    event = archive.record_event(Referenced, scan=summary.scan, value=value, note=note)
    current_session().say(f"recorded {kind} for {summary.scan} by event {event.id}")


def _check_target(value: dict[str, Any]) -> None:
    if value["kind"] != "target":
        return
    missing = [n for n in ("x_mm", "y_mm", "z_mm") if not isinstance(value.get(n), float)]
    if missing:
        raise UsageError(
            f"a target needs {', '.join(missing)} as numbers",
            hint="such as target x_mm=0 y_mm=500 z_mm=80 sd_mm=0.5, in scene space",
        )


@scan_app.command("retire", epilog="Example: turnscan scan retire s-01K --note 'laser was off'")
def retire_scan(
    scan: ScanArgument,
    back: Annotated[bool, typer.Option("--back", help="Take it into use again.")] = False,
    note: Annotated[str, typer.Option("--note", help="Why.")] = "",
) -> None:
    """Take a scan out of use (or back). Nothing is deleted."""
    archive = open_archive()
    summary = archive.scan(scan)
    archive.retire(summary.scan, back=back, note=note)
    current_session().say(f"{'restored' if back else 'retired'} {summary.scan}")
