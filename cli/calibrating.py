"""``turnscan calibrate``: estimate the parts of a calibration, each with covariance and gates."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .calibration_import import import_camera
from .calibration_inputs import (
    EveryOption,
    ImagesArgument,
    Picture,
    ScanOption,
    pictures,
    side_by_side,
)
from .calibration_observations import ObservationsOption, write_observations
from .calibration_output import (
    DryRunOption,
    NoteOption,
    OutOption,
    OverwriteOption,
    PictureOption,
    RigOption,
    check_free,
    conclude,
    say_left_out,
)
from .calibration_report import show_camera, write_corners
from .calibration_words import (
    BoardKindOption,
    CornerWindowOption,
    DetectorOption,
    DetectorWord,
    DictionaryOption,
    KindWord,
    LegacyOption,
    MarkerOption,
    PatternOption,
    SquareOption,
    parse_board,
)
from .output import Format, FormatOption, JsonOption, chosen, current_session

if TYPE_CHECKING:
    from ..process.calibrate.boards import BoardView
    from ..process.calibrate.start import Fix
    from ..schemas.board import Board
    from ..schemas.quality import EstimationInput, LeftOut

calibrate_app = typer.Typer(
    no_args_is_help=True,
    help="Estimate camera, laser planes and axis, each with covariance and acceptance limits.",
    epilog="Example: turnscan calibrate camera boards --pattern 9x6 --square-mm 30 -o cal.json",
)


calibrate_app.command(
    "import",
    epilog="Examples: turnscan calibrate import Calib_Results.mat -o cal.json; "
    "turnscan calibrate import camera.yaml --size-px 640x480 --rig desk -o cal.json",
)(import_camera)


class FixWord(StrEnum):
    """What may be held instead of estimated."""

    aspect = "aspect"
    principal_point = "principal-point"
    k1 = "k1"
    k2 = "k2"
    k3 = "k3"
    tangential = "tangential"


class WeightsWord(StrEnum):
    """How views count."""

    equal = "equal"
    by_view = "by-view"


@calibrate_app.callback()
def _group() -> None:
    """Estimate camera, laser planes and axis, each with covariance and acceptance limits."""


@calibrate_app.command(
    "camera",
    epilog="Examples: turnscan calibrate camera boards --pattern 9x6 --square-mm 30 -o cal.json; "
    "turnscan calibrate camera boards --board charuco --pattern 7x5 --square-mm 30 --marker-mm 22 "
    "--dictionary 5X5_100 --skew -o cal.json --picture cal.png; "
    "turnscan calibrate camera --scan latest --every 5 --pattern 9x6 --square-mm 30x29.8 --json",
)
def calibrate_camera_command(
    images: ImagesArgument = None,
    pattern: PatternOption = None,
    square_mm: SquareOption = None,
    board: BoardKindOption = KindWord.chessboard,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = None,
    legacy: LegacyOption = False,
    scan: ScanOption = None,
    every: EveryOption = 1,
    out: OutOption = None,
    rig: RigOption = "unknown",
    note: NoteOption = "",
    skew: Annotated[bool, typer.Option("--skew", help="Estimate skew, too.")] = False,
    fix: Annotated[
        list[FixWord] | None,
        typer.Option("--fix", help="Hold: aspect fx = fy, the middle, or 0; may repeat."),
    ] = None,
    weights: Annotated[
        WeightsWord, typer.Option("--weights", help="Views count equally, or by their own noise.")
    ] = WeightsWord.equal,
    corner_window: CornerWindowOption = None,
    detector: DetectorOption = DetectorWord.auto,
    keep_all_views: Annotated[
        bool, typer.Option("--keep-all-views", help="Leave out no view that has a board.")
    ] = False,
    max_rms_px: Annotated[float, typer.Option("--max-rms-px", help="Gate: rms residual.")] = 0.5,
    min_views: Annotated[int, typer.Option("--min-views", help="Gate: views used.")] = 5,
    min_coverage: Annotated[
        float, typer.Option("--min-coverage", help="Gate: share of 8x6 image cells with a corner.")
    ] = 0.4,
    min_spread_deg: Annotated[
        float, typer.Option("--min-spread-deg", help="Gate: largest angle between two boards.")
    ] = 15.0,
    max_condition: Annotated[
        float, typer.Option("--max-condition", help="Gate: condition of the scaled unknowns.")
    ] = 300.0,
    max_focal_sigma: Annotated[
        float, typer.Option("--max-focal-sigma", metavar="PERCENT", help="Gate: 1 sigma of f.")
    ] = 2.0,
    picture: PictureOption = None,
    corners: Annotated[
        Path | None,
        typer.Option("--corners", metavar="FILE.csv", help="Write every corner and its residual."),
    ] = None,
    observations: ObservationsOption = None,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Estimate camera intrinsics from images of a board.

    Gives fx, fy, cx, cy, skew and five distortion coefficients with 1 sigma and full covariance, the
    residuals of every view, and the views that were left out, with the reason. A calibration that
    misses an acceptance limit (gate) is written as failed, and the command exits with 1.
    """
    shape = parse_board(board, pattern, square_mm, marker_mm, dictionary, legacy=legacy)
    check_free(out, picture, corners, observations, overwrite=overwrite)
    from ..process.calibrate.camera import calibrate_camera
    from ..process.calibrate.camera_checks import check_enough
    from ..process.calibrate.camera_quality import CameraLimits, camera_quality
    from ..schemas.calibration import Calibration

    views, inputs, unused = _views(
        images, scan, every, shape, corner_window, detector, keep_all=keep_all_views
    )
    say_left_out(unused)
    check_enough(views, unused, shape)
    estimate = calibrate_camera(
        views, fix=fixed_words(fix, skew=skew), weighting=weights.value, keep_all=keep_all_views
    )
    say_left_out(estimate.left_out)
    used = {v.name for v in estimate.views}
    limits = CameraLimits(
        least_views=min_views,
        most_rms_px=max_rms_px,
        least_coverage=min_coverage,
        least_spread_deg=min_spread_deg,
        most_condition=max_condition,
        most_focal_sigma_percent=max_focal_sigma,
    )
    quality = camera_quality(
        estimate, limits, left_out=unused, inputs=[i for i in inputs if i.name in used]
    )
    calibration = Calibration(rig=rig, note=note, camera=estimate.intrinsics, quality=(quality,))
    show_camera(estimate, quality, calibration.calibration_id(), chosen(style, as_json))
    if not dry_run and corners is not None:
        write_corners(estimate, corners)
    if not dry_run and observations is not None:
        from ..process.calibrate.observed import boards_of, one_observation

        size = (estimate.intrinsics.width_px, estimate.intrinsics.height_px)
        boards = boards_of(estimate.views)
        write_observations(one_observation(size, boards=boards, inputs=quality.inputs), observations)
    if not dry_run and picture is not None:
        from .calibration_picture import draw_camera

        draw_camera(estimate, quality, picture)
    conclude(calibration, (quality,), None if dry_run else out)


def _views(
    images: list[str] | None,
    scans: list[str] | None,
    every: int,
    board: Board,
    window_px: int | None,
    detector: DetectorWord,
    *,
    keep_all: bool,
) -> tuple[list[BoardView], list[EstimationInput], list[LeftOut]]:
    """The boards of all pictures, what they came from, and the pictures without one."""
    from ..process.calibrate.boards import NoBoard, find_board
    from ..schemas.quality import EstimationInput, LeftOut

    def look(picture: Picture) -> BoardView | NoBoard:
        if picture.image is None:
            return NoBoard(picture.name, "none", picture.problem)
        return find_board(
            picture.image,
            board,
            name=picture.name,
            window_px=window_px,
            detector=detector.value,
            strict=not keep_all,
        )

    views: list[BoardView] = []
    inputs: list[EstimationInput] = []
    unused: list[LeftOut] = []
    with current_session().progress("looking for boards") as advance:
        for picture, found in side_by_side(look, pictures(images, scans, every)):
            if isinstance(found, NoBoard):
                unused.append(LeftOut(what=found.name, why=found.reason))
            else:
                views.append(found)
                inputs.append(EstimationInput(name=picture.name, sha256=picture.sha256))
            advance(len(views) + len(unused), len(views) + len(unused))
    return views, inputs, unused


def fixed_words(words: list[FixWord] | None, *, skew: bool) -> list[Fix]:
    """What the words hold, in the names of the solver; skew is held unless it is asked for."""
    from ..process.calibrate.camera import FIXABLE

    fixed: list[Fix] = [] if skew else ["skew"]
    for word in words or ():
        if word is FixWord.tangential:
            fixed += ["p1", "p2"]
        else:
            fixed += [f for f in FIXABLE if f == word.value]
    return fixed
