"""Where a board is, from one view of it: pose with covariance, and how far its points were missed.

A planar board seen once has two poses that explain it nearly as well (its tilt mirrored); both are
offered, the better first, and who knows more (other views, a common axis) may choose the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ...schemas.errors import InputError
from ..camera import distortion_jacobian, project, undistort_points

Floats = npt.NDArray[np.float64]

_STEPS = 30
_LEAST_POINTS = 4


@dataclass(frozen=True)
class BoardPose:
    """``camera = rotation @ board + translation_mm``, found from one view.

    ``normal_matrix`` (6, 6) is the information on (small rotation vector in camera space, rad;
    translation, mm) for corners with a standard deviation of 1 px: covariance = sigma^2 inverse.
    ``residuals_px`` (N, 2) is seen minus predicted.
    """

    rotation: Floats
    translation_mm: Floats
    normal_matrix: Floats
    residuals_px: Floats

    @property
    def normal(self) -> Floats:
        """Unit normal of the board's plane in camera space."""
        return self.rotation[:, 2]

    @property
    def distance_mm(self) -> float:
        """``normal . X`` of the board's plane."""
        return float(self.rotation[:, 2] @ self.translation_mm)

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals of a corner, both coordinates together."""
        return float(np.sqrt((self.residuals_px**2).sum(axis=1).mean()))

    @property
    def sum_of_squares_px2(self) -> float:
        """Sum of squared residuals, of 2 N coordinates less six parameters."""
        return float((self.residuals_px**2).sum())

    @property
    def degrees_of_freedom(self) -> int:
        """Observed coordinates less the six of the pose."""
        return max(1, self.residuals_px.size - 6)

    def to_camera(self, board_mm: Floats) -> Floats:
        """Points (N, 3) of the board in camera space."""
        return board_mm @ self.rotation.T + self.translation_mm

    def covariance(self, sigma_px: float) -> Floats:
        """Covariance (6, 6) of rotation (rad), translation (mm) for corners known to ``sigma_px``."""
        return np.asarray(sigma_px**2 * np.linalg.inv(self.normal_matrix), np.float64)


def rotation_of(vector: npt.ArrayLike) -> Floats:
    """The rotation matrix of a rotation vector (Rodrigues)."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64).reshape(3, 1))[0], np.float64)


def skew_of(v: Floats) -> Floats:
    """The matrices (..., 3, 3) with ``skew_of(v) @ x = cross(v, x)``."""
    out = np.zeros((*np.shape(v), 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def project_with_slopes(points_mm: Floats, camera: Intrinsics) -> tuple[Floats, Floats]:
    """Pixels (N, 2) of points (N, 3) in camera space, and their derivatives (N, 2, 3) by the points."""
    u, v = project(points_mm, camera)
    depth = np.where(points_mm[:, 2] > 0, points_mm[:, 2], np.nan)
    x, y = points_mm[:, 0] / depth, points_mm[:, 1] / depth
    xx, xy, yy = distortion_jacobian(x, y, camera)
    by_x = np.stack([camera.fx_px * (xx + camera.skew * xy), camera.fy_px * xy], axis=1)
    by_y = np.stack([camera.fx_px * (xy + camera.skew * yy), camera.fy_px * yy], axis=1)
    slopes = np.stack([by_x, by_y, -(by_x * x[:, None] + by_y * y[:, None])], axis=2)
    return np.stack([u, v], axis=1), slopes / depth[:, None, None]


def _slopes_by_pose(arm: Floats, slopes: Floats) -> Floats:
    """Derivatives (2 N, 6) of pixels by the pose; ``arm`` (N, 3) is rotation @ board."""
    by_turn = -np.einsum("nij,njk->nik", slopes, skew_of(arm))
    return np.concatenate([by_turn, slopes], axis=2).reshape(-1, 6)


def slopes_by_pose(pose: BoardPose, board_mm: Floats, camera: Intrinsics) -> Floats:
    """Derivatives (2 N, 6) of the board's pixels by its pose, in the order of ``normal_matrix``."""
    arm = board_mm @ pose.rotation.T
    return _slopes_by_pose(arm, project_with_slopes(arm + pose.translation_mm, camera)[1])


def refine_pose(
    corners_px: Floats,
    board_mm: Floats,
    camera: Intrinsics,
    start: tuple[Floats, Floats],
    steps: int = _STEPS,
) -> BoardPose | None:
    """Least squares of the reprojection (Levenberg-Marquardt); None if it runs behind the camera."""
    rotation, translation = start
    damping = 1e-4
    arm = board_mm @ rotation.T
    seen, slopes = project_with_slopes(arm + translation, camera)
    residual = corners_px - seen
    for _ in range(steps):
        jacobian = _slopes_by_pose(arm, slopes)
        normal = jacobian.T @ jacobian
        if not np.isfinite(normal).all():
            return None
        try:
            step = np.linalg.solve(
                normal + damping * np.diag(np.diag(normal)), jacobian.T @ residual.ravel()
            )
        except np.linalg.LinAlgError:
            return None
        new_rotation, new_translation = rotation_of(step[:3]) @ rotation, translation + step[3:]
        new_arm = board_mm @ new_rotation.T
        new_seen, new_slopes = project_with_slopes(new_arm + new_translation, camera)
        new_residual = corners_px - new_seen
        gain = float((residual**2).sum() - (new_residual**2).sum())
        if not np.isfinite(gain) or gain < 0:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        rotation, translation, arm = new_rotation, new_translation, new_arm
        residual, slopes, damping = new_residual, new_slopes, max(damping * 0.1, 1e-12)
        if np.abs(step[:3]).max() < 1e-12 and np.abs(step[3:]).max() < 1e-9:
            break
    jacobian = _slopes_by_pose(arm, slopes)
    normal = jacobian.T @ jacobian
    if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e18:
        return None
    u, _, vt = np.linalg.svd(rotation)
    return BoardPose(u @ vt, translation, normal, residual)


def board_poses(
    corners_px: npt.ArrayLike, board_mm: npt.ArrayLike, camera: Intrinsics
) -> list[BoardPose]:
    """The one or two poses that explain the corners (N, 2) of a flat board (N, 3), the better first.

    Starts from Collins and Bartoli, "Infinitesimal plane-based pose estimation" (IJCV 2014), as in
    OpenCV, on undistorted rays, so that skew is not lost.

    Raises
    ------
    InputError
        There are fewer than four corners, or they lie on one line.
    """
    seen = np.asarray(corners_px, np.float64).reshape(-1, 2)
    board = np.asarray(board_mm, np.float64).reshape(-1, 3)
    if len(seen) < _LEAST_POINTS or len(seen) != len(board):
        raise InputError(f"a pose needs four corners or more, found {len(seen)}")
    spread = np.linalg.svd(board[:, :2] - board[:, :2].mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        raise InputError("the corners of the board lie on one line, which has no pose")
    xn, yn = undistort_points(seen[:, 0], seen[:, 1], camera)
    rays = np.stack([xn, yn], axis=1)
    good = np.isfinite(rays).all(axis=1)
    if good.sum() < _LEAST_POINTS:
        raise InputError("the corners lie where the lens model folds back on itself")
    middle = board.mean(axis=0)
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        board[good] - middle, rays[good], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    out: list[BoardPose] = []
    for turn, shift in zip(turns, shifts, strict=True):
        rotation = rotation_of(np.asarray(turn).ravel())
        start = (rotation, np.asarray(shift, np.float64).ravel() - rotation @ middle)
        pose = refine_pose(seen[good], board[good], camera, start)
        if pose is not None and all(np.abs(pose.rotation - p.rotation).max() > 1e-5 for p in out):
            out.append(pose)
    if not out:
        raise InputError("no pose of the board explains its corners")
    return sorted(out, key=lambda p: p.sum_of_squares_px2)
