"""What the corners of a board say about themselves: spacing, regularity, saddle contrast, sharpness.

A detector can report a full grid in which a row sits on something else. Before anything is solved, a
grid must be regular (third differences along its lines), and every chessboard corner must look like
one: bright and dark squares in turn around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.board import Board
from .patterns import Refusal

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

#: A third difference larger than this share of a square, and one pixel, is no lattice. Perspective
#: and lenses stay below 0.06 squares on all boards measured; a corner on the wrong place gives its
#: full error.
_IRREGULAR_SQUARES = 0.1
_IRREGULAR_PX = 1.0
#: With fewer than four points in a line there is no third difference; a homography judges instead.
_BENT_SQUARES = 0.25
#: Least margin between bright and dark squares at a corner against the median corner of its board.
_FAINT = 0.25
#: Contrast between neighbours outside of the last squares, each of them, that means that the board
#: goes on.
_GOES_ON = 0.5
#: Share of a board's corners that may be dropped as disturbed (a reflection, a finger, the stripe).
_DISTURBED = 0.05


@dataclass(frozen=True)
class Lattice:
    """Smallest and median spacing of a grid, worst irregularity, what is wrong, if anything."""

    square_px: float
    median_px: float
    irregular_px: float
    wrong: str = ""


def as_grid(points_px: npt.ArrayLike, ids: npt.ArrayLike, board: Board) -> Floats:
    """Points as (rows, cols, 2), NaN where one is missing."""
    grid = np.full((board.points, 2), np.nan)
    grid[np.asarray(ids)] = points_px
    return grid.reshape(board.rows, board.cols, 2)


def examine(points_px: npt.ArrayLike, ids: npt.ArrayLike, board: Board) -> Lattice:
    """Spacing and regularity of a grid, missing points allowed."""
    grid = as_grid(points_px, ids, board)
    steps = np.concatenate([np.linalg.norm(np.diff(grid, axis=a), axis=-1).ravel() for a in (0, 1)])
    steps = steps[np.isfinite(steps)]
    if not steps.size:
        return Lattice(np.nan, np.nan, np.nan, "no two neighbouring points of the board were found")
    smallest, median = float(steps.min()), float(np.median(steps))
    worst = _worst_third(grid, board)
    wrong = ""
    if worst > _limit_px(median):
        wrong = (
            f"the grid is not regular: a corner is off by about {worst / 2:.1f} px where squares are "
            f"{median:.0f} px wide, so part of it does not lie on the board"
        )
    elif min(board.cols, board.rows) < 4:
        bent = _bent(points_px, ids, board)
        worst = max(worst, bent)
        if bent > _IRREGULAR_PX + _BENT_SQUARES * median:
            wrong = f"the grid is no flat board: a corner is off by {bent:.1f} px"
    return Lattice(smallest, median, worst, wrong)


def _limit_px(median_px: float) -> float:
    return _IRREGULAR_PX + _IRREGULAR_SQUARES * median_px


def _thirds(grid: Floats, board: Board) -> list[tuple[Floats, int, int]]:
    """|a - 3b + 3c - d| of every four points in a line, with the axis and the step between them."""
    # Every other row of an acircles grid is shifted, so its columns go in steps of two.
    step = 2 if board.kind == "acircles" else 1
    out = []
    for axis, by in ((1, 1), (0, step)):
        n = grid.shape[axis]
        if n > 3 * by:
            a, b, c, d = (np.take(grid, range(i * by, n - (3 - i) * by), axis) for i in range(4))
            out.append((np.linalg.norm(a - 3 * b + 3 * c - d, axis=-1), axis, by))
    return out


def _worst_third(grid: Floats, board: Board) -> float:
    return max((float(np.nanmax(t, initial=0.0)) for t, _, _ in _thirds(grid, board)), default=0.0)


def disturbed(points_px: npt.ArrayLike, ids: npt.ArrayLike, board: Board) -> npt.NDArray[np.int64]:
    """Ids of the few single points that make an otherwise regular grid irregular; empty if that fails.

    The point whose loss leaves least irregularity is taken out, again and again, up to a twentieth.
    """
    grid = as_grid(points_px, ids, board)
    limit = _limit_px(examine(points_px, ids, board).median_px)
    out: list[int] = []
    while _worst_third(grid, board) > limit:
        if len(out) >= most_disturbed(board):
            return np.empty(0, np.int64)
        best = (np.inf, 0, 0)
        for row, col in _involved(grid, board, limit):
            without = grid.copy()
            without[row, col] = np.nan
            left = sum(float(np.nansum(np.square(t))) for t, _, _ in _thirds(without, board))
            best = min(best, (left, row, col))
        grid[best[1], best[2]] = np.nan
        out.append(best[1] * board.cols + best[2])
    return np.array(sorted(out), np.int64)


def _involved(grid: Floats, board: Board, limit: float) -> list[tuple[int, int]]:
    """(row, col) of every point that takes part in a third difference beyond the limit."""
    mark = np.zeros(grid.shape[:2], bool)
    for third, axis, by in _thirds(grid, board):
        for row, col in np.argwhere(np.nan_to_num(third) > limit):
            for i in range(4):
                mark[(row, col + i * by) if axis == 1 else (row + i * by, col)] = True
    return [(int(r), int(c)) for r, c in np.argwhere(mark)]


def in_one_piece(points_px: npt.ArrayLike, ids: npt.ArrayLike, board: Board) -> bool:
    """Whether one smooth surface holds all points, also those on both sides of a gap in the grid.

    No third difference reaches across a missing column. A polynomial of third degree over the board
    follows perspective and lens, as third differences do, but no step from one part to the other.
    """
    seen = np.asarray(points_px, np.float64)
    column, row = np.asarray(ids) % board.cols, np.asarray(ids) // board.cols
    x, y = 2.0 * column / (board.cols - 1) - 1.0, 2.0 * row / (board.rows - 1) - 1.0
    design = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    if len(seen) < 2 * design.shape[1]:
        return False
    rest = seen - design @ np.linalg.lstsq(design, seen, rcond=None)[0]
    # A single corner that is off by so much makes a third difference twice as large.
    limit = 0.5 * _limit_px(examine(points_px, ids, board).median_px)
    return bool(np.linalg.norm(rest, axis=1).max() <= limit)


def _bent(points_px: npt.ArrayLike, ids: npt.ArrayLike, board: Board) -> float:
    flat = board.object_points_mm()[np.asarray(ids), :2]
    seen = np.asarray(points_px, np.float64)
    h: Any = cv2.findHomography(flat, seen, cv2.LMEDS)[0]
    if h is None:
        return float("inf")
    mapped = cv2.perspectiveTransform(flat[None], h)[0]
    return float(np.linalg.norm(mapped - seen, axis=1).max())


def axes(grid: Floats) -> tuple[Floats, Floats]:
    """Local steps along rows and columns, px, at each point."""
    return np.gradient(grid, axis=1), np.gradient(grid, axis=0)


def _sample(image: Grey, at: Floats) -> Floats:
    """Bilinear grey values at (..., 2) px; the border's value outside."""
    flat = at.reshape(-1, at.shape[-2], 2).astype(np.float32)
    got: npt.NDArray[Any] = cv2.remap(
        image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return got.reshape(at.shape[:-1]).astype(np.float64)


def _corner_margin(image: Grey, grid: Floats) -> Floats:
    """Darkest bright square minus brightest dark square around each point, DN; squares alternate.

    At a corner of a chessboard that is the full contrast; on its outer edge, where one side is
    plain, 0.
    """
    ex, ey = axes(grid)
    q = 0.3
    one = np.stack([_sample(image, grid + q * (ex + ey)), _sample(image, grid - q * (ex + ey))])
    two = np.stack([_sample(image, grid + q * (ex - ey)), _sample(image, grid - q * (ex - ey))])
    odd = np.add.outer(np.arange(grid.shape[0]), np.arange(grid.shape[1])) % 2 == 1
    bright, dark = np.where(odd, one, two), np.where(odd, two, one)
    if np.median(bright.mean(axis=0) - dark.mean(axis=0)) < 0:
        bright, dark = dark, bright
    return bright.min(axis=0) - dark.max(axis=0)


def check_chessboard(
    image: Grey, points_px: npt.ArrayLike, board: Board, lit: npt.NDArray[np.int64] | None = None
) -> tuple[Refusal | None, npt.NDArray[np.int64]]:
    """What contradicts a full chessboard grid in the image itself, and which points do.

    A few points that do not look like corners (a reflection, a finger) are named, and are no
    contradiction. Nor are those that a stripe is known to light.
    """
    grid = as_grid(points_px, np.arange(board.points), board)
    margin = _corner_margin(image, grid)
    middle = float(np.median(margin))
    bad = np.flatnonzero(margin < _FAINT * middle) if middle > 0 else np.arange(board.points)
    bad = bad if lit is None else np.setdiff1d(bad, lit)
    if bad.size > most_disturbed(board):
        why = (
            f"{bad.size} of {board.points} points are no corners of a chessboard: bright and dark "
            "squares do not alternate around them"
        )
        return Refusal("grid", why), bad
    return _goes_on(image, grid, middle), bad


def most_disturbed(board: Board) -> int:
    """How many points of a board may be dropped as disturbed."""
    return max(1, int(_DISTURBED * board.points))


def _goes_on(image: Grey, grid: Floats, contrast: float) -> Refusal | None:
    """Whether squares still alternate beyond the outermost ones."""
    ex, ey = axes(grid)
    height, width = image.shape
    sides = {
        "left": (grid[:, 0], -ex[:, 0], ey[:, 0]),
        "right": (grid[:, -1], ex[:, -1], ey[:, -1]),
        "top": (grid[0], -ey[0], ex[0]),
        "bottom": (grid[-1], ey[-1], ex[-1]),
    }
    for side, (edge, outward, along) in sides.items():
        at = edge + 1.35 * outward
        reach = 0.5 * np.abs(along)
        inside = ((at - reach >= 0) & (at + reach <= (width - 1, height - 1))).all(axis=1)
        if inside.sum() < 3:
            continue
        step = _sample(image, (at + 0.3 * along)[None])[0] - _sample(image, (at - 0.3 * along)[None])[0]
        turned = (step * (1.0 - 2.0 * (np.arange(len(at)) % 2)))[inside]
        if (
            min(abs(turned.min()), abs(turned.max())) > _GOES_ON * contrast
            and turned.min() * turned.max() > 0
        ):
            said = f"{grid.shape[1]}x{grid.shape[0]} inner corners that were said"
            return Refusal("size", f"the chessboard goes on beyond the {side} of the {said}")
    return None


def edge_blur_px(image: Grey, points_px: npt.ArrayLike, board: Board) -> float:
    """Standard deviation of the blur across the squares' edges, px: the larger of the two directions.

    From the steepest slope of the edge profile half-way between two corners: a Gaussian edge of
    contrast c has the slope c / (sigma sqrt(2 pi)). About 0.5 px of it is interpolation.
    """
    grid = as_grid(points_px, np.arange(board.points), board)
    ex, ey = axes(grid)
    found = []
    for along, across in ((1, ey), (0, ex)):
        first = np.take(grid, range(grid.shape[along] - 1), along)
        second = np.take(grid, range(1, grid.shape[along]), along)
        direction = np.take(across, range(grid.shape[along] - 1), along).reshape(-1, 2)
        middle = (0.5 * (first + second)).reshape(-1, 2)
        t = np.linspace(-0.4, 0.4, 33)
        profile = _sample(image, middle[:, None] + t[:, None] * direction[:, None])
        step_px = (t[1] - t[0]) * np.linalg.norm(direction, axis=1)
        contrast = np.abs(profile[:, -4:].mean(axis=1) - profile[:, :4].mean(axis=1))
        slope = np.abs(profile[:, 2:] - profile[:, :-2]).max(axis=1) / (2.0 * step_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = contrast / (np.sqrt(2.0 * np.pi) * slope)
        good = contrast > 8
        found.append(float(np.median(sigma[good])) if good.any() else np.nan)
    return float(np.nanmax(found)) if np.isfinite(found).any() else np.nan
