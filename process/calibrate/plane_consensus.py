"""Which stripe of which view is the laser's: the largest set that lies on one plane.

Every view offers all its straight lines; two of them from different views make a plane, and the others
vote. A piece of stripe on a wall that stands still is a fixed line of the image: its rays make a plane
through the camera's centre, on which the boards' movement puts it perfectly. Such planes measure
nothing, and are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.errors import CalibrationError
from .pose import BoardPose
from .stripe_lines import StripeLine

Floats = npt.NDArray[np.float64]

LEAST_VIEWS = 3
#: Fewer views than this agree by chance when each offers several lines.
_FEW = 5
#: Off-plane distance, as a share of the range, at which a stripe may still be the laser's.
_CONSENSUS = 0.006
#: A plane closer to the camera's centre than this share of the range measures nothing.
LEAST_BASE = 0.01
STANDS_STILL = (
    "stripes that stand still while the board moves are on the wall behind it, not on the board; let "
    "the stripe fall on the board, and move the board"
)
_HYPOTHESES = 4000


@dataclass(frozen=True)
class PlaneView:
    """One frame: the board's pose, its corners, and every straight stripe that was seen."""

    name: str
    pose: BoardPose
    corners_px: Floats
    board_mm: Floats
    lines: Sequence[StripeLine]


@dataclass(frozen=True)
class Choice:
    """A view and which of its lines is taken."""

    view: PlaneView
    line: StripeLine


def on_board(line: StripeLine, pose: BoardPose) -> Floats:
    """Points (N, 3) in camera space where the stripe's rays meet the board's plane; NaN behind."""
    rays = np.concatenate([line.rays, np.ones((len(line.rays), 1))], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = pose.distance_mm / (rays @ pose.normal)
    return np.where((depth > 0)[:, None], rays * depth[:, None], np.nan)


def finite(points: Floats) -> Floats:
    """The rows of ``points`` without NaN."""
    return points[np.isfinite(points).all(axis=1)]


def consensus(
    views: Sequence[PlaneView], spent: set[int], rng: np.random.Generator, number: int, lasers: int
) -> list[Choice]:
    """The largest set of stripes, one a view, that lie on one plane which is not through the camera."""
    options = [(i, v, line) for i, v in enumerate(views) for line in v.lines if id(line) not in spent]
    ends, keep = [], []
    for i, v, line in options:
        placed = on_board(line, v.pose)
        placed = placed[np.isfinite(placed).all(axis=1)]
        if len(placed) < 2:
            continue
        middle = placed.mean(axis=0)
        along = (placed - middle) @ np.linalg.svd(placed - middle, full_matrices=False)[2][0]
        order = np.argsort(along)
        tenth = max(1, len(order) // 10)
        ends.append([placed[order[:tenth]].mean(axis=0), placed[order[-tenth:]].mean(axis=0)])
        keep.append((i, v, line))
    if len({i for i, *_ in keep}) < LEAST_VIEWS:
        seen = len({i for i, *_ in keep})
        raise CalibrationError(
            f"a stripe and a board are seen together in {seen} of {len(views)} views, "
            f"{LEAST_VIEWS} at least are needed for a plane",
            hint="darken the room, or give pairs with the laser off; --horizontal if the stripe lies",
        )
    end = np.array(ends)
    view_of = np.array([i for i, *_ in keep])
    reach = float(np.median(np.linalg.norm(end, axis=2)))
    normal, distance = _hypotheses(end, view_of, reach, rng)
    limit = _CONSENSUS * reach
    off = np.abs(np.einsum("lei,hi->hle", end, normal) - distance[:, None, None]).max(axis=2)
    support = np.zeros(len(normal))
    for i in np.unique(view_of):
        # Nearer counts more; a view counts once, whatever number of lines it offers.
        support += np.maximum(0.0, 1.0 - (off[:, view_of == i].min(axis=1) / limit) ** 2)
    best = int(support.argmax()) if len(support) else -1
    chosen: list[Choice] = []
    for i in np.unique(view_of) if best >= 0 else ():
        mine = np.flatnonzero(view_of == i)
        line = mine[off[best, mine].argmin()]
        if off[best, line] < limit:
            chosen.append(Choice(keep[line][1], keep[line][2]))
    if len(chosen) < LEAST_VIEWS:
        which = f"the plane of laser {number + 1} of {lasers}" if lasers > 1 else "a laser's plane"
        raise CalibrationError(
            f"no {LEAST_VIEWS} views agree on {which}: no stripes on their boards lie in one plane "
            f"that a camera {reach:.0f} mm away could measure with",
            hint=STANDS_STILL,
        )
    offered = len(np.unique(view_of))
    if len(chosen) < _FEW and 2 * len(chosen) < offered:
        raise CalibrationError(
            f"of {offered} views that show straight lines only {len(chosen)} agree on a plane, as "
            "edges of the scene do by chance: there seems to be no stripe, and ranges by such a plane "
            f"would mean nothing (the boards are {reach:.0f} mm away)",
            hint="is the laser on? darken the room, or give pairs with the laser off; leave out images "
            "without it",
        )
    return chosen


def _hypotheses(
    end: Floats, view_of: npt.NDArray[np.int64], reach: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Planes through the lines of two views; those through the camera's centre are left out."""
    a, b = (rng.integers(0, len(end), _HYPOTHESES) for _ in range(2))
    other = view_of[a] != view_of[b]
    points = np.concatenate([end[a[other]], end[b[other]]], axis=1)
    middle = points.mean(axis=1, keepdims=True)
    _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
    normal = axes[:, 2]
    distance = np.einsum("hi,hi->h", normal, middle[:, 0])
    flat = size[:, 2] < 2.0 * _CONSENSUS * reach
    wide = size[:, 1] > 3.0 * size[:, 2]
    base = np.abs(distance) > LEAST_BASE * reach
    good = flat & wide & base
    return normal[good], distance[good]
