"""The simulated scanner: where its camera and lasers are at an angle, and how its camera projects.

This is a forward model of its own: nothing of process/ is used, so that the two can disagree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...schemas.calibration import Calibration, Intrinsics, LaserPlane
from ...schemas.errors import CalibrationError
from ...schemas.scene import Emitter
from .compiling import compiled
from .rays import Floats

Stripe = Literal["vertical", "horizontal"]

#: A laser's plane that is met by an axis of the camera at less than this sine is not met at all.
_MEETS = 0.1
#: An emitter may lie this far off its plane: numbers in documents are rounded.
_OFF_PLANE_MM = 0.01


def lens(camera: Intrinsics) -> Floats:
    """The intrinsics as numbers: fx fy cx cy skew k1 k2 p1 p2 k3."""
    head = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew)
    return np.array([*head, *camera.distortion], np.float64)


@compiled
def project(c: Floats, x: float, y: float, z: float) -> tuple[float, float]:
    """(u_px, v_px) of a point of camera space: Caltech distortion with skew (paper, formulas 6-11)."""
    a, b = x / z, y / z
    rr = a * a + b * b
    gain = 1.0 + rr * (c[5] + rr * (c[6] + rr * c[9]))
    xd = gain * a + 2.0 * c[7] * a * b + c[8] * (rr + 2.0 * a * a)
    yd = gain * b + c[7] * (rr + 2.0 * b * b) + 2.0 * c[8] * a * b
    return c[0] * (xd + c[4] * yd) + c[2], c[1] * yd + c[3]


@compiled
def _project_all(c: Floats, points: Floats) -> Floats:
    out = np.empty((len(points), 2))
    for i in range(len(points)):
        out[i, 0], out[i, 1] = project(c, points[i, 0], points[i, 1], points[i, 2])
    return out


@compiled
def unproject(c: Floats, u: float, v: float) -> tuple[float, float]:
    """(x / z, y / z) of what is seen at a pixel: Newton's method on :func:`project`.

    nan where the lens model folds over and the pixel shows nothing.
    """
    yd = (v - c[3]) / c[1]
    xd = (u - c[2]) / c[0] - c[4] * yd
    a, b = xd, yd
    for _ in range(30):
        rr = a * a + b * b
        gain = 1.0 + rr * (c[5] + rr * (c[6] + rr * c[9]))
        slope = 2.0 * (c[5] + rr * (2.0 * c[6] + rr * 3.0 * c[9]))
        fa = gain * a + 2.0 * c[7] * a * b + c[8] * (rr + 2.0 * a * a) - xd
        fb = gain * b + c[7] * (rr + 2.0 * b * b) + 2.0 * c[8] * a * b - yd
        faa = gain + slope * a * a + 2.0 * c[7] * b + 6.0 * c[8] * a
        fab = slope * a * b + 2.0 * c[7] * a + 2.0 * c[8] * b
        fbb = gain + slope * b * b + 6.0 * c[7] * b + 2.0 * c[8] * a
        det = faa * fbb - fab * fab
        if not det > 0.0:
            return math.nan, math.nan
        da, db = (fbb * fa - fab * fb) / det, (faa * fb - fab * fa) / det
        a, b = a - da, b - db
        if abs(da) + abs(db) < 1e-15:
            break
    return a, b


@compiled
def unproject_all(c: Floats, pixels: Floats) -> Floats:
    """(N, 2) undistorted ray coordinates of pixels (N, 2)."""
    out = np.empty((len(pixels), 2))
    for i in range(len(pixels)):
        out[i, 0], out[i, 1] = unproject(c, pixels[i, 0], pixels[i, 1])
    return out


def forward_project(points_camera_mm: Floats, camera: Intrinsics) -> tuple[Floats, Floats]:
    """(u_px, v_px) of points (N, 3) in camera space, lens distortion and skew included."""
    at = _project_all(lens(camera), np.ascontiguousarray(points_camera_mm, np.float64))
    return at[:, 0], at[:, 1]


def view(camera: Intrinsics, across: int = 65) -> Floats:
    """Undistorted rays (N, 2) of an even grid of pixels over the frame, its border included."""
    u = np.linspace(-0.5, camera.width_px - 0.5, across)
    v = np.linspace(-0.5, camera.height_px - 0.5, across)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = unproject_all(lens(camera), pixels)
    if np.isnan(rays).any():
        raise CalibrationError(
            "the camera's distortion folds the picture over inside the frame",
            hint="correct the distortion of the calibration: such a lens cannot be simulated",
        )
    return rays


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
class Fan:
    """One laser's fan of light in camera space: emitter (3,), unit vectors of the fan (3,), its limits.

    A ray at ``angle`` goes along ``cos(angle) middle + sin(angle) side``; only the angles that the
    camera can see are listed. ``stripe`` says whether truth has a point a row or a point a column.
    """

    laser: int
    emitter_mm: Floats
    middle: Floats
    side: Floats
    first_rad: float
    last_rad: float
    stripe: Stripe
    shine: Emitter

    def directions(self, angle_rad: Floats) -> Floats:
        """Unit directions (N, 3) in camera space."""
        return np.cos(angle_rad)[:, None] * self.middle + np.sin(angle_rad)[:, None] * self.side


def fan_of(plane: LaserPlane, shine: Emitter, camera: Intrinsics) -> Fan:
    """The fan of a laser; CalibrationError where document and calibration do not fit together."""
    n = np.array(plane.normal)
    emitter = _emitter(plane, shine)
    aim = np.array(shine.aim if shine.aim is not None else (0.0, 0.0, 1.0))
    middle = aim - n * (n @ aim)
    if np.linalg.norm(middle) < _MEETS * np.linalg.norm(aim):
        raise CalibrationError(
            f"the fan of laser {plane.laser} has no direction: its aim is square to its plane",
            hint=f"give laser {plane.laser} of the scene an aim that lies in its plane",
        )
    middle /= np.linalg.norm(middle)
    side = np.cross(n, middle)
    stripe: Stripe = shine.stripe or ("vertical" if abs(n[0]) >= abs(n[1]) else "horizontal")
    side = side if side[1 if stripe == "vertical" else 0] > 0 else -side
    rays = view(camera)
    rays = np.column_stack([rays, np.ones(len(rays))])
    towards = rays @ n
    with np.errstate(divide="ignore"):
        reach = plane.distance_mm / towards
    seen = np.where(np.isfinite(reach) & (reach > 0), reach, math.inf)[:, None]
    with np.errstate(invalid="ignore"):
        # Where a ray meets the plane; far away a ray that hardly leaves it, as seen from the emitter.
        away = np.where(seen < 1e9, rays * seen - emitter, rays - n * towards[:, None])
    angle = np.arctan2(away @ side, away @ middle)
    half = math.radians(shine.fan_deg) / 2
    margin = 0.02 * float(angle.max() - angle.min())
    first, last = max(-half, float(angle.min()) - margin), min(half, float(angle.max()) + margin)
    return Fan(plane.laser, emitter, middle, side, first, last, stripe, shine)


def _emitter(plane: LaserPlane, shine: Emitter) -> Floats:
    n = np.array(plane.normal)
    if shine.emitter_mm is not None:
        emitter = np.array(shine.emitter_mm)
        off = float(n @ emitter) - plane.distance_mm
        if abs(off) > _OFF_PLANE_MM:
            raise CalibrationError(
                f"the emitter of laser {plane.laser} lies {off:.3g} mm off that laser's plane",
                hint="correct emitter_mm in the scene, or leave it out",
            )
        return emitter - off * n
    axis = 0 if abs(n[0]) >= abs(n[1]) else 1
    if abs(n[axis]) < _MEETS:
        raise CalibrationError(
            f"the plane of laser {plane.laser} hardly meets the camera's X and Y axes",
            hint=f"say where it stands: emitter_mm of laser {plane.laser} in the scene",
        )
    out = np.zeros(3)
    out[axis] = plane.distance_mm / n[axis]
    return out


class SimulatedRig:
    """Camera, lasers and turntable as a calibration describes them.

    Parameters
    ----------
    calibration
        Must hold the camera and the plane of each laser; for :meth:`pose` also the turntable.
    lasers
        Which lasers there are; left out: all of the calibration.
    emitters
        How lasers shine, from the scene document; the others shine as :class:`Emitter` says.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        lasers: Iterable[int] | None = None,
        emitters: Iterable[Emitter] = (),
    ) -> None:
        self.calibration = calibration
        self.camera: Intrinsics = calibration.intrinsics_or_fail()
        self.lens = lens(self.camera)
        shine = {emitter.laser: emitter for emitter in emitters}
        wanted = [p.laser for p in calibration.lasers] if lasers is None else list(lasers)
        planes = {n: calibration.plane_or_fail(n) for n in wanted}
        self.fans: dict[int, Fan] = {
            n: fan_of(plane, shine.get(n) or Emitter(laser=n), self.camera)
            for n, plane in planes.items()
        }
        rays = view(self.camera)
        #: Beyond this the lens model may fold back into the frame: nothing is seen there.
        self.view_radius: float = 1.02 * float(np.sqrt((rays**2).sum(axis=1)).max())

    def plane(self, laser: int = 0) -> LaserPlane:
        """The plane of a laser in camera space."""
        return self.calibration.plane_or_fail(laser)

    def fan(self, laser: int) -> Fan:
        """The fan of a laser, or a CalibrationError that says there is none."""
        if laser not in self.fans:
            raise CalibrationError(
                f"laser {laser} is lit, but the simulated rig has lasers {sorted(self.fans)}",
                hint="give each laser of the rig file a plane in its calibration",
            )
        return self.fans[laser]

    def pose(self, angle_rad: float) -> Pose:
        """Where the camera is in the scene when the turntable stands at ``angle_rad``."""
        axis = self.calibration.axis_or_fail()
        x, y, z = (np.array(a) for a in axis.camera_from_turntable())
        turn = axis.turn_sign() * angle_rad
        cos, sin = math.cos(turn), math.sin(turn)
        # Scene axes in turntable space, turned back; then in camera space by its own unit vectors.
        rows = np.array([cos * x - sin * y, sin * x + cos * y, z])
        return Pose(rows, -rows @ np.array(axis.point_mm))
