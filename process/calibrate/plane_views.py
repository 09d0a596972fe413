"""From frames to what the plane's fit needs: board pose and straight stripes of each frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from ...schemas.calibration import Intrinsics
from ...schemas.errors import CalibrationError, InputError
from ...schemas.recipe import Grey
from ..grey import to_grey
from .board_print import whitened
from .boards import BoardView, NoBoard, find_board
from .plane import PlaneFit, fit_planes
from .plane_consensus import LEAST_VIEWS, PlaneView
from .pose import BoardPose, board_poses
from .stripe_lines import StripeLine, find_stripe_lines

#: Channels that a stripe is looked for in, when none is named.
CHANNELS = ("green", "red", "luma", "blue")
_TRIAL_VIEWS = 10
#: Half of a stripe, beyond the window that a corner was refined in.
_STRIPE_REACH_PX = 4
_LEAST_CORNERS, _LEAST_SHARE = 12, 0.5


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
    seen: list[_Seen] = []
    left: list[tuple[str, str]] = []
    for frame in frames:
        check_size(frame.name, frame.image, camera)
        found = find_board(frame.image if frame.off is None else frame.off, board, name=frame.name)
        if isinstance(found, NoBoard) and found.cause == "grid" and frame.off is None:
            found = _beside_stripes(frame, board, camera, found, horizontal, lasers, seed)
        if isinstance(found, NoBoard):
            left.append((frame.name, found.reason))
            continue
        try:
            pose = board_poses(found.points_px, found.points_mm, camera)[0]
        except InputError as error:
            left.append((frame.name, str(error)))
            continue
        seen.append(_Seen(frame, found, pose))
    if not seen:
        raise CalibrationError(
            f"the board ({board.describe()}) was found in none of {len(left)} frames: "
            + (left[0][1] if left else "there are no frames"),
            hint="count the inner corners, columns x rows, and look at what the frames show",
        )
    if channel is None:
        colour = any(s.frame.image.ndim == 3 for s in seen)
        channel = _best_channel(seen, camera, horizontal, lasers, seed) if colour else "luma"
    views = [_with_lines(s, channel, camera, horizontal, lasers, seed) for s in seen]
    return Watched(tuple(views), tuple(left), channel)


def _beside_stripes(
    frame: LaserFrame,
    board: Board,
    camera: Intrinsics,
    refused: NoBoard,
    horizontal: bool,
    lasers: int,
    seed: int,
) -> BoardView | NoBoard:
    """The board by the corners that no bright stripe reaches; or ``refused``, if those hold no better.

    A stripe along a column of corners pulls all of them, and the whole grid is refused for it.
    """
    grey = to_grey(frame.image, Grey(mode="luma"))
    lines = find_stripe_lines(grey, camera, horizontal=horizontal, most=lasers + 3, seed=seed)
    best: BoardView | None = None
    # Several lasers cross a board at once; of other sets of lines those of the print would hide most.
    for count in range(1, lasers + 1):
        for chosen in combinations(lines, count):
            hidden = np.logical_or.reduce([_lit(line, grey.shape) for line in chosen])
            found = find_board(frame.image, board, name=frame.name, hidden=hidden)
            if isinstance(found, BoardView) and (
                best is None or found.irregular_px < best.irregular_px
            ):
                best = found
    return refused if best is None else best


def _lit(line: StripeLine, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """The pixels (H, W) within a stripe's reach of its course, over the whole image."""
    across, along = (line.v_px, line.u_px) if line.along_v else (line.u_px, line.v_px)
    count, width = (shape[1], shape[0]) if line.along_v else (shape[0], shape[1])
    # Lenses bend it a little.
    course = np.polyval(np.polyfit(along, across, 2), np.arange(count))
    near = np.abs(np.arange(width) - course[:, None]) <= _STRIPE_REACH_PX
    return np.asarray(near.T if line.along_v else near, np.bool_)


@dataclass(frozen=True)
class _Seen:
    """A frame in which the board was found, and its pose."""

    frame: LaserFrame
    found: BoardView
    pose: BoardPose


def _with_lines(
    seen: _Seen, channel: str, camera: Intrinsics, horizontal: bool, lasers: int, seed: int
) -> PlaneView:
    mode: Any = channel
    grey = Grey(mode=mode)
    frame, found = seen.frame, seen.found
    lit = to_grey(frame.image, grey)
    off = None if frame.off is None else to_grey(frame.off, grey)
    white = whitened(lit, found.board, seen.pose, camera) if off is None else None
    lines = find_stripe_lines(
        lit if white is None else white.grey,
        camera,
        background=off,
        edge_px=None if white is None else white.edge_px,
        horizontal=horizontal,
        most=lasers + 3,
        seed=seed,
    )
    kept = found if off is not None else _clear_of(lines, found)
    pose = seen.pose if kept is found else board_poses(kept.points_px, kept.points_mm, camera)[0]
    return PlaneView(frame.name, pose, kept.points_px, kept.points_mm, lines)


def _clear_of(lines: Sequence[StripeLine], found: BoardView) -> BoardView:
    """The board without the corners whose windows a stripe crosses: its light pulls them."""
    clear = np.ones(len(found.ids), np.bool_)
    reach = found.window_px + _STRIPE_REACH_PX
    for line in lines:
        across, along = (line.v_px, line.u_px) if line.along_v else (line.u_px, line.v_px)
        mine, other = (1, 0) if line.along_v else (0, 1)
        course = np.polyfit(along, across, 1)
        away = found.points_px[:, mine] - np.polyval(course, found.points_px[:, other])
        clear &= np.abs(away) > reach
    if clear.all() or clear.sum() < max(_LEAST_CORNERS, _LEAST_SHARE * len(clear)):
        return found
    return replace(
        found,
        ids=found.ids[clear],
        points_px=found.points_px[clear],
        points_mm=found.points_mm[clear],
    )


def _best_channel(
    seen: Sequence[_Seen],
    camera: Intrinsics,
    horizontal: bool,
    lasers: int,
    seed: int,
) -> str:
    """The channel in which most of some views agree; of equals the one with the smallest misfit."""
    pick = np.unique(np.linspace(0, len(seen) - 1, max(_TRIAL_VIEWS, LEAST_VIEWS)).astype(int))
    best: tuple[float, str] | None = None
    for channel in CHANNELS:
        views = [_with_lines(seen[i], channel, camera, horizontal, lasers, seed) for i in pick]
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
