"""How large the markers on the table really are: the laser's stripe across them knows the scale.

A picture of markers says everything but their size. Points are measured with the laser, so the axis
must be in the laser's scale, or every radius is wrong by the printer's error times the distance. Where
the stripe crosses the table, its depth is known twice: from the laser's plane, and from the markers'
plane times the unknown scale; so each stripe point gives the scale by itself. Tables are dished or
domed (a wooden one of 200 mm by half a millimetre): only points among the markers, and as far from the
axis as they are, speak of the markers' plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics, LaserPlane
from ...schemas.recipe import Grey
from ..grey import to_grey
from .axis_result import AxisFit, bodies_at_zero
from .pose import rotation_of
from .stripe_lines import StripeLine, find_stripe_lines

Floats = npt.NDArray[np.float64]

_LEAST_FRAMES = 3
_LEAST_POINTS = 12
#: Markers are not printed more wrongly than this.
_RANGE = (0.7, 1.4)


@dataclass(frozen=True)
class TableScale:
    """``scale``: true over assumed size, its variance, and how constant it is over the frames used.

    ``own_variance`` takes the laser's plane as exact; ``variance`` does not.
    """

    scale: float
    own_variance: float
    variance: float
    frame_sd: float
    along_sd: float
    frames: int
    points: int

    @property
    def sigmas_from_one(self) -> float:
        """How significantly the markers differ from what was assumed."""
        return abs(self.scale - 1.0) / float(np.sqrt(self.own_variance))


def table_scale(
    fit: AxisFit, lines: Sequence[Sequence[StripeLine]], plane: LaserPlane
) -> TableScale | None:
    """The scale from the stripes in each of the fit's frames; None where too few cross the markers.

    Only stripe points among the markers count: inside their convex hull, and no nearer to the axis than
    their nearest corner.
    """
    if fit.plane is None:
        return None
    state = fit.turning
    corners = bodies_at_zero(state, fit.sightings)
    normal0, distance0 = fit.plane
    each, slopes, alongs, points = [], [], [], 0
    for k, found in enumerate(lines):
        turn = rotation_of(state.direction * state.phi_rad[k])
        normal = turn @ normal0
        distance = distance0 - float(normal0 @ state.point_mm) + float(normal @ state.point_mm)
        placed = (corners - state.point_mm) @ turn.T + state.point_mm
        for line in found:
            said = _ratios(line, normal, distance, placed, (state.point_mm, state.direction), plane)
            if said is None:
                continue
            ratio, lever = said
            middle = float(np.median(ratio))
            good = np.abs(ratio - middle) < max(
                0.01, 4 * 1.4826 * float(np.median(np.abs(ratio - middle)))
            )
            if good.sum() < _LEAST_POINTS or not _RANGE[0] < middle < _RANGE[1]:
                continue
            each.append(float(ratio[good].mean()))
            alongs.append(float(ratio[good].std()))
            slopes.append(lever[good].mean(axis=0))
            points += int(good.sum())
    if len(each) < _LEAST_FRAMES:
        return None
    ratios = np.array(each)
    # Another line in a few frames (an edge of the table, a cable) disagrees with the many.
    limit = max(0.003, 4.0 * 1.4826 * float(np.median(np.abs(ratios - np.median(ratios)))))
    good = np.abs(ratios - np.median(ratios)) < limit
    if good.sum() < _LEAST_FRAMES:
        return None
    sd = float(ratios[good].std(ddof=1))
    # A trend along the stripe is the same in every frame: it is not averaged away.
    own = variance = sd**2 / float(good.sum()) + float(np.median(alongs)) ** 2
    if plane.covariance is not None:
        lever = np.array(slopes)[good].mean(axis=0)
        variance += float(lever @ np.array(plane.covariance) @ lever)
    return TableScale(
        float(ratios[good].mean()), own, variance, sd, float(np.median(alongs)), int(good.sum()), points
    )


def _ratios(
    line: StripeLine,
    normal: Floats,
    distance: float,
    corners: Floats,
    axis: tuple[Floats, Floats],
    plane: LaserPlane,
) -> tuple[Floats, Floats] | None:
    """Depth on the laser's plane over depth on the markers' plane, and its slopes by nx ny nz h."""
    rays = np.concatenate([line.rays, np.ones((len(line.rays), 1))], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        on_table = distance / (rays @ normal)
        facing = rays @ np.array(plane.normal)
        on_plane = plane.distance_mm / facing
    inside = (on_table > 0) & (on_plane > 0)
    placed = rays * on_table[:, None]
    inside &= _within(placed, corners, normal)
    inside &= _from_axis(placed, *axis) >= _from_axis(corners, *axis).min()
    if inside.sum() < _LEAST_POINTS:
        return None
    ratio = (on_plane / on_table)[inside]
    by_normal = -ratio[:, None] * rays[inside] / facing[inside, None]
    by_distance = ratio / plane.distance_mm
    return ratio, np.concatenate([by_normal, by_distance[:, None]], axis=1)


def _from_axis(points: Floats, point_mm: Floats, direction: Floats) -> Floats:
    """Distance of points (N, 3) from an axis."""
    return np.linalg.norm(np.cross(points - point_mm, direction), axis=1)


def _within(points: Floats, corners: Floats, normal: Floats) -> npt.NDArray[np.bool_]:
    """Whether points on the markers' plane are inside the convex hull of the markers' corners."""
    axes = np.linalg.svd(normal[None])[2][1:].T
    hull = cv2.convexHull((corners @ axes).astype(np.float32)).reshape(-1, 2).astype(np.float64)
    flat = points @ axes
    after = np.roll(hull, -1, axis=0)
    edge = after - hull
    side = np.stack(
        [
            e[0] * (flat[:, 1] - h[1]) - e[1] * (flat[:, 0] - h[0])
            for e, h in zip(edge, hull, strict=True)
        ]
    )
    return np.asarray((side >= 0).all(axis=0) | (side <= 0).all(axis=0), np.bool_)


def scale_from_frames(
    fit: AxisFit,
    frames: Sequence[npt.NDArray[Any]],
    camera: Intrinsics,
    plane: LaserPlane,
    channels: Sequence[str],
) -> TableScale | None:
    """:func:`table_scale` of the fit's ``frames``, in the channel whose stripe agrees most often."""
    best: TableScale | None = None
    for channel in channels:
        mode: Any = channel
        lines = [find_stripe_lines(to_grey(f, Grey(mode=mode)), camera) for f in frames]
        found = table_scale(fit, lines, plane)
        if found is not None and (best is None or found.frames > best.frames):
            best = found
        if all(f.ndim == 2 for f in frames) or (best is not None and best.frames == len(frames)):
            break
    return best
