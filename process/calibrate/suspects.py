"""Which corners and views contradict the rest, once a camera has been solved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.quality import LeftOut
from .boards import SHARP_PX, BoardView
from .bundle import Bundle
from .lattice import most_disturbed

Floats = npt.NDArray[np.float64]

#: A view is suspect from this many times the median view, and this much.
_VIEW_TIMES, _VIEW_PX = 3.0, 0.15
#: From this many times on, a view is tried mirrored.
_MIRROR_TIMES = 1.5
_CANDIDATES = 3
#: A corner, from this many times the median corner of all views (5 sigma of 2-D noise is 4.2 medians).
_CORNER_TIMES, _CORNER_PX = 8.0, 0.5
#: A view that is blurred this many times as much as the median view.
_BLUR_TIMES = 2.0


def drop_corners(views: Sequence[BoardView], bundle: Bundle) -> tuple[list[BoardView], list[LeftOut]]:
    """Views without single corners that are off; a view with many of them is left as it is."""
    every = np.concatenate([np.linalg.norm(r, axis=1) for r in bundle.residuals_px])
    limit = max(_CORNER_PX, _CORNER_TIMES * float(np.median(every)))
    kept, dropped = [], []
    for view, residuals in zip(views, bundle.residuals_px, strict=True):
        off = np.linalg.norm(residuals, axis=1)
        bad = off > limit
        if not bad.any() or bad.sum() > most_disturbed(view.board):
            kept.append(view)
            continue
        good = ~bad
        ids = ", ".join(str(i) for i in view.ids[bad])
        dropped.append(
            LeftOut(
                what=f"{view.name} corner {ids}",
                why=f"off by {off[bad].max():.1f} px, limit {limit:.2f} px",
            )
        )
        kept.append(
            replace(
                view, ids=view.ids[good], points_px=view.points_px[good], points_mm=view.points_mm[good]
            )
        )
    return kept, dropped


def suspect_views(views: Sequence[BoardView], bundle: Bundle) -> list[int]:
    """The worst views, worst first, if one of them contradicts the rest; none else.

    A view that lies pulls the camera, and then another one may fit worst: who is to go is found by
    leaving out each of these.
    """
    rms = bundle.view_rms_px()
    order = [int(i) for i in np.argsort(-rms, kind="stable")[:_CANDIDATES]]
    for at in order:
        others = float(np.median(np.delete(rms, at)))
        if rms[at] > _VIEW_TIMES * others + _VIEW_PX:
            return order
        if rms[at] > _MIRROR_TIMES * others and _mirrored_gain(views[at], bundle) < 0.5:
            return order
    return []


def contradiction(view: BoardView, without: Bundle) -> str:
    """How a view contradicts the camera that was solved without it."""
    off = _pose_rms_px(view.points_px, view, without)
    usual = without.rms_px()
    why = f"its corners are off by {off:.2f} px rms, those of the other views by {usual:.2f} px"
    if _mirrored_gain(view, without) < 0.5:
        why += "; mirrored it would fit: the image is the wrong way round"
    return why


def blurred_views(views: Sequence[BoardView]) -> list[tuple[int, str]]:
    """Views whose edges are more than twice as wide as those of most, and no longer sharp."""
    blur = np.array([v.blur_px for v in views])
    if not np.isfinite(blur).any():
        return []
    usual = float(np.nanmedian(blur))
    return [
        (i, f"blurred: edges are {b:.1f} px wide (1 sigma), {b / usual:.1f} times the usual")
        for i, b in enumerate(blur)
        if b > max(_BLUR_TIMES * usual, SHARP_PX)
    ]


def _mirrored_gain(view: BoardView, bundle: Bundle) -> float:
    """The view's rms with its image mirrored, over that as it is; 1 where nobody can tell."""
    if not view.whole or view.board.kind not in ("chessboard", "circles"):
        return 1.0
    grid = view.points_px.reshape(view.board.rows, view.board.cols, 2)[:, ::-1].reshape(-1, 2)
    flipped = np.ascontiguousarray(grid * (-1.0, 1.0) + (view.width_px - 1.0, 0.0))
    plain = _pose_rms_px(view.points_px, view, bundle)
    return _pose_rms_px(flipped, view, bundle) / plain if plain > 0 else 1.0


def _pose_rms_px(points_px: Floats, view: BoardView, bundle: Bundle) -> float:
    """Residual of the best pose of the board; skew, which OpenCV lacks, is taken out of u first."""
    fx, fy, cx, cy, skew = bundle.camera[:5]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    level = points_px - np.stack(
        [fx * skew * (points_px[:, 1] - cy) / fy, np.zeros(len(points_px))], axis=1
    )
    ok, turn, shift = cv2.solvePnP(view.points_mm, level, matrix, bundle.camera[5:])
    if not ok:
        return float("inf")
    mapped, _ = cv2.projectPoints(view.points_mm, turn, shift, matrix, bundle.camera[5:])
    off = np.asarray(mapped).reshape(-1, 2) - level
    return float(np.sqrt((off * off).sum(axis=1).mean()))
