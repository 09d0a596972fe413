"""``turnscan import``: old data becomes a scan."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import UsageError
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit_object
from .places import open_archive, parse_tags, parse_time, read_calibration_file, show_time

if TYPE_CHECKING:
    from ..schemas.manifests import ScanSummary


class AngleUnit(StrEnum):
    """The unit of an angle in somebody else's message."""

    deg = "deg"
    rad = "rad"


class Mode(StrEnum):
    """What the table did between two angles."""

    step = "step"
    continuous = "continuous"


class Times(StrEnum):
    """Which times of a recording to use."""

    auto = "auto"
    stamp = "stamp"
    log = "log"


CalibrationFile = Annotated[
    Path | None,
    typer.Option("--calibration", "-c", metavar="FILE", help="Kept in the log as recorded."),
]
RigOption = Annotated[
    str | None, typer.Option("--rig", help="Rig id; else the calibration's, else unknown.")
]
LaserOption = Annotated[int, typer.Option("--laser", min=0, max=255, help="Which laser is lit.")]
LabelOption = Annotated[str, typer.Option("--label", help="A name for the scan.")]
TagOption = Annotated[list[str] | None, typer.Option("--tag", metavar="K=V", help="May repeat.")]
StepOption = Annotated[
    float | None, typer.Option("--step-deg", help="Turn between two frames, in degrees.")
]
StartOption = Annotated[float, typer.Option("--start-deg", help="Angle of the first.")]
StartedOption = Annotated[
    str | None, typer.Option("--started-at", metavar="TIME", help="ISO 8601, UTC.")
]
AgainOption = Annotated[
    bool, typer.Option("--again", help="Import even if the archive has the same content.")
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Say what would be imported.")]

import_app = typer.Typer(
    no_args_is_help=True,
    help="Old data becomes a scan.",
    epilog="Example: turnscan import images photos --step-deg 1.125",
)


@import_app.command(
    "images",
    epilog="Examples: turnscan import images photos --step-deg 1.125 --calibration cal.json; "
    "turnscan import images 'run7/*.png' --angles angles.csv --label bust --tag owner=lab2",
)
def import_images_command(
    sources: Annotated[
        list[str], typer.Argument(metavar="DIR|GLOB|FILE...", help="JPEG, PNG, BMP, TIFF.")
    ],
    step_deg: StepOption = None,
    start_deg: StartOption = 0.0,
    angles: Annotated[
        Path | None,
        typer.Option(
            "--angles", metavar="F.csv", help="Columns file, angle_deg [, t_ns, laser, laser_on]."
        ),
    ] = None,
    calibration: CalibrationFile = None,
    rig: RigOption = None,
    laser: LaserOption = 0,
    background: Annotated[
        str | None,
        typer.Option("--background", metavar="PATTERN", help="Names of laser-off frames."),
    ] = None,
    label: LabelOption = "",
    tag: TagOption = None,
    started_at: StartedOption = None,
    again: AgainOption = False,
    dry_run: DryRunOption = False,
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
    _show(summary, chosen(style, as_json))


def _show(summary: ScanSummary, style: Format) -> None:
    """The new scan, on stdout."""
    current_session().say(f"sealed scan {summary.scan}")
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
    emit_object(shown, style)


@import_app.command(
    "mcap",
    epilog="Examples: turnscan import mcap bag_0.mcap --dry-run; "
    "turnscan import mcap bag_0.mcap --image-topic /camera/image_raw --angle-topic /joint_states "
    "--angle-field position.table --mode continuous",
)
def import_mcap_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording of ROS 2 or Foxglove.")],
    image_topic: Annotated[
        str | None, typer.Option("--image-topic", metavar="TOPIC", help="Else the only one.")
    ] = None,
    angle_topic: Annotated[
        str | None, typer.Option("--angle-topic", metavar="TOPIC", help="Else the only one.")
    ] = None,
    angle_field: Annotated[
        str | None,
        typer.Option(
            "--angle-field", metavar="PATH", help="Where in a message, such as position.table."
        ),
    ] = None,
    angle_unit: Annotated[
        AngleUnit | None,
        typer.Option("--angle-unit", help="Needed where neither message nor field says it."),
    ] = None,
    laser_topic: Annotated[
        str | None,
        typer.Option("--laser-topic", metavar="TOPIC", help="When the laser is on; else always."),
    ] = None,
    laser_field: Annotated[
        str | None, typer.Option("--laser-field", metavar="PATH", help="Where in a message.")
    ] = None,
    mode: Annotated[
        Mode | None,
        typer.Option("--mode", help="Did the table turn between two angles? Else as joints say."),
    ] = None,
    times: Annotated[
        Times, typer.Option("--times", help="Header stamps or log times; auto: stamps if all have one.")
    ] = Times.auto,
    calibration: CalibrationFile = None,
    rig: RigOption = None,
    laser: LaserOption = 0,
    label: LabelOption = "",
    tag: TagOption = None,
    again: AgainOption = False,
    dry_run: DryRunOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Import the images and angles of an MCAP recording as one scan.

    Messages may be ROS 2 (CDR), Foxglove protobuf or JSON. Images, compressed bytes and angles stay as
    they are; nothing is interpolated. A camera calibration on its own topic is kept where it is
    complete and fits. docs/importing.md lists messages and encodings.
    """
    from ..ingest.mcap_import import McapPlan, import_mcap, read_content
    from ..ingest.mcap_survey import Asked
    from ..ingest.messages.paths import split_path

    archive = open_archive()
    session = current_session()
    document = read_calibration_file(calibration) if calibration else None
    asked = Asked(
        image_topic=image_topic,
        angle_topic=angle_topic,
        angle_path=None if angle_field is None else split_path(angle_field),
        angle_unit=angle_unit.value if angle_unit else None,
        laser_topic=laser_topic,
        laser_path=None if laser_field is None else split_path(laser_field),
    )
    plan = McapPlan(
        path=file,
        asked=asked,
        times=times.value,
        mode=mode.value if mode else None,
        laser=laser,
        rig=rig or (document.rig if document else None),
        label=label,
        tags=parse_tags(tag),
        calibration=document,
        again=again,
    )
    content = read_content(plan)
    for text in content.remarks:
        session.say(f"note: {text}")
    if dry_run:
        low, high = content.angle_range_deg()
        session.say(f"would import {len(content.order)} frames, {low:g} to {high:g} deg")
        shown = {
            "images": content.choice.images.topic,
            "angles": content.choice.angles.topic,
            "lasers": content.choice.laser.topic if content.choice.laser else None,
            "frames": len(content.order),
            "angle_events": content.choice.angles.count,
            "angle_from_deg": low,
            "angle_to_deg": high,
            "size_px": f"{content.size_px[0]}x{content.size_px[1]}",
            "times": content.clock.source,
            "calibration": content.calibration.calibration_id() if content.calibration else None,
            "remarks": list(content.remarks),
        }
        emit_object(shown, chosen(style, as_json))
        return
    with session.progress("importing") as advance:
        summary = import_mcap(archive, content, advance)
    _show(summary, chosen(style, as_json))


@import_app.command(
    "video",
    epilog="Examples: turnscan import video turn.mkv --step-deg 0.9; "
    "turnscan import video turn.mkv --angles angles.csv --calibration cal.json",
)
def import_video_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Any video that FFmpeg reads.")],
    step_deg: StepOption = None,
    start_deg: StartOption = 0.0,
    angles: Annotated[
        Path | None,
        typer.Option(
            "--angles", metavar="F.csv", help="Columns frame, angle_deg [, t_ns, laser, laser_on]."
        ),
    ] = None,
    calibration: CalibrationFile = None,
    rig: RigOption = None,
    laser: LaserOption = 0,
    label: LabelOption = "",
    tag: TagOption = None,
    started_at: StartedOption = None,
    again: AgainOption = False,
    dry_run: DryRunOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Import a video of a turning table as one scan.

    Motion JPEG keeps its JPEG files; every other codec is decoded once and kept without further loss,
    grey where the video is grey. Frame times are the container's where they are sane.
    """
    if (step_deg is None) == (angles is None):
        raise UsageError("give either --step-deg or --angles", hint="angles are never guessed")
    from ..ingest.video_import import VideoPlan, import_video, read_content

    archive = open_archive()
    session = current_session()
    document = read_calibration_file(calibration) if calibration else None
    plan = VideoPlan(
        path=file,
        step_deg=step_deg,
        start_deg=start_deg,
        angles=angles,
        laser=laser,
        rig=rig or (document.rig if document else "unknown"),
        label=label,
        tags=parse_tags(tag),
        calibration=document,
        started_ns=parse_time(started_at, "--started-at"),
        again=again,
    )
    content = read_content(plan)
    for text in content.remarks:
        session.say(f"note: {text}")
    if dry_run:
        first, last = content.poses[0][1], content.poses[-1][1]
        session.say(
            f"would import {len(content.poses)} frames, {first.angle_deg:g} to {last.angle_deg:g} deg"
        )
        shown = {
            "frames": len(content.poses),
            "angle_from_deg": first.angle_deg,
            "angle_to_deg": last.angle_deg,
            "codec": content.facts.codec,
            "times": content.time_source,
            "remarks": list(content.remarks),
        }
        emit_object(shown, chosen(style, as_json))
        return
    with session.progress("importing") as advance:
        summary = import_video(archive, content, advance)
    _show(summary, chosen(style, as_json))
