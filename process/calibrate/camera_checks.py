"""What views must be before a camera can be estimated from them: enough, of one size, and tilted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from ...schemas.calibration import Intrinsics
from ...schemas.errors import CalibrationError, InputError
from ...schemas.quality import LeftOut
from .boards import BoardView
from .pose import board_poses

Floats = npt.NDArray[np.float64]

FEWEST_VIEWS = 3
_NO_BOARD = Board(cols=3, rows=3, square_x_mm=1.0, square_y_mm=1.0)
#: Views whose normals differ by less are parallel: f and distance cannot be told apart.
PARALLEL_DEG = 3.0


def check_enough(views: Sequence[BoardView], left_out: Sequence[LeftOut], board: Board) -> None:
    """Refuse fewer than three views, with the reason for which most were left out.

    Raises
    ------
    InputError
        There are fewer than three views.
    """
    if len(views) >= FEWEST_VIEWS:
        return
    text = f"{len(views)} views of the board are too few: {FEWEST_VIEWS} are needed, better ten or more"
    if left_out:
        (why, count), *_ = Counter(item.why for item in left_out).most_common(1)
        text += f"; of {len(views) + len(left_out)} images, {count} fail because: {why}"
    hint = (
        f"add images, and check --pattern: {board.describe()} was said; it counts inner corners of a "
        "chessboard, one less than squares"
    )
    raise InputError(text, hint=hint)


def check_views(views: Sequence[BoardView], left_out: Sequence[LeftOut] = ()) -> None:
    """Refuse too few views, and views of several image sizes.

    Raises
    ------
    InputError
        There are fewer than three views, or they are of different sizes.
    """
    check_enough(views, left_out, views[0].board if views else _NO_BOARD)
    sizes = Counter((v.width_px, v.height_px) for v in views)
    if len(sizes) > 1:
        (usual, _), *others = sizes.most_common()
        odd = [v.name for v in views if (v.width_px, v.height_px) != usual]
        shown = ", ".join(f"{w} x {h} px ({n})" for (w, h), n in sizes.most_common())
        raise InputError(
            f"images of {len(others) + 1} sizes: {shown}; of another size than most: "
            f"{', '.join(odd[:3])}{' ...' if len(odd) > 3 else ''}",
            hint="a calibration is true of one image size; calibrate each by itself",
        )


def explain_parallel(views: Sequence[BoardView], error: CalibrationError) -> None:
    """Say so if no camera was found because all views are parallel; a rough one shows how they stand.

    Raises
    ------
    CalibrationError
        They are parallel.
    """
    first = views[0]
    rough = Intrinsics(
        width_px=first.width_px,
        height_px=first.height_px,
        fx_px=1.2 * first.width_px,
        fy_px=1.2 * first.width_px,
        cx_px=0.5 * (first.width_px - 1),
        cy_px=0.5 * (first.height_px - 1),
    )
    try:
        poses = [board_poses(v.points_px, v.points_mm, rough)[0] for v in views]
    except InputError:
        return
    spread = largest_angle_deg(np.array([p.rotation for p in poses]))
    # What a lens bends looks like a tilt of some degrees.
    if spread < 2.0 * PARALLEL_DEG:
        raise CalibrationError(
            f"all {len(views)} views are parallel (within {spread:.1f} degrees): focal length and "
            "distance cannot be told apart, and no focal length fits better than another; every 1 % of "
            "it is 10 mm at 1 m",
            hint="tilt the board by 20 to 45 degrees, in several directions",
        ) from error


def largest_angle_deg(rotations: Floats) -> float:
    """Largest angle between the normals of any two views, degrees."""
    normals = rotations[:, :, 2]
    cosine = np.clip(normals @ normals.T, -1.0, 1.0)
    return float(np.rad2deg(np.arccos(cosine.min())))
