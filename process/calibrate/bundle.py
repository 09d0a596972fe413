"""Least squares over one camera and the poses of its boards, by Gauss-Newton with damping.

OpenCV has no skew and gives no covariance of all parameters together, so its result is only the start
here. Each pose touches its own points alone: it is eliminated from the normal equations (Schur
complement), which leaves ten unknowns or fewer however many views there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.errors import CalibrationError
from .boards import BoardView
from .projection import project_points, project_with_derivatives, rotation_of

Floats = npt.NDArray[np.float64]

_STEPS = 60
#: Converged when a step wins less than this share of the squared residuals, or next to nothing.
_CONVERGED = 1e-13
_NOTHING_PX2 = 1e-18


@dataclass(frozen=True)
class Bundle:
    """The solution: ten camera parameters, poses, residuals, and the views' normal equations.

    ``free`` (10, m) maps the m estimated unknowns to the ten parameters. ``residuals_px`` has (N,
    2) a view: seen minus projected. ``normal`` (V, m, m) is what each view adds to the reduced
    normal matrix, ``slope`` (V, m) to the gradient; sum over the views, both weighted by 1 /
    sigma^2 with ``weights``.
    """

    camera: Floats
    rotations: Floats
    shifts_mm: Floats
    residuals_px: list[Floats]
    free: Floats
    normal: Floats
    slope: Floats
    weights: Floats

    @property
    def degrees_of_freedom(self) -> int:
        """Observations minus unknowns."""
        seen = sum(r.size for r in self.residuals_px)
        return int(seen - self.free.shape[1] - 6 * len(self.residuals_px))

    def view_rms_px(self) -> Floats:
        """Root mean square distance (2-D) of seen and projected corners, a view each."""
        return np.array([np.sqrt((r * r).sum(axis=1).mean()) for r in self.residuals_px])

    def rms_px(self) -> float:
        """The same over all corners; it is OpenCV's rms."""
        every = np.concatenate(self.residuals_px)
        return float(np.sqrt((every * every).sum(axis=1).mean()))

    def noise_px(self) -> float:
        """Standard deviation of one coordinate of one corner, by residuals and degrees of freedom."""
        total = sum(
            float(w * (r * r).sum()) for w, r in zip(self.weights, self.residuals_px, strict=True)
        )
        return float(np.sqrt(total / self.degrees_of_freedom))


def solve_bundle(
    views: Sequence[BoardView],
    camera: Floats,
    rotations: Floats,
    shifts_mm: Floats,
    free: Floats,
    weights: Floats | None = None,
) -> Bundle:
    """Minimise the weighted squared residuals, from a start that is near.

    ``rotations`` (V, 3, 3) and ``shifts_mm`` (V, 3) are ``camera_from_board``; ``free`` is (10, m): the
    parameters move by ``free @ x``. ``weights`` (V,) default to 1.

    Raises
    ------
    CalibrationError
        The views do not fix the unknowns, or no minimum is reached.
    """
    weights = np.ones(len(views)) if weights is None else weights
    if sum(2 * len(v.ids) for v in views) <= free.shape[1] + 6 * len(views):
        raise CalibrationError(
            f"{len(views)} views hold fewer observations than there are unknowns",
            hint="add views, or estimate less (--fix)",
        )
    camera, rotations, shifts_mm = camera.copy(), rotations.copy(), shifts_mm.copy()
    now = _linearised(views, camera, rotations, shifts_mm, free, weights)
    damping = 0.0
    for _ in range(_STEPS):
        try:
            x, poses = now.step(damping)
        except np.linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
            continue
        trial = (
            camera + free @ x,
            rotation_of(poses[:, :3]) @ rotations,
            shifts_mm + poses[:, 3:],
        )
        gain = now.gain(x, poses)
        if _cost(views, *trial, weights) <= now.cost:
            camera, rotations, shifts_mm = trial
            now = _linearised(views, camera, rotations, shifts_mm, free, weights)
            if damping < 1e-6 and gain <= _CONVERGED * now.cost + _NOTHING_PX2:
                return now.bundle(camera, rotations, shifts_mm)
            damping *= 0.1 if damping > 1e-9 else 0.0
        elif gain <= 1e3 * (_CONVERGED * now.cost + _NOTHING_PX2):
            # What could still be won is lost in rounding.
            return now.bundle(camera, rotations, shifts_mm)
        else:
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e12:
                break
    raise CalibrationError(
        "the camera could not be solved: the views do not fix what is to be estimated",
        hint="tilt the board in several directions, or estimate less (--fix)",
    )


@dataclass(frozen=True)
class _Linearised:
    """Normal equations at one point, the poses' blocks apart."""

    cost: float
    free: Floats
    residuals: list[Floats]
    weights: Floats
    a: Floats  # (V, m, m) camera block
    b: Floats  # (V, m, 6) mixed
    c: Floats  # (V, 6, 6) pose block
    ga: Floats  # (V, m)
    gc: Floats  # (V, 6)

    def _reduced(self, damping: float) -> tuple[Floats, Floats, Floats]:
        c = self.c * (1.0 + damping * np.eye(6))
        back = np.linalg.solve(
            c, np.concatenate([self.b.transpose(0, 2, 1), self.gc[..., None]], axis=2)
        )
        normal = self.a - self.b @ back[:, :, :-1]
        slope = self.ga - (self.b @ back[:, :, -1:])[..., 0]
        return normal, slope, back

    def step(self, damping: float) -> tuple[Floats, Floats]:
        normal, slope, back = self._reduced(damping)
        total = normal.sum(axis=0)
        total = total + damping * np.diag(np.diag(self.a.sum(axis=0)))
        # Scaled to a unit diagonal, so that the test for singularity means the same for all unknowns.
        scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
        x = scale * np.linalg.solve(total * np.outer(scale, scale), scale * slope.sum(axis=0))
        return x, back[:, :, -1] - back[:, :, :-1] @ x

    def gain(self, x: Floats, poses: Floats) -> float:
        """What the linear model says that the step wins."""
        return float(abs(self.ga.sum(axis=0) @ x + (self.gc * poses).sum()))

    def bundle(self, camera: Floats, rotations: Floats, shifts_mm: Floats) -> Bundle:
        normal, slope, _ = self._reduced(0.0)
        return Bundle(
            camera, rotations, shifts_mm, self.residuals, self.free, normal, slope, self.weights
        )


def _in_camera(
    views: Sequence[BoardView], rotations: Floats, shifts_mm: Floats
) -> tuple[Floats, Floats]:
    turned = np.concatenate([v.points_mm @ r.T for v, r in zip(views, rotations, strict=True)])
    shift = np.repeat(shifts_mm, [len(v.ids) for v in views], axis=0)
    return turned, turned + shift


def _cost(
    views: Sequence[BoardView], camera: Floats, rotations: Floats, shifts_mm: Floats, weights: Floats
) -> float:
    _, points = _in_camera(views, rotations, shifts_mm)
    if (points[:, 2] <= 0).any() or camera[0] <= 0 or camera[1] <= 0:
        return float("inf")
    off = np.concatenate([v.points_px for v in views]) - project_points(camera, points)
    each = np.repeat(weights, [len(v.ids) for v in views])
    return float((each * (off * off).sum(axis=1)).sum())


def _linearised(
    views: Sequence[BoardView],
    camera: Floats,
    rotations: Floats,
    shifts_mm: Floats,
    free: Floats,
    weights: Floats,
) -> _Linearised:
    turned, points = _in_camera(views, rotations, shifts_mm)
    pixels, by_camera, by_pose = project_with_derivatives(camera, points, turned)
    off = np.concatenate([v.points_px for v in views]) - pixels
    m, count = free.shape[1], len(views)
    # Unknowns of the camera, of the pose and the residual side by side: one product a view gives all.
    rows = np.concatenate([by_camera @ free, by_pose, off[..., None]], axis=2)
    products = np.empty((count, m + 7, m + 7))
    residuals = []
    at = 0
    for i, view in enumerate(views):
        n = len(view.ids)
        block = rows[at : at + n].reshape(2 * n, m + 7)
        products[i] = weights[i] * (block.T @ block)
        residuals.append(off[at : at + n])
        at += n
    return _Linearised(
        cost=float(products[:, -1, -1].sum()),
        free=free,
        residuals=residuals,
        weights=weights,
        a=products[:, :m, :m],
        b=products[:, :m, m : m + 6],
        c=products[:, m : m + 6, m : m + 6],
        ga=products[:, :m, -1],
        gc=products[:, m : m + 6, -1],
    )
