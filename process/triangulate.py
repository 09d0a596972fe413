"""Stripe points to scene points: ray, laser plane, turntable, turn (docs/conventions.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import LaserPlane, TurntableAxis

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
