"""``turnscan calibrate plane``: laser planes from stripes on boards."""

from __future__ import annotations

from fnmatch import fnmatch
from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import InputError, UsageError
from .calibrating_geometry import (
    CalibrationInOption,
    ChannelOption,
    ChannelWord,
    SeedOption,
    judged_fields,
    read_inputs,
    say_quality,
    used_inputs,
)
from .calibration_inputs import EveryOption, ImagesArgument, Picture, ScanOption
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
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit, emit_object
from .places import read_calibration_file

if TYPE_CHECKING:
    from ..process.calibrate.plane import PlaneFit
    from ..process.calibrate.plane_views import LaserFrame
    from ..schemas.calibration import Calibration
    from ..schemas.quality import Quality


def calibrate_plane_command(
    calibration: CalibrationInOption,
    images: ImagesArgument = None,
    pattern: PatternOption = None,
    square_mm: SquareOption = None,
    board: BoardKindOption = KindWord.chessboard,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = None,
    legacy: LegacyOption = False,
    scan: ScanOption = None,
    every: EveryOption = 1,
    off: Annotated[
        str | None,
        typer.Option("--off", metavar="PATTERN", help="Names of laser-off frames, one a lit one."),
    ] = None,
    laser: Annotated[
        list[int] | None,
        typer.Option(
            "--laser",
            min=0,
            max=255,
            help="Number of the laser; repeat for several in each frame, "
            "from left to right (top to bottom).",
        ),
    ] = None,
    horizontal: Annotated[
        bool, typer.Option("--horizontal", help="Stripes lie along the rows.")
    ] = False,
    grey: ChannelOption = ChannelWord.auto,
    out: OutOption = None,
    note: NoteOption = "",
    seed: SeedOption = 0,
    min_views: Annotated[int, typer.Option("--min-views", help="Gate: views used.")] = 5,
    max_rms_percent: Annotated[
        float, typer.Option("--max-rms-percent", help="Gate: rms distance, in % of the range.")
    ] = 0.3,
    max_sigma_percent: Annotated[
        float,
        typer.Option("--max-sigma-percent", help="Gate: sigma at the stripes, in % of the range."),
    ] = 0.5,
    min_tilt_deg: Annotated[
        float, typer.Option("--min-tilt-deg", help="Gate: largest angle between two boards.")
    ] = 5.0,
    min_agreeing: Annotated[
        float,
        typer.Option("--min-agreeing", help="Gate: share of views with lines that agree on the plane."),
    ] = 0.4,
    picture: PictureOption = None,
    observations: ObservationsOption = None,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Estimate laser planes from frames that show a board and the stripe.

    The stripe lies on the board, or beside it in the board's plane. What the stripe does elsewhere (the
    wall behind) does not enter: all views must agree on one plane. Frames that cannot be used are named
    with the reason. The plane's covariance carries corners, stripe and the camera's own covariance.
    """
    shape = parse_board(board, pattern, square_mm, marker_mm, dictionary, legacy=legacy)
    check_free(out, picture, observations, overwrite=overwrite)
    from ..process.calibrate.chained import chained
    from ..process.calibrate.geometry_quality import PlaneLimits, plane_quality
    from ..process.calibrate.plane import fit_planes
    from ..process.calibrate.plane_views import watch
    from ..schemas.quality import LeftOut, joined_quality, without_joint

    document = read_calibration_file(calibration)
    camera = document.intrinsics_or_fail()
    numbers = laser or [0]
    if len(set(numbers)) != len(numbers):
        raise UsageError(f"--laser: the same number stands twice in {numbers}")
    found, unused = read_inputs(images, scan, every)
    say_left_out(unused)
    frames = _paired(found, off)
    watched = watch(
        frames,
        shape,
        camera,
        channel=None if grey is ChannelWord.auto else grey.value,
        horizontal=horizontal,
        lasers=len(numbers),
        seed=seed,
    )
    unused += [LeftOut(what=a, why=b) for a, b in watched.left_out]
    say_left_out(unused[-len(watched.left_out) :] if watched.left_out else ())
    fits = fit_planes(watched.views, camera, lasers=len(numbers), seed=seed)
    limits = PlaneLimits(
        least_views=min_views,
        most_rms=max_rms_percent / 100.0,
        most_sigma=max_sigma_percent / 100.0,
        least_tilt_deg=min_tilt_deg,
        least_agreeing=min_agreeing,
    )
    inputs = used_inputs(found, {v.name for v in watched.views})
    judged = []
    for number, fit in zip(numbers, fits, strict=True):
        say_left_out([LeftOut(what=a, why=b) for a, b in fit.left_out])
        method = f"{shape.describe()}; {fit.used} views; stripe in {watched.channel}"
        judged.append(
            plane_quality(fit, number, limits, method=method, left_out=unused, inputs=inputs,
                          intrinsics_known=camera.covariance is not None)
        )  # fmt: skip
    followers = [fit.follower(number) for number, fit in zip(numbers, fits, strict=True)]
    result = chained(document, followers).model_copy(
        update={
            "quality": joined_quality(without_joint(document.quality), *judged),
            "note": note or document.note,
        }
    )
    _show_planes(fits, numbers, judged, result, chosen(style, as_json))
    if observations is not None and not dry_run:
        from ..process.calibrate.observed import one_observation, stripes_of

        boards = stripes_of(watched.views, fits, numbers)
        size = (camera.width_px, camera.height_px)
        write_observations(one_observation(size, boards=boards, inputs=inputs), observations)
    if picture is not None and not dry_run:
        from .geometry_picture import draw_planes

        draw_planes(fits, numbers, judged, picture)
    conclude(result, judged, None if dry_run else out)


def _paired(found: list[Picture], off: str | None) -> list[LaserFrame]:
    """Lit frames, each with its laser-off frame where ``off`` names them, in the same order."""
    from ..process.calibrate.plane_views import LaserFrame

    def is_off(p: Picture) -> bool:
        return off is not None and fnmatch(p.name.rpartition("/")[2], off)

    dark = [p for p in found if is_off(p)]
    lit = [p for p in found if not is_off(p)]
    if off is not None and len(dark) != len(lit):
        raise InputError(
            f"{len(dark)} laser-off frames fit {off!r}, beside {len(lit)} lit ones",
            hint="each lit frame needs its own laser-off frame of the same pose",
        )
    out = []
    for i, p in enumerate(lit):
        if p.image is None:
            continue
        other = dark[i].image if dark else None
        if dark and other is None:
            continue
        if other is not None and other.shape != p.image.shape:
            raise InputError(f"{p.name} and {dark[i].name} are not of one size and kind")
        out.append(LaserFrame(p.name, p.image, other))
    return out


def _show_planes(
    fits: list[PlaneFit], numbers: list[int], judged: list[Quality], result: Calibration, style: Format
) -> None:
    import numpy as np

    rows = []
    for number, fit in zip(numbers, fits, strict=True):
        sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
        values = (*fit.normal, fit.distance_mm)
        for name, value, s in zip(("nx", "ny", "nz", "distance_mm"), values, sigma, strict=True):
            rows.append({"laser": number, "parameter": name, "value": float(value), "sigma": float(s)})
    if style is not Format.json:
        emit(rows, ["laser", "parameter", "value", "sigma"], style)
        if style is Format.table:
            for fit, quality in zip(fits, judged, strict=True):
                say_quality(quality)
                for r in fit.residuals:
                    if r.used:
                        current_session().say(
                            f"  {r.name}: mean {r.mean_mm:+.2f} mm, rms {r.rms_mm:.2f} mm, "
                            f"{r.sigmas:.1f} sigma, {r.points} points"
                        )
        return
    shown = [
        {
            "laser": number,
            "normal": [float(a) for a in fit.normal],
            "distance_mm": fit.distance_mm,
            "covariance": fit.covariance.tolist(),
            "covariance_intrinsics_known": fit.conditional.tolist(),
            "rms_mm": fit.rms_mm,
            "unexplained_mm": fit.unexplained_mm,
            "spread_mm": list(fit.spread_mm),
            "views": [r.__dict__ for r in fit.residuals],
            **judged_fields(quality),
        }
        for number, fit, quality in zip(numbers, fits, judged, strict=True)
    ]
    emit_object({"calibration": result.calibration_id(), "planes": shown}, style)
