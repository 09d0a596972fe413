"""The simulated scanner: where its camera and laser are at an angle, and how its camera projects.

This is a forward model of its own: nothing of process/ is used, so that the two can disagree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Calibration, Intrinsics, LaserPlane
from ...schemas.errors import CalibrationError

Floats = npt.NDArray[np.float64]


def forward_project(points_camera_mm: Floats, camera: Intrinsics) -> tuple[Floats, Floats]:
    """(u_px, v_px) of points (N, 3) in camera space, lens distortion and skew included."""
    a = points_camera_mm[:, 0] / points_camera_mm[:, 2]
    b = points_camera_mm[:, 1] / points_camera_mm[:, 2]
    k1, k2, p1, p2, k3 = camera.distortion
    rr = a**2 + b**2
    gain = 1 + k1 * rr + k2 * rr**2 + k3 * rr**3
    da = 2 * p1 * a * b + p2 * (rr + 2 * a**2)
    db = p1 * (rr + 2 * b**2) + 2 * p2 * a * b
    xd, yd = gain * a + da, gain * b + db
    u = camera.fx_px * xd + camera.fx_px * camera.skew * yd + camera.cx_px
    return u, camera.fy_px * yd + camera.cy_px


@dataclass(frozen=True)
class Pose:
    """Camera and laser in scene space at one angle: rotation columns are the camera's axes."""

    scene_from_camera: Floats
    camera_mm: Floats

    def to_scene(self, points_camera_mm: Floats) -> Floats:
        """Points (N, 3) of camera space in the scene."""
        return points_camera_mm @ self.scene_from_camera.T + self.camera_mm

    def to_camera(self, points_scene_mm: Floats) -> Floats:
        """Points (N, 3) of the scene in camera space."""
        return (points_scene_mm - self.camera_mm) @ self.scene_from_camera


@dataclass(frozen=True)
class SimulatedRig:
    """Camera and one laser as a calibration describes them; the emitter lies on the camera's X axis."""

    calibration: Calibration
    laser: int = 0

    @property
    def camera(self) -> Intrinsics:
        """The camera's intrinsics."""
        return self.calibration.intrinsics_or_fail()

    @property
    def plane(self) -> LaserPlane:
        """The laser's plane in camera space."""
        return self.calibration.plane_or_fail(self.laser)

    def emitter_mm(self) -> Floats:
        """The laser's centre in camera space."""
        if abs(self.plane.normal[0]) < 0.1:
            raise CalibrationError(
                f"the plane of laser {self.laser} hardly meets the camera's X axis",
                hint="simulate a laser that stands beside the camera",
            )
        return np.array([self.plane.distance_mm / self.plane.normal[0], 0.0, 0.0])

    def fan(self, angle_rad: Floats) -> Floats:
        """Unit directions (N, 3) in camera space in the laser plane; 0 is level, positive is down."""
        n = np.array(self.plane.normal)
        level = np.array([-n[2], 0.0, n[0]]) / math.hypot(n[0], n[2])
        if level[2] < 0:
            level = -level
        down = np.cross(n, level)
        down = down if down[1] > 0 else -down
        return np.cos(angle_rad)[:, None] * level + np.sin(angle_rad)[:, None] * down

    def pose(self, angle_rad: float) -> Pose:
        """Where the camera is in the scene when the turntable stands at ``angle_rad``."""
        axis = self.calibration.axis_or_fail()
        x, y, z = (np.array(a) for a in axis.camera_from_turntable())
        turn = axis.turn_sign() * angle_rad
        cos, sin = math.cos(turn), math.sin(turn)
        # Scene axes in turntable space, turned back; then in camera space by its own unit vectors.
        rows = np.array([cos * x - sin * y, sin * x + cos * y, z])
        return Pose(rows, -rows @ np.array(axis.point_mm))
