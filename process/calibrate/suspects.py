"""Which corners and views contradict the rest, once a camera has been solved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
_CANDIDATES = 3
#: A view is the wrong way round if that explains its corners better by so many squared sigmas of the
#: noise, and by this share of what speaks for the typical view as it is; who it is can be told only
#: where the typical view is told clearly.
_FLIP_SQUARE, _FLIP_SHARE, _FLIP_TOLD, _FLIP_FEW = 20.0, 0.05, 40.0, 0.1
#: Ways in which an image can be the wrong way round: signs of u and v, and in words.
_FLIPS: tuple[tuple[tuple[float, float], str], ...] = (
    ((-1.0, 1.0), "mirrored"),
    ((1.0, -1.0), "mirrored and upside down"),
    ((-1.0, -1.0), "upside down"),
)
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


def suspect_views(bundle: Bundle) -> list[int]:
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
    return []


@dataclass(frozen=True)
class Flipped:
    """A view that fits the wrong way round: which, how, its rms as it is, and turned back, px."""

    view: int
    how: str
    rms_px: float
    back_px: float

    def sentence(self) -> str:
        """Why it is left out."""
        return (
            f"its corners are off by {self.rms_px:.2f} px rms, {self.how} by {self.back_px:.2f} px: "
            "the image is the wrong way round"
        )


def flipped_view(views: Sequence[BoardView], bundle: Bundle) -> Flipped | None:
    """The view that most clearly fits mirrored, or upside down, and not as it is; or None.

    A plain board looks the same in a mirror, and only the place of the principal point (and skew) says
    that the image is not. So a flip can be told as far as the other views tell it: where theirs speaks
    for none of them, because the principal point is in the middle, no view is suspected.
    """
    noise = bundle.noise_px()
    able = [i for i, v in enumerate(views) if v.whole and v.board.kind in ("chessboard", "circles")]
    if len(able) <= 3 or noise <= 0:
        return None
    plain = {i: _pose_rms_px(views[i].points_px, views[i], bundle) for i in able}
    ways: list[tuple[float, Flipped]] = []
    for signs, how in _FLIPS:
        back = {i: _pose_rms_px(_flip(views[i], signs), views[i], bundle) for i in able}
        # What speaks for each view as it is, in squared sigmas of the noise.
        said = np.array(
            [len(views[i].ids) * (back[i] ** 2 - plain[i] ** 2) / noise**2 for i in able], np.float64
        )
        if not np.isfinite(said).all():
            continue
        worst = int(said.argmin())
        others = np.delete(said, worst)
        told = float(np.median(others))
        # Where several other views seem turned over as well, boards are bent or the lens is another.
        sure = told > _FLIP_TOLD and np.quantile(others, _FLIP_FEW, method="lower") > 0
        if sure and said[worst] < -max(_FLIP_SQUARE, _FLIP_SHARE * told):
            at = able[worst]
            ways.append((float(said[worst]), Flipped(at, how, plain[at], back[at])))
    if not ways:
        return None
    best, found = min(ways, key=lambda w: w[0])
    # Of two ways that explain it alike, none is the better guess.
    alike = [f.how for s, f in ways if f.view == found.view and s < best + _FLIP_SQUARE]
    return replace(found, how=" or ".join(alike))


def contradiction(view: BoardView, without: Bundle) -> str:
    """How a view contradicts the camera that was solved without it."""
    off = _pose_rms_px(view.points_px, view, without)
    usual = without.rms_px()
    return f"its corners are off by {off:.2f} px rms, those of the other views by {usual:.2f} px"


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


def _flip(view: BoardView, signs: tuple[float, float]) -> Floats:
    """The corners of a whole board in the image turned over, in the order of the board's points."""
    grid = view.points_px.reshape(view.board.rows, view.board.cols, 2)
    # Half a turn puts the last corner first; a mirror exchanges left and right alone.
    grid = grid[::-1, ::-1] if signs == (-1.0, -1.0) else grid[:, ::-1]
    size = np.array([view.width_px - 1.0, view.height_px - 1.0])
    turned = np.where(np.array(signs) < 0, size - grid, grid)
    return np.ascontiguousarray(turned.reshape(-1, 2))


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
