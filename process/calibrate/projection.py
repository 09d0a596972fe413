"""Projection of board points with skew, and its derivatives by camera parameters and by pose.

Parameters, in the order of every covariance here: fx fy cx cy skew k1 k2 p1 p2 k3 (Caltech/OpenCV
model, u = fx (xd + skew yd) + cx, v = fy yd + cy). A pose is (R, t), ``camera_from_board``; its
increments are a rotation vector w applied from the left, exp(w) R, and a shift of t in mm.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

#: Names of the camera parameters in their fixed order.
NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "skew", "k1", "k2", "p1", "p2", "k3")


def rotation_of(vector: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    safe = np.where(angle < 1e-8, 1.0, angle)
    zero = np.zeros(vector.shape[:-1])
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)
    first = np.where(angle < 1e-8, 1.0, np.sin(safe) / safe)
    second = np.where(angle < 1e-8, 0.5, (1.0 - np.cos(safe)) / (safe * safe))
    return np.eye(3) + first * cross + second * (cross @ cross)


def project_points(camera: Floats, points_camera_mm: Floats) -> Floats:
    """(u, v) px (N, 2) of points (N, 3) in camera space; ``camera`` holds the ten parameters."""
    fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = camera
    z = points_camera_mm[:, 2]
    x, y = points_camera_mm[:, 0] / z, points_camera_mm[:, 1] / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fx * (xd + skew * yd) + cx, fy * yd + cy], axis=1)


def project_with_derivatives(
    camera: Floats, points_camera_mm: Floats, turned_mm: Floats
) -> tuple[Floats, Floats, Floats]:
    """Projection and its derivatives.

    ``turned_mm`` (N, 3) are the points before the shift, R X. Returns pixels (N, 2), derivatives by the
    camera (N, 2, 10) and by the pose's increments (N, 2, 6): rotation first, then the shift in mm.
    """
    fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = camera
    n = len(points_camera_mm)
    z = points_camera_mm[:, 2]
    x, y = points_camera_mm[:, 0] / z, points_camera_mm[:, 1] / z
    r2 = x * x + y * y
    r4 = r2 * r2
    radial = 1.0 + k1 * r2 + k2 * r4 + k3 * r4 * r2
    xy = x * y
    xd = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * xy
    # Of (xd, yd): by the five coefficients, then by (x, y).
    lens = np.empty((n, 2, 5))
    for i, power in ((0, r2), (1, r4), (4, r4 * r2)):
        lens[:, 0, i], lens[:, 1, i] = x * power, y * power
    lens[:, 0, 2], lens[:, 1, 2] = 2.0 * xy, r2 + 2.0 * y * y
    lens[:, 0, 3], lens[:, 1, 3] = r2 + 2.0 * x * x, 2.0 * xy
    slope = 2.0 * (k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4)
    mixed = xy * slope + 2.0 * p1 * x + 2.0 * p2 * y
    bend = np.empty((n, 2, 2))
    bend[:, 0, 0] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    bend[:, 0, 1] = bend[:, 1, 0] = mixed
    bend[:, 1, 1] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    scale = np.array([[fx, fx * skew], [0.0, fy]])
    by_camera = np.zeros((n, 2, 10))
    by_camera[:, 0, 0] = xd + skew * yd
    by_camera[:, 1, 1] = yd
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, 0, 4] = fx * yd
    by_camera[:, :, 5:] = scale @ lens
    by_xyz = np.zeros((n, 2, 3))
    by_xyz[:, 0, 0] = by_xyz[:, 1, 1] = 1.0 / z
    by_xyz[:, 0, 2], by_xyz[:, 1, 2] = -x / z, -y / z
    by_xyz = scale @ (bend @ by_xyz)
    by_pose = np.empty((n, 2, 6))
    # exp(w) p = p + w x p, so the derivative by w is (row x)-wise p x row.
    by_pose[:, :, :3] = np.cross(turned_mm[:, None, :], by_xyz)
    by_pose[:, :, 3:] = by_xyz
    pixels = np.stack([by_camera[:, 0, 0] * fx + cx, fy * yd + cy], axis=1)
    return pixels, by_camera, by_pose
