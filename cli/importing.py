"""``turnscan import``: old data becomes a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..schemas.errors import UsageError
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit_object
from .places import open_archive, parse_tags, parse_time, read_calibration_file, show_time

import_app = typer.Typer(
    no_args_is_help=True,
    help="Old data becomes a scan.",
    epilog="Example: turnscan import images photos --step-deg 1.125",
)


@import_app.callback()
def _group() -> None:
    """Keep `images` a word of its own: other sources will stand beside it."""


@import_app.command(
    "images",
    epilog="Examples: turnscan import images photos --step-deg 1.125 --calibration cal.json; "
    "turnscan import images 'run7/*.png' --angles angles.csv --label bust --tag owner=lab2",
)
def import_images_command(
    sources: Annotated[
        list[str], typer.Argument(metavar="DIR|GLOB|FILE...", help="JPEG, PNG, BMP, TIFF.")
    ],
    step_deg: Annotated[
        float | None, typer.Option("--step-deg", help="Turn between two frames, in degrees.")
    ] = None,
    start_deg: Annotated[float, typer.Option("--start-deg", help="Angle of the first.")] = 0.0,
    angles: Annotated[
        Path | None,
        typer.Option(
            "--angles", metavar="F.csv", help="Columns file, angle_deg [, t_ns, laser, laser_on]."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", "-c", metavar="FILE", help="Kept in the log as recorded."),
    ] = None,
    rig: Annotated[
        str | None, typer.Option("--rig", help="Rig id; else the calibration's, else unknown.")
    ] = None,
    laser: Annotated[int, typer.Option("--laser", min=0, max=255, help="Which laser is lit.")] = 0,
    background: Annotated[
        str | None,
        typer.Option("--background", metavar="PATTERN", help="Names of laser-off frames."),
    ] = None,
    label: Annotated[str, typer.Option("--label", help="A name for the scan.")] = "",
    tag: Annotated[list[str] | None, typer.Option("--tag", metavar="K=V", help="May repeat.")] = None,
    started_at: Annotated[
        str | None, typer.Option("--started-at", metavar="TIME", help="ISO 8601, UTC.")
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Import even if the archive has the same content.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be imported.")] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Import a folder of laser photographs as one scan.

    Frames are in natural order (img2 before img10). The original bytes are kept. Orientation tags are
    ignored: pixels stay as the sensor stored them, because calibrations are true of those.
    """
    if (step_deg is None) == (angles is None):
        raise UsageError("give either --step-deg or --angles", hint="angles are never guessed")
    if angles is not None and background is not None:
        raise UsageError("--background goes with --step-deg", hint="use laser_on in the CSV")
    from ..ingest.image_import import ImportPlan, import_images
    from ..ingest.image_sources import find_images
    from ..ingest.poses import poses_by_step, poses_from_csv

    archive = open_archive()
    session = current_session()
    images, skipped = find_images(sources)
    if skipped:
        session.say(f"skipped {len(skipped)} files that are no images: {skipped[0].name} ...")
    if angles is not None:
        poses = poses_from_csv(images, angles)
    else:
        assert step_deg is not None
        poses = poses_by_step(
            images, step_deg=step_deg, start_deg=start_deg, laser=laser, background=background
        )
    document = read_calibration_file(calibration) if calibration else None
    plan = ImportPlan(
        poses=poses,
        rig=rig or (document.rig if document else "unknown"),
        label=label,
        tags=parse_tags(tag),
        calibration=document,
        started_ns=parse_time(started_at, "--started-at"),
        again=again,
    )
    if dry_run:
        first, last = poses[0], poses[-1]
        session.say(
            f"would import {len(poses)} frames: {first.path.name} at {first.angle_deg:g} deg "
            f"to {last.path.name} at {last.angle_deg:g} deg"
        )
        return
    with session.progress("importing") as advance:
        summary = import_images(archive, plan, advance)
    session.say(f"sealed scan {summary.scan}")
    shown = {
        "scan": summary.scan,
        "label": summary.label,
        "rig": summary.rig,
        "frames": summary.frames,
        "background_frames": summary.background_frames,
        "size_px": f"{summary.width_px}x{summary.height_px}",
        "started": show_time(summary.started_ns),
        "calibration": summary.calibration,
        "log_bytes": summary.log_bytes,
    }
    emit_object(shown, chosen(style, as_json))
