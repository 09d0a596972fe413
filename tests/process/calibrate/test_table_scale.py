"""The size of the markers from the laser's stripe across them, on a table that is not flat."""

from __future__ import annotations

import numpy as np
import pytest
from posed import (
    AXIS_DIRECTION,
    AXIS_POINT,
    CAMERA,
    DISTANCE,
    NORMAL,
    turning_markers,
)

from turnscan.process.calibrate.axis import fit_axis
from turnscan.process.calibrate.axis_result import AxisFit, bodies_at_zero
from turnscan.process.calibrate.stripe_lines import StripeLine
from turnscan.process.calibrate.table_scale import table_scale
from turnscan.process.camera import project, undistort_points
from turnscan.schemas.calibration import LaserPlane

PLANE = LaserPlane(
    laser=0, normal=(float(NORMAL[0]), float(NORMAL[1]), float(NORMAL[2])), distance_mm=DISTANCE
)
ANGLES = np.arange(8) * np.deg2rad(45.0)


@pytest.fixture(scope="module")
def fit() -> AxisFit:
    seen = turning_markers(np.random.default_rng(0), ANGLES, sigma_px=0.0)
    return fit_axis(seen, [f"f{k}" for k in range(8)], ANGLES, CAMERA, head="fixed")


def marker_radii(fit: AxisFit) -> np.ndarray:
    corners = bodies_at_zero(fit.turning, fit.sightings) - AXIS_POINT
    return np.linalg.norm(np.cross(corners, AXIS_DIRECTION), axis=1)


def stripe_across(fit: AxisFit, scale: float, sag_mm: float) -> StripeLine:
    """The stripe on a table ``scale`` times as far away and as large as the fit has it.

    It is ``sag_mm`` lower in the middle than where the markers are, and flat beyond that.
    """
    assert fit.plane is not None
    normal, distance = fit.plane
    up = normal * np.sign(normal @ AXIS_DIRECTION)
    along = np.cross(NORMAL, normal)
    along /= np.linalg.norm(along)
    on_axis = scale * AXIS_POINT
    inner = scale * marker_radii(fit).min()
    start = np.linalg.solve(
        np.stack([NORMAL, normal, along]), [DISTANCE, scale * distance, along @ on_axis]
    )
    points = start + np.linspace(-200, 200, 1601)[:, None] * along
    for _ in range(20):
        radius = np.linalg.norm(np.cross(points - on_axis, AXIS_DIRECTION), axis=1)
        height = -sag_mm * np.maximum(0.0, 1.0 - (radius / inner) ** 2)
        # Down to the surface, then back along it into the laser's plane.
        points = points + (height - (points @ up - scale * distance * (up @ normal)))[:, None] * up
        in_plane = normal_part(NORMAL, up)
        points = points - ((points @ NORMAL - DISTANCE) / (NORMAL @ in_plane))[:, None] * in_plane
    u, v = project(points, CAMERA)
    seen = (u > 5) & (u < CAMERA.width_px - 5) & (v > 5) & (v < CAMERA.height_px - 5)
    xn, yn = undistort_points(u[seen], v[seen], CAMERA)
    return StripeLine(
        u[seen],
        v[seen],
        np.full(int(seen.sum()), 0.1),
        np.stack([xn, yn], axis=1),
        along_v=False,
        straightness_px=0.1,
        contrast_dn=80.0,
    )


def normal_part(vector: np.ndarray, across: np.ndarray) -> np.ndarray:
    """``vector`` without its part along the unit vector ``across``."""
    return vector - (vector @ across) * across


@pytest.mark.parametrize("scale", [0.9774, 1.0, 1.05])
@pytest.mark.parametrize("sag_mm", [0.0, 1.5, -1.5])
def test_a_dished_table_does_not_change_the_size_of_its_markers(
    fit: AxisFit, scale: float, sag_mm: float
) -> None:
    line = stripe_across(fit, scale, sag_mm)
    found = table_scale(fit, [[line]] * len(fit.frames), PLANE)
    assert found is not None
    assert found.frames == len(fit.frames)
    assert found.scale == pytest.approx(scale, abs=2e-5)
