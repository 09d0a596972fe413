"""Differences of calibrations against closed forms: similar triangles, known covariances."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.process.calibrate.difference import (
    in_camera_space,
    parameter_differences,
    part_differences,
    shifts,
    stripe_pixels,
)
from turnscan.process.camera import undistort_points
from turnscan.process.triangulate import intersect, range_of
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.errors import CalibrationError

CAMERA = Intrinsics(
    width_px=640,
    height_px=480,
    fx_px=762.0,
    fy_px=762.0,
    cx_px=297.0,
    cy_px=271.5,
    skew=0.001,
    distortion=(-0.21, 0.165, 0.0008, -0.00001, 0.0),
)
THETA = math.atan2(1.0, 0.4)
NORMAL = (math.sin(THETA), 0.0, math.cos(THETA))
PLANE = LaserPlane(laser=0, normal=NORMAL, distance_mm=300.0 * math.sin(THETA))
AXIS = TurntableAxis(point_mm=(150.0, 0.0, -40.0), direction=(0.0, -1.0, 0.0), head="rotates")
RIG = Calibration(rig="r1", camera=CAMERA, lasers=(PLANE,), turntable=AXIS)


def changed(**parts: object) -> Calibration:
    return RIG.model_copy(update=parts)


def diagonal(*sigmas: float) -> tuple[tuple[float, ...], ...]:
    return tuple(
        tuple(s * s if i == j else 0.0 for j in range(len(sigmas))) for i, s in enumerate(sigmas)
    )


def test_a_moved_plane_scales_every_ray() -> None:
    """P = h / (n.r) r: of the same pixel, every length grows as h does."""
    moved = changed(lasers=(PLANE.model_copy(update={"distance_mm": PLANE.distance_mm * 1.001}),))
    for shift in shifts(RIG, moved):
        assert shift.points == 61
        assert shift.rms_mm == pytest.approx(shift.at_mm * 0.001, rel=1e-9)
        assert shift.max_mm == pytest.approx(shift.at_mm * 0.001, rel=1e-9)
        assert shift.range_mm == pytest.approx(shift.at_mm * 0.001, rel=1e-9)


def test_a_moved_axis_shifts_all_points_alike_and_no_range() -> None:
    moved = changed(turntable=AXIS.model_copy(update={"point_mm": (153.0, -4.0, -40.0)}))
    for shift in shifts(RIG, moved):
        # Camera X is turntable x here, and camera Y (down) is turntable -z.
        assert (shift.x_mm, shift.z_mm) == (pytest.approx(-3.0), pytest.approx(-4.0))
        assert shift.rms_mm == pytest.approx(5.0)
        assert shift.range_mm == pytest.approx(0.0, abs=1e-9)


def test_equal_calibrations_do_not_move() -> None:
    assert all(s.rms_mm == 0.0 for s in shifts(RIG, RIG) if s.points)
    assert all(p.same for p in part_differences(RIG, RIG))
    assert all(p.difference == 0.0 for p in parameter_differences(RIG, RIG))


@given(st.floats(320.0, 9000.0), st.floats(-0.3, 0.3))
def test_the_stripe_lies_at_the_range_that_is_asked_for(at_mm: float, tilt: float) -> None:
    n = np.array([NORMAL[0], tilt, NORMAL[2]])
    n /= np.linalg.norm(n)
    plane = PLANE.model_copy(update={"normal": tuple(n.tolist())})
    rig = changed(lasers=(plane,))
    u, v = stripe_pixels(rig, 0, at_mm)
    found = range_of(intersect(*undistort_points(u, v, CAMERA), plane))
    np.testing.assert_allclose(found, at_mm, rtol=1e-9)
    assert np.all((u >= 0) & (u <= 639) & (v >= 0) & (v <= 479))


def test_ranges_that_the_camera_does_not_see_hold_no_points() -> None:
    near, far = shifts(RIG, RIG, (100.0, 3000.0))
    assert (near.points, near.rms_mm) == (0, None)
    assert far.points == 61


def test_parameters_in_sigmas_of_both() -> None:
    a = changed(camera=CAMERA.model_copy(update={"covariance": diagonal(3, 3, 1, 1, 0, *[0.01] * 5)}))
    camera = CAMERA.model_copy(
        update={"fx_px": 767.0, "covariance": diagonal(4, 4, 1, 1, 0, *[0.01] * 5)}
    )
    b = changed(camera=camera)
    (fx,) = (p for p in parameter_differences(a, b) if p.parameter == "fx_px")
    assert (fx.difference, fx.sigma, fx.sigmas) == (5.0, pytest.approx(5.0), pytest.approx(1.0))
    (skew,) = (p for p in parameter_differences(a, b) if p.parameter == "skew")
    assert skew.sigmas is None, "a fixed parameter has no sigma to be measured in"
    (plane,) = (p for p in parameter_differences(a, b) if p.parameter == "distance_mm")
    assert plane.sigma is None


def test_the_same_plane_written_the_other_way_round() -> None:
    turned = PLANE.model_copy(
        update={"normal": tuple(-c for c in NORMAL), "distance_mm": -PLANE.distance_mm}
    )
    rows = [p for p in parameter_differences(RIG, changed(lasers=(turned,))) if p.part == "plane/0"]
    assert [p.difference for p in rows] == [0.0] * 4
    assert all(s.rms_mm == pytest.approx(0.0, abs=1e-9) for s in shifts(RIG, changed(lasers=(turned,))))


def test_a_part_as_a_whole_respects_correlation() -> None:
    """Two parameters that were only measured as a sum: moving along what is free is no difference."""
    matrix = np.diag([1.0, 1.0, 1e-6, 1e-6, 0.0, *[1e-6] * 5])
    matrix[0, 1] = matrix[1, 0] = -0.9999
    covariance = tuple(map(tuple, matrix.tolist()))
    base = CAMERA.model_copy(update={"covariance": covariance})
    free = base.model_copy(update={"fx_px": 763.0, "fy_px": 761.0})
    tight = base.model_copy(update={"fx_px": 763.0, "fy_px": 763.0})
    told = [part_differences(changed(camera=base), changed(camera=c))[0].sigmas for c in (free, tight)]
    assert told[0] is not None
    assert told[1] is not None
    assert told[0] < 0.1
    assert told[1] > 50


def test_one_parameter_alone_is_its_own_sigma() -> None:
    line = AXIS.model_copy(update={"covariance": diagonal(2, 0, 0, 0, 0, 0)})
    moved = line.model_copy(update={"point_mm": (150.0 + 2 * math.sqrt(2) * 3, 0.0, -40.0)})
    axis = part_differences(changed(turntable=line), changed(turntable=moved))[-1]
    assert axis.sigmas == pytest.approx(3.0)


def test_what_cannot_be_compared_says_so() -> None:
    wide = CAMERA.model_copy(update={"width_px": 1280})
    with pytest.raises(CalibrationError, match="640 x 480, the other for 1280 x 480"):
        shifts(RIG, changed(camera=wide))
    with pytest.raises(CalibrationError, match="no laser in common"):
        shifts(RIG, changed(lasers=(PLANE.model_copy(update={"laser": 1}),)))
    with pytest.raises(CalibrationError, match="no camera"):
        shifts(RIG, changed(camera=None))
    missing = [p for p in parameter_differences(RIG, changed(turntable=None)) if p.part == "axis"]
    assert {(p.second, p.difference) for p in missing} == {(None, None)}


def test_without_an_axis_points_move_in_camera_space() -> None:
    moved = changed(lasers=(PLANE.model_copy(update={"distance_mm": PLANE.distance_mm + 1.0}),))
    bare = moved.model_copy(update={"turntable": None})
    assert in_camera_space(RIG, bare)
    assert not in_camera_space(RIG, moved)
    for with_axis, without in zip(shifts(RIG, moved), shifts(RIG, bare), strict=True):
        assert without.points == with_axis.points
        if with_axis.rms_mm is not None:
            # The same points by the same axis: only what x, y and z are called differs.
            assert without.rms_mm == pytest.approx(with_axis.rms_mm)
            assert without.range_mm == pytest.approx(with_axis.range_mm)
            assert without.z_mm != pytest.approx(with_axis.z_mm)
