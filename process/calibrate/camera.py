"""Camera intrinsics from views of a board: ten parameters, their covariance, and what was left out.

Model and parameter order: ``projection.NAMES``. The start is OpenCV's (Zhang 2000); the solution is
our own least squares, because OpenCV has no skew. Every corner counts the same unless told otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ...schemas.errors import CalibrationError
from ...schemas.quality import LeftOut
from .boards import BoardView
from .bundle import Bundle, solve_bundle
from .camera_checks import (
    FEWEST_VIEWS,
    PARALLEL_DEG,
    check_views,
    explain_parallel,
    largest_angle_deg,
)
from .covariance import Uncertainty, uncertainty_of
from .projection import NAMES
from .start import Fix, start_camera
from .suspects import blurred_views, contradiction, drop_corners, flipped_view, suspect_views

Floats = npt.NDArray[np.float64]

#: What may be held: fx = fy, the principal point in the middle, the rest at zero.
FIXABLE: tuple[Fix, ...] = ("skew", "aspect", "principal-point", "k1", "k2", "p1", "p2", "k3")
#: Where more than this share of the views contradict the rest, nobody knows who is right.
_MOST_LEFT_OUT = 1 / 3


@dataclass(frozen=True)
class CameraEstimate:
    """Intrinsics with covariance, the views that were used with their residuals, and those left out.

    ``bundle.residuals_px[i]`` (N, 2) belongs to ``views[i]``, seen minus projected.
    """

    intrinsics: Intrinsics
    views: tuple[BoardView, ...]
    bundle: Bundle
    uncertainty: Uncertainty
    fixed: tuple[Fix, ...]
    weighting: str
    left_out: tuple[LeftOut, ...] = ()

    def parameters(self) -> dict[str, float]:
        """Parameter name -> value."""
        return dict(zip(NAMES, map(float, self.bundle.camera), strict=True))

    def sigmas(self) -> dict[str, float]:
        """Parameter name -> 1 sigma; 0 for what was held."""
        diagonal = np.sqrt(np.diag(self.uncertainty.covariance))
        return dict(zip(NAMES, map(float, diagonal), strict=True))


def calibrate_camera(
    views: Sequence[BoardView],
    *,
    fix: Sequence[Fix] = ("skew",),
    weighting: Literal["equal", "by-view"] = "equal",
    keep_all: bool = False,
) -> CameraEstimate:
    """Intrinsics of the camera that took ``views``.

    ``fix`` names what is held (:data:`FIXABLE`). ``weighting`` ``by-view`` gives each view the
    weight of its own noise. Unless ``keep_all``, corners and views whose residuals contradict the
    rest are left out, worst first, and solved again.

    Raises
    ------
    InputError
        Fewer than three views, or views of different image sizes.
    CalibrationError
        The views do not fix the parameters (all parallel), or the board is not as said.
    """
    views = list(views)
    check_views(views)
    left_out: list[LeftOut] = []
    if not keep_all:
        blurred = dict(blurred_views(views))
        left_out = [LeftOut(what=views[i].name, why=why) for i, why in blurred.items()]
        views = [v for i, v in enumerate(views) if i not in blurred]
        check_views(views, left_out)
    try:
        bundle = _solved(views, fix)
    except CalibrationError as error:
        explain_parallel(views, error)
        raise
    _check_board(views, bundle, fix)
    if not keep_all:
        views, bundle, more = _without_suspects(views, bundle, fix)
        left_out += more
    if weighting == "by-view":
        bundle = _weighted(views, bundle)
    uncertainty = uncertainty_of(bundle)
    spread = largest_angle_deg(bundle.rotations)
    if spread < PARALLEL_DEG:
        share = uncertainty.covariance[0, 0] ** 0.5 / bundle.camera[0]
        raise CalibrationError(
            f"all {len(views)} views are parallel (within {spread:.1f} degrees): focal length and "
            f"distance cannot be told apart; f would be uncertain by {100 * share:.2g} %, which is "
            f"{1000 * share:.3g} mm at 1 m, and worse by all that the lens model absorbs",
            hint="tilt the board by 20 to 45 degrees, in several directions",
        )
    first = views[0]
    values = [float(v) for v in bundle.camera]
    intrinsics = Intrinsics(
        width_px=first.width_px,
        height_px=first.height_px,
        fx_px=values[0],
        fy_px=values[1],
        cx_px=values[2],
        cy_px=values[3],
        skew=values[4],
        distortion=(values[5], values[6], values[7], values[8], values[9]),
        covariance=tuple(tuple(map(float, row)) for row in uncertainty.covariance),
    )
    return CameraEstimate(
        intrinsics=intrinsics,
        views=tuple(views),
        bundle=bundle,
        uncertainty=uncertainty,
        fixed=tuple(f for f in FIXABLE if f in fix),
        weighting=weighting,
        left_out=tuple(left_out),
    )


def free_directions(fix: Sequence[Fix]) -> Floats:
    """(10, m): how the m unknowns move the ten parameters."""
    columns = np.eye(10)
    drop = {NAMES.index(f) for f in fix if f in NAMES}
    if "principal-point" in fix:
        drop |= {2, 3}
    if "aspect" in fix:
        columns[1, 0] = 1.0
        drop.add(1)
    return columns[:, [i for i in range(10) if i not in drop]]


def _solved(views: Sequence[BoardView], fix: Sequence[Fix]) -> Bundle:
    camera, rotations, shifts = start_camera(views, fix)
    return solve_bundle(views, camera, rotations, shifts, free_directions(fix))


def _check_board(views: Sequence[BoardView], bundle: Bundle, fix: Sequence[Fix]) -> None:
    """Cells that are not square say whether their two sides were exchanged."""
    board = views[0].board
    if board.square_x_mm == board.square_y_mm:
        return
    ratio = board.square_y_mm / board.square_x_mm
    exchanged = [replace(v, points_mm=v.points_mm * (ratio, 1.0 / ratio, 1.0)) for v in views]
    try:
        other = _solved(exchanged, fix).rms_px()
    except CalibrationError:
        return
    if other < 0.5 * bundle.rms_px():
        off = abs(ratio - 1.0)
        raise CalibrationError(
            f"the board's cells seem to be {board.square_y_mm:g} mm wide and {board.square_x_mm:g} mm "
            f"high, not the other way round: rms {other:.2f} px, not {bundle.rms_px():.2f} px; as "
            f"said, lengths on it are wrong by {100 * off:.2g} %, {1000 * off:.3g} mm in 1 m",
            hint="exchange columns and rows in --pattern, or the two sides in --square-mm",
        )


def _without_suspects(
    views: list[BoardView], bundle: Bundle, fix: Sequence[Fix]
) -> tuple[list[BoardView], Bundle, list[LeftOut]]:
    left_out: list[LeftOut] = []
    most = int(_MOST_LEFT_OUT * len(views))
    while True:
        many = len(views) > FEWEST_VIEWS
        # A view the wrong way round first: it is told by what would mend it, not by how far it is off.
        flipped = flipped_view(views, bundle) if many else None
        if flipped is not None:
            at, why = flipped.view, flipped.sentence()
            better = _again(views[:at] + views[at + 1 :], bundle, fix, without=at)
        else:
            views, dropped = drop_corners(views, bundle)
            left_out += dropped
            if dropped:
                bundle = _again(views, bundle, fix)
            suspects = suspect_views(bundle) if many else []
            if not suspects:
                if not dropped:
                    return views, bundle, left_out
                continue
            tries = {i: _again(views[:i] + views[i + 1 :], bundle, fix, without=i) for i in suspects}
            at = min(tries, key=lambda i: tries[i].rms_px())
            better, why = tries[at], contradiction(views[at], tries[at])
        if sum(" corner" not in item.what for item in left_out) >= most:
            raise CalibrationError(
                f"more than {most} views contradict the others, {views[at].name} next: {why}",
                hint="look at the picture with --keep-all-views; is it one camera and one board?",
            )
        left_out.append(LeftOut(what=views[at].name, why=why))
        views, bundle = views[:at] + views[at + 1 :], better


def _again(
    views: Sequence[BoardView], bundle: Bundle, fix: Sequence[Fix], *, without: int | None = None
) -> Bundle:
    """The solution of ``views`` from that of the same views before one was left out."""
    rotations, shifts = bundle.rotations, bundle.shifts_mm
    if without is not None:
        rotations, shifts = np.delete(rotations, without, axis=0), np.delete(shifts, without, axis=0)
    return solve_bundle(views, bundle.camera, rotations, shifts, free_directions(fix))


def _weighted(views: Sequence[BoardView], bundle: Bundle) -> Bundle:
    """Each view weighted by its own noise, drawn towards that of all by as much as ten corners."""
    for _ in range(3):
        noise = bundle.noise_px() ** 2
        own = np.array([(r * r).sum() for r in bundle.residuals_px])
        count = np.array([r.size - 6 for r in bundle.residuals_px])
        variance = (own + 20 * noise) / (count + 20)
        weights = variance.mean() / variance
        bundle = solve_bundle(
            views, bundle.camera, bundle.rotations, bundle.shifts_mm, bundle.free, weights
        )
    return bundle
