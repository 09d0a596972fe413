"""What the joint fit of an axis says: the axis with its covariance, and what is left of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Head, Intrinsics, Turn, TurntableAxis
from .axis_adjust import Adjusted, Prior, Sightings, Turning, moved_by
from .chained import Follower
from .intrinsics_slopes import pixel_slopes
from .pose import project_with_slopes, skew_of

Floats = npt.NDArray[np.float64]

#: Fewer angles cannot tell a once-a-turn error from scatter.
_LEAST_FOR_SINE = 8


@dataclass(frozen=True)
class FrameResidual:
    """How one frame fits: its angle as estimated, what it is off the nominal, and what is left over.

    ``tilt_rad``, ``shift_mm`` (2) and ``rise_mm`` are the rigid motion that would fit the frame better:
    out of the axis, across it, along it.
    """

    name: str
    nominal_rad: float
    angle_rad: float
    off_rad: float
    rms_px: float
    tilt_rad: float
    shift_mm: tuple[float, float]
    rise_mm: float
    points: int


@dataclass(frozen=True)
class AxisFit:
    """The axis of a turntable in camera space.

    ``covariance`` (6, 6) point_mm (3) direction (3) holds all that is known to be uncertain;
    ``conditional`` leaves the intrinsics' share out; ``by_intrinsics`` (6, 10) is how the axis follows
    them. ``angle_scale`` is estimated over nominal angle, ``step_sd_rad`` the scatter of single steps
    about it, ``eccentricity_rad`` the once-a-turn part of the angle error (NaN for less than half a
    turn or eight frames).
    ``plane`` is the unit normal (up) and distance of the plane that the bodies lie in, or None.
    ``own_size``: the bodies' size is as stated, not as a laser sees it.
    """

    point_mm: Floats
    direction: Floats
    positive_turn: Turn
    head: Head
    covariance: Floats
    conditional: Floats
    by_intrinsics: Floats
    frames: tuple[FrameResidual, ...]
    angle_scale: float
    step_sd_rad: float
    eccentricity_rad: float
    sigma_px: float
    excess: float
    turning: Turning
    sightings: Sightings
    residual_px: Floats
    plane: tuple[Floats, float] | None
    left_out: tuple[tuple[str, str], ...]
    own_size: bool = True

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals of a corner, both coordinates together."""
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()))

    @property
    def wobble_rad(self) -> float:
        """Root mean square of the tilt of single frames out of the axis."""
        return float(np.sqrt(np.mean([f.tilt_rad**2 for f in self.frames])))

    @property
    def wander_mm(self) -> float:
        """Root mean square of the shift of single frames across the axis."""
        return float(np.sqrt(np.mean([f.shift_mm[0] ** 2 + f.shift_mm[1] ** 2 for f in self.frames])))

    @property
    def span_rad(self) -> float:
        """From the smallest to the largest angle."""
        return float(np.ptp([f.angle_rad for f in self.frames]))

    def scaled(self, scale: float, own_variance: float, variance: float) -> AxisFit:
        """The same scene ``scale`` times as large.

        ``variance`` is that of the scale, ``own_variance`` the part of it that is not the camera's.
        """
        lift = np.diag([scale] * 3 + [1.0] * 3)
        along = np.concatenate([self.point_mm, np.zeros(3)])
        own = lift @ self.conditional @ lift + own_variance * np.outer(along, along)
        share = lift @ (self.covariance - self.conditional) @ lift
        share = share + (variance - own_variance) * np.outer(along, along)
        turning = replace(
            self.turning,
            point_mm=self.turning.point_mm * scale,
            translations_mm=self.turning.translations_mm * scale,
        )
        moved = replace(self.sightings, points_mm=self.sightings.points_mm * scale)
        plane = None if self.plane is None else (self.plane[0], self.plane[1] * scale)
        frames = tuple(
            replace(
                f, shift_mm=(f.shift_mm[0] * scale, f.shift_mm[1] * scale), rise_mm=f.rise_mm * scale
            )
            for f in self.frames
        )
        return replace(
            self,
            point_mm=self.point_mm * scale,
            covariance=own + share,
            conditional=own,
            by_intrinsics=lift @ self.by_intrinsics,
            turning=turning,
            sightings=moved,
            plane=plane,
            frames=frames,
            own_size=False,
        )

    def follower(self) -> Follower:
        """The part, and how it follows the camera; not known where the laser gave the size."""
        by = {"intrinsics": self.by_intrinsics} if self.own_size else None
        return Follower(self.turntable_axis(), self.conditional, by)

    def turntable_axis(self) -> TurntableAxis:
        """The part of a calibration document."""
        d = self.direction / np.linalg.norm(self.direction)
        covariance = 0.5 * (self.covariance + self.covariance.T)
        # The camera's X is the usual x of the table; an axis along it needs another.
        x = (1.0, 0.0, 0.0) if abs(d[0]) < 0.9 else (0.0, 0.0, 1.0)
        return TurntableAxis(
            point_mm=(float(self.point_mm[0]), float(self.point_mm[1]), float(self.point_mm[2])),
            direction=(float(d[0]), float(d[1]), float(d[2])),
            x_direction=None if x[0] else x,
            head=self.head,
            positive_turn=self.positive_turn,
            covariance=tuple(tuple(float(a) for a in row) for row in covariance),
        )


def result_of(
    fitted: Adjusted,
    s: Sightings,
    names: Sequence[str],
    nominal: Floats,
    sense: int,
    head: Head,
    camera: Intrinsics,
    prior: Prior,
    left: list[tuple[str, str]],
) -> AxisFit:
    """The axis, its covariance and residuals, from the adjusted state and what led to it."""
    state = fitted.turning
    inverse = np.asarray(np.linalg.inv(fitted.normal_matrix), np.float64)
    lift = _lift(fitted, s, head)
    model = fitted.sigma_px**2 * inverse
    excess = _excess(fitted, s, inverse)
    conditional = lift @ model @ lift.T * excess
    by_intrinsics = lift @ _follow_intrinsics(fitted, s, inverse, camera)
    covariance = conditional.copy()
    if camera.covariance is not None:
        covariance += by_intrinsics @ np.array(camera.covariance) @ by_intrinsics.T
    seen_sense = sense if head == "fixed" else -sense
    # Estimated angles in the controller's own counting.
    angle = sense * state.phi_rad + nominal[0]
    scale, off, eccentricity = _angle_errors(nominal, angle, exact=prior.exact)
    # Two fitted numbers are taken from the frames' freedom.
    spare = len(off) / max(1.0, len(off) - 2.0)
    step = np.diff(off[np.argsort(nominal)])
    return AxisFit(
        point_mm=origin_of(state, s, head),
        direction=state.direction,
        positive_turn="counterclockwise" if seen_sense > 0 else "clockwise",
        head=head,
        covariance=covariance,
        conditional=conditional,
        by_intrinsics=by_intrinsics,
        frames=_frames(fitted, s, names, nominal, angle, off, camera),
        angle_scale=scale,
        step_sd_rad=float(np.sqrt(np.mean(step**2) * spare)),
        eccentricity_rad=eccentricity,
        sigma_px=fitted.sigma_px,
        excess=excess,
        turning=state,
        sightings=s,
        residual_px=fitted.residual_px,
        plane=_plane(state, s),
        left_out=tuple(left),
    )


def _plane(state: Turning, s: Sightings) -> tuple[Floats, float] | None:
    """The plane that all bodies lie in at phi = 0 when it crosses the axis, its normal along it."""
    points = bodies_at_zero(state, s)
    middle = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
    normal = axes[2] if axes[2] @ state.direction > 0 else -axes[2]
    if size[2] > 0.05 * size[1] or normal @ state.direction < 0.7:
        return None
    return normal, float(normal @ middle)


def bodies_at_zero(state: Turning, s: Sightings) -> Floats:
    """Every distinct point of every body in camera space at phi = 0."""
    keys = np.unique(np.concatenate([s.body[:, None], s.points_mm], axis=1), axis=0)
    body = keys[:, 0].astype(np.int64)
    return np.einsum("nij,nj->ni", state.rotations[body], keys[:, 1:]) + state.translations_mm[body]


def origin_of(state: Turning, s: Sightings, head: Head) -> Floats:
    """The origin of turntable space on the axis.

    Where the bodies' plane crosses it (the table's top); else beside the middle of the bodies; for a
    head that turns, beside the camera's centre, as the paper has it.
    """
    a, d = state.point_mm, state.direction
    if head == "rotates":
        return a - d * (a @ d)
    plane = _plane(state, s)
    if plane is not None:
        return a + d * (plane[1] - plane[0] @ a) / (plane[0] @ d)
    middle = bodies_at_zero(state, s).mean(axis=0)
    return a + d * ((middle - a) @ d)


def _lift(fitted: Adjusted, s: Sightings, head: Head) -> Floats:
    """(6, P): how point and direction follow the parameters; by central differences."""
    width = fitted.jacobian.shape[1]
    out = np.zeros((6, width))
    bodies = len(fitted.turning.rotations)
    for k in range(4 + 6 * bodies):
        size = 1e-4
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(width)
            step[k] = sign * size
            moved = moved_by(fitted.turning, step, fitted.across, Prior(fitted.turning.phi_rad, 0.0))
            ends.append(np.concatenate([origin_of(moved, s, head), moved.direction]))
        out[:, k] = (ends[0] - ends[1]) / (2.0 * size)
    return out


def _excess(fitted: Adjusted, s: Sightings, inverse: Floats) -> float:
    """How much more the frames scatter than single corners say: cluster-robust over model variance.

    The mean ratio over the four numbers of the axis; corners of one frame err together (blur, light),
    and then many of them do not help as much as they should.
    """
    frames = np.unique(s.frame)
    if len(frames) < 6:
        return 1.0
    row_frame = np.repeat(s.frame, 2)
    pull = np.repeat(fitted.weight, 2) * fitted.residual_px.ravel()
    gain = inverse[:4] @ fitted.jacobian.T
    each = np.stack([gain[:, row_frame == f] @ pull[row_frame == f] for f in frames])
    model = fitted.sigma_px**2 * inverse[:4, :4]
    robust = each.T @ each * len(frames) / (len(frames) - 2.0)
    return float(max(1.0, np.trace(np.linalg.solve(model, robust)) / 4.0))


def _follow_intrinsics(fitted: Adjusted, s: Sightings, inverse: Floats, camera: Intrinsics) -> Floats:
    """How the parameters follow the ten intrinsics: (P, 10), by the same linear estimate."""
    placed, _, _ = fitted.turning.place(s)
    gain = inverse @ (fitted.jacobian * np.repeat(fitted.weight, 2)[:, None]).T
    return -gain @ pixel_slopes(placed, camera).reshape(-1, 10)


def _angle_errors(nominal: Floats, angle: Floats, *, exact: bool) -> tuple[float, Floats, float]:
    """Scale of the angles, what they are off beyond it, and its once-a-turn part.

    That part is fitted with a slope of its own: over one turn a sine leans, and the plain scale
    has taken some of it.
    """
    if exact:
        return 1.0, angle - nominal, float("nan")
    line = np.stack([nominal, np.ones_like(nominal)], axis=1)
    found = np.linalg.lstsq(line, angle, rcond=None)[0]
    off = angle - line @ found
    if len(nominal) < _LEAST_FOR_SINE or np.ptp(nominal) <= np.pi:
        return float(found[0]), off, float("nan")
    wave = np.concatenate([line, np.cos(nominal)[:, None], np.sin(nominal)[:, None]], axis=1)
    parts = np.linalg.lstsq(wave, angle, rcond=None)[0]
    return float(found[0]), off, float(np.hypot(parts[2], parts[3]))


def _frames(
    fitted: Adjusted,
    s: Sightings,
    names: Sequence[str],
    nominal: Floats,
    angle: Floats,
    off: Floats,
    camera: Intrinsics,
) -> tuple[FrameResidual, ...]:
    state = fitted.turning
    placed, _, _ = state.place(s)
    _, by_point = project_with_slopes(placed, camera)
    arm = placed - state.point_mm
    design = np.concatenate([-by_point @ skew_of(arm), by_point], axis=2)
    out = []
    for k, name in enumerate(names):
        mine = s.frame == k
        rows = design[mine].reshape(-1, 6)
        motion = np.linalg.lstsq(rows, fitted.residual_px[mine].ravel(), rcond=1e-9)[0]
        turn, shift = motion[:3], motion[3:]
        tilt = turn - state.direction * (turn @ state.direction)
        # The shift is meant at the bodies' own height, not at an arbitrary point of the axis.
        height = state.direction * float((arm[mine] @ state.direction).mean())
        shift = shift + np.cross(turn, height)
        aside = fitted.across.T @ shift
        out.append(
            FrameResidual(
                name=name,
                nominal_rad=float(nominal[k]),
                angle_rad=float(angle[k]),
                off_rad=float(off[k]),
                rms_px=float(np.sqrt((fitted.residual_px[mine] ** 2).sum(axis=1).mean())),
                tilt_rad=float(np.linalg.norm(tilt)),
                shift_mm=(float(aside[0]), float(aside[1])),
                rise_mm=float(shift @ state.direction),
                points=int(mine.sum()),
            )
        )
    return tuple(out)
