"""Scenes and calibrations that need no file: the paper's room, and things on a desk scanner."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from ...schemas.calibration import (
    Calibration,
    Intrinsics,
    LaserPlane,
    PaperCalibration,
    TurntableAxis,
)
from ...schemas.scene import (
    Box,
    Cylinder,
    Emitter,
    Light,
    Mesh,
    Plane,
    Room,
    SceneDocument,
    Sensor,
    Sphere,
)


def room_document() -> SceneDocument:
    """A room of 8 x 6 x 2.6 m with a pillar, boxes and balls; the scanner stands off its middle."""
    shapes = (
        Room(kind="room", at_mm=(1200, 400, 200), size_mm=(8000, 6000, 2600), albedo=0.85),
        Cylinder(kind="cylinder", at_mm=(350, 650, 0), radius_mm=90, albedo=0.6),
        Box(kind="box", at_mm=(1550, 1200, -475), size_mm=(700, 600, 1250), albedo=0.7),
        Box(kind="box", at_mm=(-1550, -1100, -375), size_mm=(700, 800, 1450), albedo=0.5),
        Sphere(kind="sphere", at_mm=(-300, -1500, 50), radius_mm=300, albedo=0.9),
        Sphere(kind="sphere", at_mm=(2900, -900, -300), radius_mm=400, albedo=0.9),
    )
    return SceneDocument(name="room", shapes=shapes)


def room_calibration() -> Calibration:
    """The paper's camera (section 3.1.2) with a laser at 300 mm, seeing from 0.4 to 7 m."""
    return PaperCalibration(
        rig="demo",
        note="simulated; camera intrinsics of Xiao et al. 2015",
        width_px=640,
        height_px=480,
        f_px=762.0,
        cx_px=296.92665,
        cy_px=271.50956,
        distortion=(-0.20997, 0.1649, 0.0008, -0.00001, 0.0),
        L_mm=300.0,
        D_mm=150.0,
        theta_rad=math.atan2(1.0, 0.4),
        c_mm=40.0,
    ).calibration()


def desk_document() -> SceneDocument:
    """Things on a turntable of 200 mm: a ball, a rod, a leaning block, a pyramid; the desk below."""
    pyramid = Mesh(
        kind="mesh",
        at_mm=(-35, -35, 0),
        turn_deg=(0, 0, 20),
        albedo=0.65,
        vertices_mm=((-18, -18, 0), (18, -18, 0), (18, 18, 0), (-18, 18, 0), (0, 0, 45)),
        triangles=((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    )
    shapes = (
        Cylinder(kind="cylinder", at_mm=(0, 0, -5), radius_mm=100, height_mm=10, albedo=0.3),
        Sphere(kind="sphere", at_mm=(35, 20, 25), radius_mm=25, albedo=0.9),
        Cylinder(kind="cylinder", at_mm=(-40, 30, 30), radius_mm=12, height_mm=60, albedo=0.6),
        Box(
            kind="box",
            at_mm=(20, -40, 20),
            size_mm=(40, 30, 36),
            turn_deg=(0, 12, 35),
            albedo=0.75,
        ),
        pyramid,
        Plane(kind="plane", at_mm=(0, 0, -40), albedo=0.2),
    )
    light = Light(
        ambient_dn=10,
        ambient_gradient_dn=(4, -6),
        stripe_sigma_px=1.2,
        focus_mm=380,
        aperture_mm=1.0,
    )
    sensor = Sensor(noise_dn=1.5, shot_dn_per_dn=0.03, speckle_contrast=0.15)
    lasers = tuple(
        Emitter(
            laser=n,
            stripe_dn_at_1m=75.0,
            line_sigma_mm=0.15,
            waist_at_mm=350,
            rayleigh_mm=400,
            fan_deg=60,
        )
        for n in (0, 1)
    )
    return SceneDocument(name="desk", light=light, sensor=sensor, lasers=lasers, shapes=shapes)


def desk_calibration() -> Calibration:
    """A desk scanner with a fixed head, as the Ciclop: 350 mm off the table, a laser on each side."""
    tilt = math.radians(25.0)
    across = math.radians(30.0)
    planes = []
    for n, side in ((0, 1.0), (1, -1.0)):
        normal = (side * math.cos(across), 0.0, math.sin(across))
        # Both sheets pass through the table's axis where the camera looks at it.
        planes.append(LaserPlane(laser=n, normal=normal, distance_mm=350.0 * normal[2]))
    return Calibration(
        rig="desk",
        note="simulated; a fixed head with two lasers",
        camera=Intrinsics(
            width_px=640,
            height_px=480,
            fx_px=980.0,
            fy_px=978.0,
            cx_px=322.5,
            cy_px=238.0,
            skew=0.0004,
            distortion=(0.11, -0.19, -0.0011, -0.0016, 0.0),
        ),
        lasers=tuple(planes),
        turntable=TurntableAxis(
            point_mm=(0.0, 25.0, 350.0),
            direction=(0.0, -math.cos(tilt), -math.sin(tilt)),
            head="fixed",
        ),
    )


BUILT_IN_SCENES: Final[dict[str, Callable[[], SceneDocument]]] = {
    "room": room_document,
    "desk": desk_document,
}
BUILT_IN_CALIBRATIONS: Final[dict[str, Callable[[], Calibration]]] = {
    "room": room_calibration,
    "desk": desk_calibration,
}
