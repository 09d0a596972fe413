"""From frames to what the plane's fit needs: board pose and straight stripes of each frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from ...schemas.calibration import Intrinsics
from ...schemas.errors import CalibrationError, InputError
from ...schemas.recipe import Grey
from ..grey import to_grey
from .boards import NoBoard, find_board
from .plane import PlaneFit, fit_planes
from .plane_consensus import LEAST_VIEWS, PlaneView
from .pose import board_poses
from .stripe_lines import find_stripe_lines

#: Channels that a stripe is looked for in, when none is named.
CHANNELS = ("green", "red", "luma", "blue")
_TRIAL_VIEWS = 10


@dataclass(frozen=True)
class LaserFrame:
    """A frame with the laser on, as the camera gave it, and one of the same pose with it off."""

    name: str
    image: npt.NDArray[Any]
    off: npt.NDArray[Any] | None = None


@dataclass(frozen=True)
class Watched:
    """The views that can be used, those that cannot with the reason, and the channel chosen."""

    views: tuple[PlaneView, ...]
    left_out: tuple[tuple[str, str], ...]
    channel: str


def check_size(name: str, image: npt.NDArray[Any], camera: Intrinsics) -> None:
    """Refuse a frame of another size than the camera's calibration is for."""
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"{name} is {image.shape[1]} x {image.shape[0]} px, the camera's calibration is for "
            f"{camera.width_px} x {camera.height_px} px",
            hint="use the calibration of this camera at this resolution",
        )


def watch(
    frames: Iterable[LaserFrame],
    board: Board,
    camera: Intrinsics,
    *,
    channel: str | None = None,
    horizontal: bool = False,
    lasers: int = 1,
    seed: int = 0,
) -> Watched:
    """Board and stripes of every frame; one without a board is left out with the reason, never fatal.

    ``channel`` is a mode of the recipe's grey stage; None chooses the one in which most views agree on
    a plane, and agree best.

    Raises
    ------
    CalibrationError
        A frame has another size than the camera, or no frame shows the board.
    """
    seen: list[tuple[LaserFrame, PlaneView]] = []
    left: list[tuple[str, str]] = []
    for frame in frames:
        check_size(frame.name, frame.image, camera)
        found = find_board(frame.image if frame.off is None else frame.off, board, name=frame.name)
        if isinstance(found, NoBoard):
            left.append((frame.name, found.reason))
            continue
        try:
            pose = board_poses(found.points_px, found.points_mm, camera)[0]
        except InputError as error:
            left.append((frame.name, str(error)))
            continue
        seen.append((frame, PlaneView(frame.name, pose, found.points_px, found.points_mm, ())))
    if not seen:
        raise CalibrationError(
            f"the board ({board.describe()}) was found in none of {len(left)} frames: "
            + (left[0][1] if left else "there are no frames"),
            hint="count the inner corners, columns x rows, and look at what the frames show",
        )
    if channel is None:
        colour = any(f.image.ndim == 3 for f, _ in seen)
        channel = _best_channel(seen, camera, horizontal, lasers, seed) if colour else "luma"
    views = [_with_lines(f, v, channel, camera, horizontal, lasers, seed) for f, v in seen]
    return Watched(tuple(views), tuple(left), channel)


def _with_lines(
    frame: LaserFrame,
    view: PlaneView,
    channel: str,
    camera: Intrinsics,
    horizontal: bool,
    lasers: int,
    seed: int,
) -> PlaneView:
    mode: Any = channel
    grey = Grey(mode=mode)
    off = None if frame.off is None else to_grey(frame.off, grey)
    lines = find_stripe_lines(
        to_grey(frame.image, grey),
        camera,
        background=off,
        horizontal=horizontal,
        most=lasers + 3,
        seed=seed,
    )
    return PlaneView(view.name, view.pose, view.corners_px, view.board_mm, lines)


def _best_channel(
    seen: Sequence[tuple[LaserFrame, PlaneView]],
    camera: Intrinsics,
    horizontal: bool,
    lasers: int,
    seed: int,
) -> str:
    """The channel in which most of some views agree; of equals the one with the smallest misfit."""
    pick = np.unique(np.linspace(0, len(seen) - 1, max(_TRIAL_VIEWS, LEAST_VIEWS)).astype(int))
    best: tuple[float, str] | None = None
    for channel in CHANNELS:
        views = [
            _with_lines(seen[i][0], seen[i][1], channel, camera, horizontal, lasers, seed) for i in pick
        ]
        try:
            fits = fit_planes(views, camera, lasers=lasers, seed=seed)
        except CalibrationError:
            continue
        score = sum(fit.used - 0.2 * fit.rms_mm / max(1e-9, _typical(fit)) for fit in fits)
        if best is None or score > best[0] + 0.25:
            best = (score, channel)
    return "luma" if best is None else best[1]


def _typical(fit: PlaneFit) -> float:
    """A thousandth of the range."""
    return 1e-3 * float(np.median(np.linalg.norm(fit.points_mm, axis=1)))
