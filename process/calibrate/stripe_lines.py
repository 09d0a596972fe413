"""Straight stripes in one frame: every line that may be a laser's, to sub-pixel.

On a flat board a laser sheet is a straight line, once the lens is taken out. But a calibration frame
is no scan: it is brightly lit, the stripe is faint on white, other edges are as straight, and a piece
of stripe on the wall behind may outshine the one on the board. So this finds candidates; which of them
lie on the board's plane is decided over all views together (plane_consensus.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ..camera import undistort_points
from ..extract import extract_stripe, noise_of
from .board_print import EDGE_PX

Floats = npt.NDArray[np.float64]

#: Widths in px that a stripe may have; each is looked for with a filter of its own.
_SCALES = (9, 25, 61)
_PEAKS_A_ROW = 3
#: A steeper stripe would have to be looked for in columns (horizontal).
_STEEPEST = 1.2
_HYPOTHESES = 700
_NEAR_PX = 1.6
_LEAST_ROWS = 24
#: A rougher line is no laser's: an arm, a door frame, a column of squares.
_CROOKED_PX = 1.0
#: So many of its own widths a stripe must be clear of edges.
_CLEAR = 2.0


@dataclass(frozen=True)
class StripeLine:
    """Stripe points on one straight line: pixels, standard deviation across, and ideal rays.

    ``sigma_px`` is across the rows, along u, or with ``along_v`` along v (horizontal stripe).
    ``rays`` is (N, 2): xn, yn. ``straightness_px`` is the rms distance from the straight line in
    undistorted pixels, ``contrast_dn`` the median height above the surroundings.
    """

    u_px: Floats
    v_px: Floats
    sigma_px: Floats
    rays: Floats
    along_v: bool
    straightness_px: float
    contrast_dn: float

    def select(self, keep: npt.NDArray[np.bool_]) -> StripeLine:
        """The points where ``keep`` is True."""
        cut = {name: getattr(self, name)[keep] for name in ("u_px", "v_px", "sigma_px", "rays")}
        return replace(self, **cut)


def find_stripe_lines(
    grey: npt.NDArray[Any],
    camera: Intrinsics,
    *,
    background: npt.NDArray[Any] | None = None,
    edge_px: npt.NDArray[np.float32] | None = None,
    horizontal: bool = False,
    most: int = 4,
    seed: int = 0,
) -> list[StripeLine]:
    """Up to ``most`` straight stripes in ``grey`` (H, W), uint8 or uint16, the best supported first.

    ``background`` is a laser-off frame of the same shape, subtracted with its sign. ``edge_px`` (H, W)
    is how far each pixel is from an edge of the surface's print: stripe points that reach it are left
    out. The search is a seeded RANSAC over the brightest thin places of each row (column, if
    ``horizontal``).
    """
    frame = np.ascontiguousarray(grey.T) if horizontal else grey
    off = None if background is None else (background.T if horizontal else background)
    off = None if off is None else np.ascontiguousarray(off)
    edge = edge_px.T if edge_px is not None and horizontal else edge_px
    row, column, weight, width = _candidates(frame, off)
    rng = np.random.default_rng(seed)
    out: list[StripeLine] = []
    ideal = _ideal(column, row, camera, horizontal=horizontal)
    finite = np.isfinite(ideal).all(axis=1)
    row, column, weight, width, ideal = (a[finite] for a in (row, column, weight, width, ideal))
    for _ in range(most):
        if len(row) < _LEAST_ROWS:
            break
        on = _best_line(row, ideal, weight, rng)
        if np.unique(row[on]).size < max(_LEAST_ROWS, 0.05 * frame.shape[0]):
            break
        course = np.polyfit(ideal[on, 1], ideal[on, 0], 1)
        found = _exactly(frame, off, edge, row[on], column[on], float(np.median(width[on])))
        line = None if found is None else _straight(*found, course, camera, horizontal=horizontal)
        if line is not None:
            out.append(line)
        # What is near the line is spent, found well or not.
        far = np.abs(ideal[:, 0] - np.polyval(course, ideal[:, 1])) > np.maximum(width, 6.0)
        row, column, weight, width, ideal = (a[far] for a in (row, column, weight, width, ideal))
    return out


def _ideal(across: Floats, along: Floats, camera: Intrinsics, *, horizontal: bool) -> Floats:
    """(N, 2): undistorted place across and along the stripe, in px of the ideal camera."""
    u, v = (along, across) if horizontal else (across, along)
    xn, yn = undistort_points(u, v, camera)
    pair = (
        (camera.fy_px * yn, camera.fx_px * xn) if horizontal else (camera.fx_px * xn, camera.fy_px * yn)
    )
    return np.stack(pair, axis=1)


def _candidates(
    frame: npt.NDArray[Any], off: npt.NDArray[Any] | None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Row, column, weight (0 to 1) and scale of the thin bright places of every row."""
    signal = frame.astype(np.float32) if off is None else cv2.subtract(frame, off, dtype=cv2.CV_32F)
    noise = max(noise_of(frame) * (1.0 if off is None else 1.5), 0.5)
    parts: list[tuple[Floats, ...]] = []
    for scale in _SCALES:
        if scale * 3 > frame.shape[1]:
            continue
        # What is narrower than the scale stands out of its opening; smoothing matches its width.
        smooth = cv2.blur(signal, (max(3, scale // 4), 3))
        high = cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT, np.ones((1, scale), np.uint8))
        for _ in range(_PEAKS_A_ROW):
            peak = high.argmax(axis=1)
            rows = np.arange(len(peak))
            best = high[rows, peak].astype(np.float64)
            good = best > 4.0 * noise
            half = scale // 2 + 1
            window = peak[:, None] + np.arange(-half, half + 1)
            near = np.clip(window, 0, high.shape[1] - 1)
            values = np.where((window >= 0) & (window < high.shape[1]), high[rows[:, None], near], 0.0)
            place = (values * near).sum(axis=1) / np.maximum(values.sum(axis=1), 1e-9)
            parts.append(
                (rows[good] + 0.0, place[good], np.minimum(best[good] / (12 * noise), 1.0),
                 np.full(good.sum(), float(scale)))
            )  # fmt: skip
            high[rows[:, None], near] = 0.0
    if not parts:
        return (np.zeros(0),) * 4
    row, column, weight, width = (np.concatenate(a) for a in zip(*parts, strict=True))
    return row, column, weight, width


def _best_line(
    row: Floats, ideal: Floats, weight: Floats, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """The candidates on the line that most rows, weighted by contrast, agree on."""
    chance = weight / weight.sum()
    a, b = (rng.choice(len(row), _HYPOTHESES, p=chance) for _ in range(2))
    along = ideal[b, 1] - ideal[a, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (ideal[b, 0] - ideal[a, 0]) / along
    fine = (np.abs(along) > 12.0) & (np.abs(slope) < _STEEPEST)
    start, slope = ideal[a, 0][fine] - slope[fine] * ideal[a, 1][fine], slope[fine]
    if not len(slope):
        return np.zeros(len(row), np.bool_)
    sample = np.arange(len(row))[:: max(1, len(row) // 2500)]
    off = np.abs(ideal[sample, 0] - start[:, None] - slope[:, None] * ideal[sample, 1])
    score = np.where(off < _NEAR_PX, weight[sample], 0.0).sum(axis=1)
    best = int(score.argmax())
    course = np.array([slope[best], start[best]])
    on = np.zeros(len(row), np.bool_)
    for _ in range(4):
        on = np.abs(ideal[:, 0] - np.polyval(course, ideal[:, 1])) < _NEAR_PX
        if on.sum() < 3 or np.ptp(ideal[on, 1]) < 1.0:
            break
        course = np.polyfit(ideal[on, 1], ideal[on, 0], 1, w=np.sqrt(weight[on]))
    return on


def _exactly(
    frame: npt.NDArray[Any],
    off: npt.NDArray[Any] | None,
    edge: npt.NDArray[np.float32] | None,
    row: Floats,
    column: Floats,
    scale: float,
) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Row, column, sigma and height of the stripe, extracted in a band that follows the line.

    The band is cut out row by row and pushed straight by whole pixels, so that the product's own
    extraction sees one stripe and nothing else.
    """
    half = round(max(8.0, min(scale, 40.0)))
    order = np.argsort(row, kind="stable")
    rows = np.arange(max(0, int(row.min()) - 10), min(frame.shape[0], int(row.max()) + 11))
    # A parabola follows what the lens bends.
    bend = np.polyfit(row[order], column[order], 2 if np.ptp(row) > 60 else 1)
    left = np.rint(np.polyval(bend, rows)).astype(np.int64) - 2 * half
    inside = (left >= 0) & (left + 4 * half + 1 <= frame.shape[1])
    rows, left = rows[inside], left[inside]
    if len(rows) < _LEAST_ROWS:
        return None
    columns = left[:, None] + np.arange(4 * half + 1)
    band = np.ascontiguousarray(frame[rows[:, None], columns])
    dark = None if off is None else np.ascontiguousarray(off[rows[:, None], columns])
    found = extract_stripe(
        band,
        "centroid",
        background=dark,
        base_dn=2.0,
        max_width_px=float(half),
        from_px=half,
        to_px=3 * half + 1,
        noise=noise_of(frame),
    )
    if len(found) < _LEAST_ROWS:
        return None
    tall = found["amplitude_dn"] > 0.4 * np.median(found["amplitude_dn"])
    found = found[tall]
    at = found["row"].astype(np.int64)
    centre = left[at] + found["u_px"]
    if edge is not None:
        column_at = np.clip(np.rint(centre), 0, frame.shape[1] - 1).astype(np.int64)
        away = edge[rows[at], column_at]
        clear = away >= _CLEAR * float(np.median(found["width_px"])) + EDGE_PX
        found, at, centre = found[clear], at[clear], centre[clear]
    return rows[at] + 0.0, centre, found["sigma_u_px"], found["amplitude_dn"] + 0.0


def _straight(
    row: Floats,
    column: Floats,
    sigma: Floats,
    height: Floats,
    course: Floats,
    camera: Intrinsics,
    *,
    horizontal: bool,
) -> StripeLine | None:
    """The points that lie on one straight line in the undistorted frame, near the coarse ``course``."""
    ideal = _ideal(column, row, camera, horizontal=horizontal)
    off = ideal[:, 0] - np.polyval(course, ideal[:, 1])
    keep = np.isfinite(off) & np.isfinite(sigma) & (np.abs(off) < 2.0 * _NEAR_PX)
    for _ in range(6):
        if keep.sum() < _LEAST_ROWS:
            return None
        course = np.polyfit(ideal[keep, 1], ideal[keep, 0], 1)
        off = ideal[:, 0] - np.polyval(course, ideal[:, 1])
        spread = 1.4826 * float(np.median(np.abs(off[keep])))
        keep = np.isfinite(off) & (np.abs(off) < max(3.0 * spread, 0.3))
    if keep.sum() < _LEAST_ROWS or spread > _CROOKED_PX:
        return None
    u, v = (row[keep], column[keep]) if horizontal else (column[keep], row[keep])
    xn, yn = undistort_points(u, v, camera)
    return StripeLine(
        u_px=u,
        v_px=v,
        sigma_px=sigma[keep],
        rays=np.stack([xn, yn], axis=1),
        along_v=horizontal,
        straightness_px=float(np.sqrt(np.mean(off[keep] ** 2))),
        contrast_dn=float(np.median(height[keep])),
    )
