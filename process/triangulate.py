"""Stripe points to scene points: ray, laser plane, turntable, turn (docs/conventions.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import LaserPlane, TurntableAxis
from .compiled import exact_kernel

Floats = npt.NDArray[np.float64]


def intersect(xn: npt.ArrayLike, yn: npt.ArrayLike, plane: LaserPlane) -> Floats:
    """Points (N, 3) in camera space where the rays (xn, yn, 1) meet the laser plane.

    NaN for a ray along the plane, or one that meets it behind the camera.
    """
    x, y = np.asarray(xn, np.float64), np.asarray(yn, np.float64)
    nx, ny, nz = plane.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = plane.distance_mm / (nx * x + ny * y + nz)
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
        return np.stack([depth * x, depth * y, depth], axis=-1)


@dataclass(frozen=True)
class Rigid:
    """``target = rotation @ source + translation_mm``; named target_from_source where it is used."""

    rotation: Floats
    translation_mm: Floats

    def __call__(self, points_mm: Floats) -> Floats:
        """Points (..., 3) of the source space in the target space."""
        return points_mm @ self.rotation.T + self.translation_mm


def turntable_from_camera(axis: TurntableAxis) -> Rigid:
    """Camera space to turntable space."""
    rotation = np.array(axis.camera_from_turntable(), np.float64)
    return Rigid(rotation, -rotation @ np.array(axis.point_mm, np.float64))


def scene_from_turntable(points_mm: Floats, angle_rad: npt.ArrayLike, axis: TurntableAxis) -> Floats:
    """Points (N, 3) in turntable space, turned by Rz(s angle) into the scene (s: the axis' sign)."""
    turn = axis.turn_sign() * np.asarray(angle_rad, np.float64)
    cos, sin = np.cos(turn), np.sin(turn)
    x, y, z = points_mm[..., 0], points_mm[..., 1], points_mm[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def range_of(points_camera_mm: Floats) -> Floats:
    """Distance of points in camera space from the camera's centre."""
    return np.sqrt(np.einsum("...i,...i->...", points_camera_mm, points_camera_mm))


def scene_points(
    xn: Floats, yn: Floats, angle_rad: npt.NDArray[np.floating], plane: LaserPlane, axis: TurntableAxis
) -> tuple[Floats, Floats]:
    """Scene points (3, N) and their range (N,), in mm, of ideal rays (xn, yn, 1): all of it at once.

    NaN for a ray along the laser plane, or one that meets it behind the camera.
    """
    xyz, distance = np.empty((3, len(xn)), np.float64), np.empty(len(xn), np.float64)
    scene_points_into(
        xn,
        yn,
        np.asarray(angle_rad, np.float64),
        plane_numbers(plane),
        axis_numbers(axis),
        xyz,
        distance,
    )
    return xyz, distance


def plane_numbers(plane: LaserPlane) -> tuple[float, float, float, float]:
    """nx, ny, nz and distance_mm, as the kernels take them."""
    nx, ny, nz = plane.normal
    return float(nx), float(ny), float(nz), float(plane.distance_mm)


def axis_numbers(axis: TurntableAxis) -> Floats:
    """turntable_from_camera, row by row, then its shift in mm, then the sign of the turn: (13,)."""
    rigid = turntable_from_camera(axis)
    return np.array([*rigid.rotation.ravel(), *rigid.translation_mm, axis.turn_sign()], np.float64)


@exact_kernel
def scene_points_into(
    xn: Floats,
    yn: Floats,
    angle_rad: Floats,
    plane: tuple[float, float, float, float],
    axis: Floats,
    xyz: Floats,
    distance: Floats,
) -> None:
    """As :func:`scene_points`, into ``xyz`` (3, at least N) and ``distance``."""
    n = len(xn)
    nx, ny, nz, h = plane
    r00, r01, r02, r10, r11, r12 = axis[0], axis[1], axis[2], axis[3], axis[4], axis[5]
    r20, r21, r22, t0, t1, t2 = axis[6], axis[7], axis[8], axis[9], axis[10], axis[11]
    sign = axis[12]
    cos, sin = np.empty(n, np.float64), np.empty(n, np.float64)
    last, c, s = np.nan, 1.0, 0.0
    for i in range(n):
        # The points of one frame follow each other and share its angle.
        if angle_rad[i] != last:
            last = angle_rad[i]
            c, s = math.cos(sign * last), math.sin(sign * last)
        cos[i], sin[i] = c, s
    for i in range(n):
        x, y = xn[i], yn[i]
        depth = h / (nx * x + ny * y + nz)
        depth = depth if (depth > 0.0) & (depth < np.inf) else np.nan
        distance[i] = depth * math.sqrt(x * x + y * y + 1.0)
        a, b = depth * x, depth * y
        tx = r00 * a + r01 * b + r02 * depth + t0
        ty = r10 * a + r11 * b + r12 * depth + t1
        xyz[0, i] = cos[i] * tx - sin[i] * ty
        xyz[1, i] = sin[i] * tx + cos[i] * ty
        xyz[2, i] = r20 * a + r21 * b + r22 * depth + t2
