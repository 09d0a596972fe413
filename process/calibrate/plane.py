"""A laser's plane from stripes on boards, with all that is uncertain about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics, LaserPlane
from ...schemas.errors import CalibrationError
from .chained import Follower
from .plane_consensus import (
    LEAST_BASE,
    LEAST_VIEWS,
    STANDS_STILL,
    Choice,
    PlaneView,
    consensus,
    finite,
    on_board,
)
from .plane_fit import (
    corner_sigma_px,
    follow_intrinsics,
    said_by,
    solve,
    squares,
    tangents,
    unexplained_mm,
)

Floats = npt.NDArray[np.float64]

#: One good view in so many is left out for being too far off.
_ONE_IN = 1000.0
#: The stripes must spread this share of their range across their own direction.
_LEAST_SPREAD = 0.01
#: Rounds of fitting: weights, scatter and views left out depend on each other.
_TURNS = 7


@dataclass(frozen=True)
class ViewResidual:
    """How a view's stripe fits the plane: mean and rms distance of its points, and in sigmas."""

    name: str
    mean_mm: float
    rms_mm: float
    sigmas: float
    points: int
    used: bool


@dataclass(frozen=True)
class PlaneFit:
    """One laser's plane.

    ``covariance`` (4, 4) nx ny nz distance_mm holds all that is known to be uncertain; ``conditional``
    leaves the intrinsics' share out; ``by_intrinsics`` (4, 10) is how the plane follows them.
    ``points_mm`` (N, 3) are the stripe points used, ``view_of_point`` (N,) their view;
    ``unexplained_mm`` is the standard deviation of a view beyond what corners and stripe explain;
    ``offered`` how many views show any straight line.
    """

    normal: Floats
    distance_mm: float
    covariance: Floats
    conditional: Floats
    by_intrinsics: Floats
    residuals: tuple[ViewResidual, ...]
    points_mm: Floats
    view_of_point: npt.NDArray[np.int64]
    unexplained_mm: float
    spread_mm: tuple[float, float]
    tilt_range_deg: float
    offered: int
    left_out: tuple[tuple[str, str], ...] = field(default=())

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of all used stripe points from the plane."""
        return float(np.sqrt(np.mean((self.points_mm @ self.normal - self.distance_mm) ** 2)))

    @property
    def used(self) -> int:
        """How many views made the plane."""
        return sum(r.used for r in self.residuals)

    def sigma_at_mm(self, points_mm: Floats, *, camera_exact: bool = False) -> Floats:
        """Standard deviation of the plane's place, along its normal, at points (N, 3).

        With ``camera_exact`` the share of the intrinsics is left out: a scan with the same camera is
        wrong by them in the same way, so most of it cancels where the boards were.
        """
        matrix = self.conditional if camera_exact else self.covariance
        lever = np.concatenate([points_mm, -np.ones((len(points_mm), 1))], axis=1)
        return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", lever, matrix, lever), 0.0))

    def laser_plane(self, laser: int) -> LaserPlane:
        """The part of a calibration document."""
        n = self.normal / np.linalg.norm(self.normal)
        covariance = 0.5 * (self.covariance + self.covariance.T)
        return LaserPlane(
            laser=laser,
            normal=(float(n[0]), float(n[1]), float(n[2])),
            distance_mm=self.distance_mm,
            covariance=tuple(tuple(float(a) for a in row) for row in covariance),
        )

    def follower(self, laser: int) -> Follower:
        """The part, and how it follows the camera."""
        return Follower(self.laser_plane(laser), self.conditional, {"intrinsics": self.by_intrinsics})


def fit_planes(
    views: Sequence[PlaneView], camera: Intrinsics, *, lasers: int = 1, seed: int = 0
) -> list[PlaneFit]:
    """The planes of ``lasers`` lasers, by the place of their stripes (left to right, top to bottom).

    Raises
    ------
    CalibrationError
        Too few views hold a stripe on their board's plane, or they all show the same line, so that the
        plane could turn about it; the message says by how many mm.
    """
    rng = np.random.default_rng(seed)
    spent: set[int] = set()
    fits: list[tuple[float, PlaneFit]] = []
    for number in range(lasers):
        chosen = consensus(views, spent, rng, number, lasers)
        spent.update(id(c.line) for c in chosen)
        place = np.median([np.median(c.line.v_px if c.line.along_v else c.line.u_px) for c in chosen])
        fits.append((float(place), _fit(chosen, views, camera)))
    return [fit for _, fit in sorted(fits, key=lambda f: f[0])]


def _fit(chosen: list[Choice], views: Sequence[PlaneView], camera: Intrinsics) -> PlaneFit:
    points = np.concatenate([finite(on_board(c.line, c.view.pose)) for c in chosen])
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    distance = float(normal @ middle)
    left: list[tuple[str, str]] = []
    used, extra = list(chosen), np.zeros(2)
    for turn in range(_TURNS):
        normal, distance, said, information, basis = solve(used, normal, distance, extra, camera)
        # Robust while there may be wrong views among them, exact at last.
        last = turn >= _TURNS - 3
        extra = unexplained_mm(said, robust=not last)
        if last:
            continue
        square = squares(said, extra)
        # The worst first: it may have pulled the plane away from good ones.
        limit = max(_farthest(len(used)), 0.5 * float(square.max()))
        keep = square < limit
        if keep.sum() < LEAST_VIEWS:
            continue
        for c, s, q in zip(used, said, square, strict=True):
            if q >= limit:
                off = f"{s.residual_mm.mean():+.2f} mm ({np.sqrt(q / 2):.1f} sigma)"
                left.append((c.view.name, f"its stripe is {off} off the plane of the others"))
        used = [c for c, good in zip(used, keep, strict=True) if good]
    _check_spread(used, information, basis)
    _check_base(used, distance)
    lift = np.zeros((4, 3))
    lift[:3, :2], lift[3, 2] = basis, 1.0
    conditional = lift @ np.linalg.inv(information) @ lift.T
    by_intrinsics = lift @ follow_intrinsics(used, said, extra, information, normal, camera)
    covariance = conditional.copy()
    if camera.covariance is not None:
        covariance += by_intrinsics @ np.array(camera.covariance) @ by_intrinsics.T
    if distance < 0:
        normal, distance = -normal, -distance
        by_intrinsics = -by_intrinsics
    names = {c.view.name for c in used}
    known = {name for name, _ in left}
    for v in views:
        if v.name not in names | known:
            why = "no straight stripe was found" if not v.lines else "no stripe on the board's plane"
            left.append((v.name, why))
    fit = _package(
        used, chosen, extra, normal, distance, (covariance, conditional, by_intrinsics), left, camera
    )
    return replace(fit, offered=sum(bool(v.lines) for v in views))


def _farthest(views: int) -> float:
    """The squared residual that one good view in a thousand exceeds.

    Twice the quantile of F with 2 and 2 views - 3 degrees of freedom, which has a closed form: of few
    views the scatter is hardly known, and one that is far off may well be a good one.
    """
    freedom = float(max(1, 2 * views - 3))
    return freedom * (_ONE_IN ** (2.0 / freedom) - 1.0)


def _package(
    used: list[Choice],
    chosen: list[Choice],
    extra_mm: Floats,
    normal: Floats,
    distance: float,
    matrices: tuple[Floats, Floats, Floats],
    left: list[tuple[str, str]],
    camera: Intrinsics,
) -> PlaneFit:
    residuals, clouds = [], []
    inside = {c.view.name for c in used}
    sigma = corner_sigma_px(used)
    for c in chosen:
        s = said_by(c, normal, distance, tangents(normal), sigma, camera)
        q = float(squares([s], extra_mm)[0])
        r = s.residual_mm
        residuals.append(
            ViewResidual(c.view.name, float(r.mean()), float(np.sqrt(np.mean(r**2))),
                         float(np.sqrt(q / 2)), len(r), c.view.name in inside)
        )  # fmt: skip
        if c.view.name in inside:
            clouds.append(finite(on_board(c.line, c.view.pose)))
    points = np.concatenate(clouds)
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    facing = np.array([c.view.pose.normal for c in used])
    angles = np.rad2deg(np.arccos(np.clip(np.abs(facing @ facing.T), 0.0, 1.0)))
    return PlaneFit(
        normal=normal,
        distance_mm=distance,
        covariance=matrices[0],
        conditional=matrices[1],
        by_intrinsics=matrices[2],
        residuals=tuple(residuals),
        points_mm=points,
        view_of_point=np.repeat(np.arange(len(clouds)), [len(c) for c in clouds]),
        unexplained_mm=float(extra_mm[0]),
        spread_mm=(float(extent[0]), float(extent[1])),
        tilt_range_deg=float(angles.max()),
        offered=len(used),
        left_out=tuple(left),
    )


def _check_base(used: Sequence[Choice], distance_mm: float) -> None:
    """Refuse a plane through the camera's centre: it is what a line that stands still makes."""
    points = np.concatenate([finite(on_board(c.line, c.view.pose)) for c in used])
    reach = float(np.median(np.linalg.norm(points, axis=1)))
    if abs(distance_mm) < LEAST_BASE * reach:
        # Across the plane a thousandth of the range, which boards and pixels hardly keep.
        off = 1e-3 * reach * reach / max(abs(distance_mm), 1e-9)
        raise CalibrationError(
            f"the lines of {len(used)} views make a plane that passes the camera's centre at "
            f"{abs(distance_mm):.1f} mm, with boards {reach:.0f} mm away: nothing can be measured with "
            f"it; a point {1e-3 * reach:.1f} mm off it would be {off:.0f} mm off in range",
            hint=STANDS_STILL,
        )


def _check_spread(used: Sequence[Choice], information: Floats, basis: Floats) -> None:
    """Refuse stripes that all lie on one line: the plane could turn about it."""
    points = np.concatenate([finite(on_board(c.line, c.view.pose)) for c in used])
    centre = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - centre, full_matrices=False)
    extent = size / np.sqrt(len(points))
    reach = float(np.linalg.norm(centre))
    # Turning about the stripes' common direction: how well is that known?
    across = axes[1]
    lever = np.concatenate([across @ basis, [0.0]])
    turn = float(np.sqrt(lever @ np.linalg.solve(information, lever)))
    away = 0.25 * reach
    if extent[1] < _LEAST_SPREAD * reach or turn * away > 0.02 * reach:
        raise CalibrationError(
            f"the stripes of {len(used)} views lie nearly on one line (they spread {extent[1]:.1f} mm "
            f"across it, {reach:.0f} mm away), because the boards stood in nearly one plane: the "
            f"laser's plane could turn about that line by "
            f"{np.rad2deg(min(turn, 1.0)):.2g} deg (1 sigma), {min(turn, 1.0) * away:.1f} mm at "
            f"{away:.0f} mm beside it",
            hint="hold the board nearer and farther, over the whole range that will be measured",
        )
