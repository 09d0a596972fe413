"""Acceptance limits of a camera calibration, and what a reader should know besides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.quality import EstimationInput, Gate, LeftOut, Quality
from .boards import WINDOW_SHARE, BoardView
from .camera import CameraEstimate
from .camera_checks import largest_angle_deg
from .covariance import ray_sigma_mm_per_m

#: Cells of the image that coverage is counted in.
COVERAGE_CELLS = (8, 6)


@dataclass(frozen=True)
class CameraLimits:
    """Limits of the gates; the defaults suit ten views of a board that fills a third of the image."""

    least_views: int = 5
    most_rms_px: float = 0.5
    least_coverage: float = 0.4
    least_spread_deg: float = 15.0
    most_condition: float = 300.0
    most_focal_sigma_percent: float = 2.0


def coverage_cells(views: Sequence[BoardView]) -> npt.NDArray[np.int64]:
    """Corners in each cell of the image, (rows, cols) of :data:`COVERAGE_CELLS`."""
    columns, rows = COVERAGE_CELLS
    points = np.concatenate([v.points_px for v in views])
    first = views[0]
    counts, _, _ = np.histogram2d(
        points[:, 1],
        points[:, 0],
        bins=(rows, columns),
        range=((-0.5, first.height_px - 0.5), (-0.5, first.width_px - 0.5)),
    )
    return counts.astype(np.int64)


def coverage(views: Sequence[BoardView]) -> float:
    """Share of the image's cells in which a corner was seen."""
    return float((coverage_cells(views) > 0).mean())


def camera_quality(
    estimate: CameraEstimate,
    limits: CameraLimits,
    *,
    left_out: Sequence[LeftOut] = (),
    inputs: Sequence[EstimationInput] = (),
) -> Quality:
    """Gates, what was left out (``left_out`` before the solution, then during it), and notes."""
    views, bundle, known = estimate.views, estimate.bundle, estimate.uncertainty
    sigmas, values = estimate.sigmas(), estimate.parameters()
    focal = max(sigmas[n] / values[n] for n in ("fx_px", "fy_px"))
    gates = (
        Gate.at_least("views", len(views), limits.least_views),
        Gate.at_most("rms", bundle.rms_px(), limits.most_rms_px, "px"),
        Gate.at_least("coverage", coverage(views), limits.least_coverage),
        Gate.at_least(
            "view spread", largest_angle_deg(bundle.rotations), limits.least_spread_deg, "deg"
        ),
        Gate.at_most("condition", known.condition, limits.most_condition),
        Gate.at_most("focal sigma", 100.0 * focal, limits.most_focal_sigma_percent, "%"),
    )
    board = views[0].board
    estimated = "free" if not estimate.fixed else f"{', '.join(estimate.fixed)} held"
    return Quality(
        part="intrinsics",
        method=f"{board.describe()}; {len(views)} views; {estimated}; {estimate.weighting} weights",
        gates=gates,
        left_out=(*left_out, *estimate.left_out),
        notes=tuple(_notes(estimate)),
        inputs=tuple(inputs),
    )


def _notes(estimate: CameraEstimate) -> list[str]:
    known, values = estimate.uncertainty, estimate.parameters()
    notes = [f"noise of a corner {known.noise_px:.3f} px (1 sigma of u and of v)"]
    if known.birge > 1.0:
        notes.append(
            "the views disagree by more than this noise explains: all sigmas were enlarged "
            f"{known.birge:.2f} times (bent board, blur, or a lens that the model does not fit)"
        )
    size = (estimate.intrinsics.width_px, estimate.intrinsics.height_px)
    usual, worst = ray_sigma_mm_per_m(estimate.bundle.camera, known.covariance, size)
    notes.append(
        f"rays are uncertain by {usual:.2f} mm at 1 m (1 sigma, rms over the image), {worst:.2f} mm "
        "in the worst corner, a turn of all rays taken out"
    )
    wide = [v for v in estimate.views if v.window_px > max(2.0, WINDOW_SHARE * v.square_px) + 1]
    if wide:
        share = max(v.window_px / v.square_px for v in wide)
        f = values["fx_px"]
        notes.append(
            f"corner window too large in {len(wide)} views (up to {share:.2f} of a square, more than "
            f"{WINDOW_SHARE:g}): such windows have biased f by 0.6 %, that is {0.006 * f:.1f} px and "
            "6 mm at 1 m"
        )
    return notes
