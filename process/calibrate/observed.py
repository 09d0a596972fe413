"""What the commands saw as observations that a joint adjustment can read again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ...schemas.observations import (
    Observations,
    SeenAt,
    SeenBoard,
    SeenBody,
    SeenLength,
    SeenSphere,
    SeenStripe,
    SeenTurning,
    SeenWall,
)
from ...schemas.quality import EstimationInput
from .axis_result import AxisFit
from .boards import BoardView
from .plane import PlaneFit
from .plane_consensus import PlaneView, on_board
from .stripe_lines import StripeLine


def one_observation(
    size_px: tuple[int, int],
    *,
    boards: Iterable[SeenBoard] = (),
    turning: SeenTurning | None = None,
    walls: Iterable[SeenWall] = (),
    spheres: Iterable[SeenSphere] = (),
    lengths: Iterable[SeenLength] = (),
    inputs: Iterable[EstimationInput] = (),
) -> Observations:
    """Observations of one camera whose frames are ``size_px`` (width, height)."""
    return Observations(
        width_px=size_px[0],
        height_px=size_px[1],
        boards=tuple(boards),
        turning=turning,
        walls=tuple(walls),
        spheres=tuple(spheres),
        lengths=tuple(lengths),
        inputs=tuple(inputs),
    )


def boards_of(views: Iterable[BoardView]) -> list[SeenBoard]:
    """The boards that `calibrate camera` used."""
    return [_board(v.name, v.points_mm, v.points_px) for v in views]


def stripes_of(
    views: Sequence[PlaneView], fits: Sequence[PlaneFit], numbers: Sequence[int]
) -> list[SeenBoard]:
    """The boards that `calibrate plane` used, each with the stripes that made the planes."""
    out = []
    for view in views:
        stripes = []
        for fit, number in zip(fits, numbers, strict=True):
            if any(r.used and r.name == view.name for r in fit.residuals):
                line = min(view.lines, key=lambda x: _off(x, view, fit))
                stripes.append(stripe_of(line, number))
        if stripes:
            out.append(
                _board(view.name, view.board_mm, view.corners_px).model_copy(
                    update={"stripes": tuple(stripes)}
                )
            )
    return out


def stripe_of(line: StripeLine, laser: int) -> SeenStripe:
    """One straight stripe."""
    return SeenStripe(
        laser=laser,
        points_px=_pairs(np.stack([line.u_px, line.v_px], axis=1)),
        sigma_px=tuple(float(s) for s in line.sigma_px),
        along_v=line.along_v,
    )


def turning_of(fit: AxisFit, angle_sd_rad: float, size_sd: float = 0.0) -> SeenTurning:
    """The sightings that `calibrate axis` used, with the angles it was given."""
    s = fit.sightings
    sightings = []
    for frame, body in sorted(set(zip(s.frame.tolist(), s.body.tolist(), strict=True))):
        mine = (s.frame == frame) & (s.body == body)
        sightings.append(
            SeenBody(
                frame=frame,
                body=body,
                points_mm=_triples(s.points_mm[mine]),
                points_px=_pairs(s.seen_px[mine]),
            )
        )
    return SeenTurning(
        head=fit.head,
        frames=tuple(f.name for f in fit.frames),
        angles_rad=tuple(f.nominal_rad for f in fit.frames),
        angle_sd_rad=angle_sd_rad,
        size_sd=size_sd,
        sightings=tuple(sightings),
    )


def wall_of(
    name: str,
    distance_mm: float,
    sd_mm: float,
    stripes: Sequence[SeenAt],
    *,
    size_px: tuple[int, int],
) -> Observations:
    """One flat wall at a known distance."""
    wall = SeenWall(name=name, distance_mm=distance_mm, sd_mm=sd_mm, stripes=tuple(stripes))
    return one_observation(size_px, walls=(wall,))


def _off(line: StripeLine, view: PlaneView, fit: PlaneFit) -> float:
    """How far a stripe, on its board, is off a plane: the median, mm."""
    away = np.abs(on_board(line, view.pose) @ fit.normal - fit.distance_mm)
    return float(np.nanmedian(away)) if np.isfinite(away).any() else float("inf")


def _board(name: str, points_mm: np.ndarray, points_px: np.ndarray) -> SeenBoard:
    return SeenBoard(name=name, points_mm=_triples(points_mm), points_px=_pairs(points_px))


def _pairs(points: np.ndarray) -> tuple[tuple[float, float], ...]:
    return tuple((float(u), float(v)) for u, v in points)


def _triples(points: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), float(z)) for x, y, z in points)
