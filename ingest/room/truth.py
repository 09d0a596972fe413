"""How far measured points are from the simulated surfaces, along the very rays they were seen on."""

from __future__ import annotations

import numpy as np

from .rays import Floats
from .rig import SimulatedRig
from .scene import Scene


def range_errors_mm(
    scene: Scene, rig: SimulatedRig, angle_rad: float, points_mm: Floats
) -> tuple[Floats, Floats]:
    """Error of the range of points (N, 3) in scene space, and their true range, in mm.

    The ray from the camera's centre at ``angle_rad`` through each point is cast into the scene; the
    error is measured minus true range. Positive: measured too far.
    """
    centre = rig.pose(angle_rad).camera_mm
    away = points_mm - centre
    measured = np.sqrt((away**2).sum(axis=1))
    true = scene.cast(centre, away / measured[:, None]).distance_mm
    return measured - true, true
