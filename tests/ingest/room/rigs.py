"""Rigs, scenes and truths that the tests of the simulated room share."""

from __future__ import annotations

import numpy as np

from turnscan.ingest.room.render import Truth, render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, PaperCalibration
from turnscan.schemas.scene import Box, Cylinder, Light, Room, Sensor, Shape, Sphere

LENS = (-0.21, 0.16, 0.0008, -0.0004, 0.01)
DARK = Light(ambient_dn=0.0)
QUIET = Sensor(noise_dn=0.0, shot_dn_per_dn=0.0)


def box(low: tuple[float, ...], high: tuple[float, ...], kind: type[Box | Room] = Box) -> Box | Room:
    """A block by two of its corners."""
    a, b = np.array(low, float), np.array(high, float)
    word = "box" if kind is Box else "room"
    return kind(kind=word, at_mm=tuple(((a + b) / 2).tolist()), size_mm=tuple((b - a).tolist()))


def ball(centre: tuple[float, ...], radius: float) -> Sphere:
    return Sphere(kind="sphere", at_mm=centre, radius_mm=radius)


def pillar(x: float, y: float, radius: float) -> Cylinder:
    return Cylinder(kind="cylinder", at_mm=(x, y, 0.0), radius_mm=radius)


ROOM = box((-3000.0, -2000.0, -1200.0), (4000.0, 2500.0, 1400.0), Room)


def wall(y_mm: float = 2000.0, *more: Shape) -> Scene:
    """One wall across the camera's view; the others are far behind everything."""
    return Scene([box((-1e5, -1e5, -1e5), (1e5, y_mm, 1e5), Room), *more])


def paper(*, distortion: tuple[float, ...] = (0.0,) * 5, skew: float = 0.0) -> Calibration:
    return PaperCalibration(
        rig="sim",
        width_px=640,
        height_px=480,
        f_px=760.0,
        cx_px=318.5,
        cy_px=241.25,
        skew=skew,
        distortion=distortion,
        L_mm=300.0,
        D_mm=300.0,
        theta_rad=1.2,
        c_mm=0.0,
    ).calibration()


def rig(*, distortion: tuple[float, ...] = (0.0,) * 5, skew: float = 0.0) -> SimulatedRig:
    """Camera at the scene's origin, looking along +y at angle 0; laser 300 mm to its right."""
    return SimulatedRig(paper(distortion=distortion, skew=skew))


def with_planes(*planes: LaserPlane, distortion: tuple[float, ...] = (0.0,) * 5) -> Calibration:
    """The same camera with other lasers."""
    return paper(distortion=distortion).model_copy(update={"lasers": planes})


def small_camera() -> Intrinsics:
    return Intrinsics(width_px=160, height_px=120, fx_px=190, fy_px=191, cx_px=80.2, cy_px=59.1)


def truth_of(scene: Scene, a: SimulatedRig, angle: float = 0.0, laser: int = 0) -> Truth:
    return render(scene, a, angle, seed=0, lasers=[laser], light=DARK, sensor=QUIET).truth[laser]
