"""``turnscan calibrate axis``: the turntable's axis from a board or markers at several angles."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import InputError, UsageError
from .calibrating_geometry import (
    CalibrationInOption,
    ChannelOption,
    ChannelWord,
    SeedOption,
    used_inputs,
)
from .calibration_angles import check_angles, read_turned
from .calibration_axis_report import show_axis
from .calibration_inputs import EveryOption, ImagesArgument, ScanOption
from .calibration_observations import ObservationsOption, write_observations
from .calibration_output import (
    DryRunOption,
    NoteOption,
    OutOption,
    OverwriteOption,
    PictureOption,
    check_free,
    conclude,
    say_left_out,
)
from .calibration_words import (
    BoardKindOption,
    DictionaryOption,
    KindWord,
    LegacyOption,
    MarkerOption,
    PatternOption,
    SquareOption,
    parse_board,
)
from .output import Format, FormatOption, JsonOption, chosen, current_session
from .places import read_calibration_file

if TYPE_CHECKING:
    from ..process.calibrate.axis_result import AxisFit
    from ..process.calibrate.table_scale import TableScale
    from ..schemas.board import Board
    from ..schemas.calibration import Calibration


class HeadWord(StrEnum):
    """What turns."""

    fixed = "fixed"
    rotates = "rotates"


class ScaleWord(StrEnum):
    """Where the size of markers comes from."""

    auto = "auto"
    laser = "laser"
    markers = "markers"


def calibrate_axis_command(
    calibration: CalibrationInOption,
    images: ImagesArgument = None,
    scan: ScanOption = None,
    every: EveryOption = 1,
    step_deg: Annotated[
        float | None, typer.Option("--step-deg", help="Turn between two images, in degrees.")
    ] = None,
    start_deg: Annotated[float, typer.Option("--start-deg", help="Angle of the first.")] = 0.0,
    angles: Annotated[
        Path | None, typer.Option("--angles", metavar="F.csv", help="Columns file, angle_deg.")
    ] = None,
    head: Annotated[
        HeadWord, typer.Option("--head", help="fixed: the object turns; rotates: camera and laser.")
    ] = HeadWord.fixed,
    pattern: PatternOption = None,
    square_mm: SquareOption = None,
    board: BoardKindOption = KindWord.chessboard,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = None,
    legacy: LegacyOption = False,
    markers: Annotated[
        str | None,
        typer.Option(
            "--markers", metavar="NAME", help="Single ArUco markers of this dictionary, such as 4X4_50."
        ),
    ] = None,
    marker_side_mm: Annotated[
        float | None, typer.Option("--marker-side-mm", help="Side of a single marker.")
    ] = None,
    marker_id: Annotated[
        list[int] | None, typer.Option("--marker-id", help="Use these numbers only; may repeat.")
    ] = None,
    scale: Annotated[
        ScaleWord,
        typer.Option(
            "--scale", help="Size of markers: as the laser sees them where it can, or as stated."
        ),
    ] = ScaleWord.auto,
    grey: ChannelOption = ChannelWord.auto,
    angle_sd_deg: Annotated[
        float,
        typer.Option("--angle-sd-deg", min=0.0, help="How well the angles are known; 0: exactly."),
    ] = 0.5,
    out: OutOption = None,
    note: NoteOption = "",
    seed: SeedOption = 0,
    min_frames: Annotated[int, typer.Option("--min-frames", help="Gate: frames used.")] = 5,
    min_span_deg: Annotated[
        float, typer.Option("--min-span-deg", help="Gate: from the first to the last angle.")
    ] = 60.0,
    max_rms_px: Annotated[float, typer.Option("--max-rms-px", help="Gate: rms residual.")] = 1.0,
    max_wobble_deg: Annotated[
        float, typer.Option("--max-wobble-deg", help="Gate: tilt of single frames.")
    ] = 0.3,
    picture: PictureOption = None,
    observations: ObservationsOption = None,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Estimate the turntable's axis from a board or markers at several angles.

    With --scan the frames and their angles are those of a scan in the archive. Where the markers or the
    board stand on the table, and every angle, are estimated along with the axis; nominal angles
    are a prior of --angle-sd-deg. Which way the angle counts is found from the frames. If a laser's
    plane is known and its stripe crosses the markers, it says how large they really are.
    """
    check_free(out, picture, observations, overwrite=overwrite)
    check_angles(images, scan, step_deg, angles)
    shape = _axis_target(
        markers, marker_side_mm, board, pattern, square_mm, marker_mm, dictionary, legacy
    )
    from ..process.calibrate.axis import fit_axis
    from ..process.calibrate.axis_views import watch_board, watch_markers
    from ..process.calibrate.chained import chained
    from ..process.calibrate.geometry_quality import AxisLimits, axis_quality
    from ..schemas.quality import LeftOut, joined_quality, without_joint

    document = read_calibration_file(calibration)
    camera = document.intrinsics_or_fail()
    turned = read_turned(images, scan, every, step_deg=step_deg, start_deg=start_deg, table=angles)
    unused = list(turned.left_out)
    say_left_out(unused)
    pixels = [(p.name, p.image) for p in turned.pictures if p.image is not None]
    if shape is not None:
        watched = watch_board(pixels, shape, camera)
    else:
        assert markers is not None and marker_side_mm is not None
        name = markers.upper().removeprefix("DICT_")
        limited = set(marker_id) if marker_id else None
        watched = watch_markers(pixels, name, marker_side_mm, camera, numbers=limited)
    unused += [LeftOut(what=a, why=b) for a, b in watched.odd]
    say_left_out([LeftOut(what=a, why=b) for a, b in watched.odd])
    names = [n for n, _ in pixels]
    fit = fit_axis(
        watched.sightings,
        names,
        turned.angles_rad,
        camera,
        head=head.value,
        angle_sd_rad=math.radians(angle_sd_deg),
        seed=seed,
    )
    known = {o.what for o in unused}
    fresh = [LeftOut(what=a, why=b) for a, b in fit.left_out if a not in known]
    say_left_out(fresh)
    notes: list[str] = []
    sized = None
    if shape is None and scale is not ScaleWord.markers:
        sized = _sized(
            fit, dict(pixels), document, grey, required=scale is ScaleWord.laser, notes=notes
        )
        if sized is not None:
            fit = fit.scaled(sized.scale, sized.own_variance, sized.variance)
    target = (
        shape.describe() if shape else f"{len(watched.bodies)} markers {markers}, {marker_side_mm:g} mm"
    )
    limits = AxisLimits(
        least_frames=min_frames,
        least_span_deg=min_span_deg,
        most_rms_px=max_rms_px,
        most_wobble_deg=max_wobble_deg,
    )
    free = "angles exact" if angle_sd_deg == 0 else f"angles estimated, prior {angle_sd_deg:g} deg"
    method = f"{target}; {len(fit.frames)} frames; head {head.value}; {free}"
    used = {f.name for f in fit.frames}
    quality = axis_quality(
        fit,
        limits,
        method=method,
        scale=sized,
        left_out=unused,
        inputs=used_inputs(turned.pictures, used),
        notes=notes,
    )
    result = chained(document, [fit.follower()]).model_copy(
        update={
            "quality": joined_quality(without_joint(document.quality), quality),
            "note": note or document.note,
        }
    )
    show_axis(fit, sized, quality, result, chosen(style, as_json))
    if observations is not None and not dry_run:
        from ..process.calibrate.observed import one_observation, turning_of

        # With what the laser's plane leaves open: refine moves the plane, but not this size after it.
        size_sd = 0.0 if sized is None else math.sqrt(sized.variance) / sized.scale
        turning = turning_of(fit, math.radians(angle_sd_deg), size_sd)
        seen = one_observation(
            (camera.width_px, camera.height_px), turning=turning, inputs=quality.inputs
        )
        write_observations(seen, observations)
    if picture is not None and not dry_run:
        from .geometry_picture import draw_axis

        shown = dict(pixels).get(fit.frames[0].name)
        draw_axis(fit, quality, camera, shown, picture)
    conclude(result, (quality,), None if dry_run else out)


def _axis_target(
    markers: str | None,
    side_mm: float | None,
    board: KindWord,
    pattern: str | None,
    square_mm: str | None,
    marker_mm: float | None,
    dictionary: str | None,
    legacy: bool,
) -> Board | None:
    """The board that turns, or None for single markers."""
    if markers is None:
        if side_mm is not None:
            raise UsageError("--marker-side-mm goes with --markers", hint="such as --markers 4X4_50")
        return parse_board(board, pattern, square_mm, marker_mm, dictionary, legacy=legacy)
    if pattern is not None:
        raise UsageError("--markers and --pattern exclude each other", hint="give what is on the table")
    if side_mm is None or not (math.isfinite(side_mm) and side_mm > 0):
        raise UsageError("--markers needs --marker-side-mm", hint="the black square's side, in mm")
    return None


def _sized(
    fit: AxisFit,
    images: dict[str, Any],
    document: Calibration,
    grey: ChannelWord,
    *,
    required: bool,
    notes: list[str],
) -> TableScale | None:
    """How large the markers are by the laser; None (and why, in ``notes``) where it cannot say."""
    from ..process.calibrate.plane_views import CHANNELS
    from ..process.calibrate.table_scale import scale_from_frames

    if not document.lasers:
        why = "no laser's plane is known"
    else:
        channels = CHANNELS if grey is ChannelWord.auto else (grey.value,)
        frames = [images[f.name] for f in fit.frames]
        found = scale_from_frames(
            fit, frames, document.intrinsics_or_fail(), document.lasers[0], channels
        )
        if found is not None:
            if found.sigmas_from_one > 3.0:
                current_session().say(
                    f"the laser finds the markers {found.scale:.4f} times as large as stated, "
                    f"{found.sigmas_from_one:.0f} sigma from 1: the axis follows the laser (--scale)"
                )
            return found
        why = "no stripe crosses the markers in three frames or more"
    if required:
        raise InputError(
            f"the size of the markers cannot be taken from the laser: {why}",
            hint="--scale markers takes it as stated",
        )
    notes.append(f"the markers' size is taken as stated ({why}): its error is the axis' error")
    return None
