"""The axis: from markers and boards, wrong angles, either sense, either head; honest, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from posed import AXIS_DIRECTION, AXIS_POINT, BOARD, CAMERA, turning_markers

from turnscan.process.calibrate.axis import fit_axis
from turnscan.process.calibrate.axis_adjust import Sightings
from turnscan.process.calibrate.axis_result import AxisFit
from turnscan.process.calibrate.pose import rotation_of
from turnscan.process.camera import project
from turnscan.process.triangulate import scene_from_turntable, turntable_from_camera
from turnscan.schemas.errors import CalibrationError

STEP = np.deg2rad(30.0)


def names(count: int) -> list[str]:
    return [f"f{k}" for k in range(count)]


def off_axis_mm(fit: AxisFit) -> float:
    away = fit.point_mm - AXIS_POINT
    return float(np.linalg.norm(away - AXIS_DIRECTION * (away @ AXIS_DIRECTION)))


def in_sigmas(fit: AxisFit, covariance: np.ndarray) -> np.ndarray:
    """The five errors along the axes of the covariance (the direction keeps its length), in sigmas."""
    unit = np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])
    error = np.concatenate([fit.point_mm - AXIS_POINT, fit.direction - AXIS_DIRECTION]) / unit
    size, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    return (axes[:, 1:].T @ error) / np.sqrt(size[1:])


@pytest.mark.parametrize("sense", [1, -1])
def test_exact_markers_give_axis_origin_and_sense(sense: int) -> None:
    angles = np.arange(8) * STEP
    seen = turning_markers(np.random.default_rng(0), angles, sigma_px=0.0, sense=sense)
    fit = fit_axis(seen, names(8), angles, CAMERA, head="fixed")
    assert np.abs(fit.point_mm - AXIS_POINT).max() < 1e-3
    assert np.abs(fit.direction - AXIS_DIRECTION).max() < 1e-6
    assert fit.positive_turn == ("counterclockwise" if sense > 0 else "clockwise")
    assert fit.angle_scale == pytest.approx(1.0, abs=1e-6)


def test_the_part_puts_what_turned_back_into_place() -> None:
    """Through the product's own turntable: every corner lands on one scene point in all frames."""
    angles = np.arange(7) * STEP
    seen = turning_markers(np.random.default_rng(0), angles, sigma_px=0.0, sense=-1)
    fit = fit_axis(seen, names(7), angles, CAMERA, head="fixed")
    axis = fit.turntable_axis()
    placed, _, _ = fit.turning.place(fit.sightings)
    scene = scene_from_turntable(turntable_from_camera(axis)(placed), angles[seen.frame], axis)
    per_frame = scene.reshape(7, 16, 3)
    assert np.abs(per_frame - per_frame[0]).max() < 1e-3
    assert np.abs(per_frame[..., 2]).max() < 1e-3


def test_a_turning_head_sees_the_room_turn_the_other_way() -> None:
    angles = np.arange(6) * np.deg2rad(8.0)
    # The head turns by +angle about the direction: what it sees turns by -angle.
    seen = turning_markers(np.random.default_rng(0), angles, sigma_px=0.0, sense=-1)
    fit = fit_axis(seen, names(6), angles, CAMERA, head="rotates")
    axis = fit.turntable_axis()
    assert (axis.head, axis.positive_turn) == ("rotates", "counterclockwise")
    placed, _, _ = fit.turning.place(fit.sightings)
    scene = scene_from_turntable(turntable_from_camera(axis)(placed), angles[seen.frame], axis)
    per_frame = scene.reshape(6, 16, 3)
    assert np.abs(per_frame - per_frame[0]).max() < 1e-2
    # The paper's origin: beside the camera's centre.
    assert abs(float(fit.point_mm @ fit.direction)) < 1e-6


@pytest.mark.slow
def test_stated_covariance_is_what_repeats_scatter() -> None:
    off = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        nominal = np.arange(12) * STEP
        true = nominal + rng.normal(0, np.deg2rad(0.4), 12)
        fit = fit_axis(turning_markers(rng, true), names(12), nominal, CAMERA, head="fixed")
        off.append(in_sigmas(fit, fit.conditional))
    ratio = float(np.sqrt(np.mean(np.square(off))))
    # 60 numbers: their rms scatters by 9 %.
    assert 0.78 < ratio < 1.25, ratio


def test_an_uneven_table_is_measured_and_does_not_move_the_axis() -> None:
    rng = np.random.default_rng(2)
    nominal = np.arange(24) * np.deg2rad(15.0)
    wrong = np.concatenate([[0.0], rng.normal(0, np.deg2rad(0.5), 23)])
    seen = turning_markers(rng, 0.995 * nominal + wrong, sigma_px=0.1)
    free = fit_axis(seen, names(24), nominal, CAMERA, head="fixed")
    assert off_axis_mm(free) < 0.15
    found = np.array([f.off_rad for f in free.frames])
    assert np.corrcoef(found, wrong)[0, 1] > 0.99
    assert free.angle_scale == pytest.approx(0.995, abs=2e-3)
    assert np.rad2deg(free.step_sd_rad) == pytest.approx(np.rad2deg(np.std(np.diff(wrong))), rel=0.25)
    exact = fit_axis(seen, names(24), nominal, CAMERA, head="fixed", angle_sd_rad=0.0)
    assert exact.rms_px > 3 * free.rms_px
    assert exact.angle_scale == 1.0


def test_eccentric_angles_are_reported() -> None:
    nominal = np.arange(16) * np.deg2rad(22.5)
    true = nominal + np.deg2rad(0.4) * np.sin(nominal)
    seen = turning_markers(np.random.default_rng(1), true, sigma_px=0.05)
    fit = fit_axis(seen, names(16), nominal, CAMERA, head="fixed")
    assert np.rad2deg(fit.eccentricity_rad) == pytest.approx(0.4, abs=0.05)


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 1000), start=st.floats(-3.0, 3.0))
def test_where_counting_begins_does_not_matter(seed: int, start: float) -> None:
    angles = np.arange(6) * np.deg2rad(50.0)
    seen = turning_markers(np.random.default_rng(seed), angles, sigma_px=0.05)
    one = fit_axis(seen, names(6), angles, CAMERA, head="fixed")
    two = fit_axis(seen, names(6), angles + start, CAMERA, head="fixed")
    assert np.abs(one.point_mm - two.point_mm).max() < 1e-3
    assert np.abs(one.direction - two.direction).max() < 1e-6


def test_a_board_on_the_table_does_as_well() -> None:
    rng = np.random.default_rng(6)
    angles = np.deg2rad(np.array([0.0, 9.0, 20.0, 28.0, 41.0, 50.0]))
    tilt = rotation_of(np.array([0.2, -0.4, 0.1]))
    start = BOARD @ tilt.T + np.array([-60.0, -60.0, 480.0]) - AXIS_POINT
    pixels = [
        np.stack(project(start @ rotation_of(AXIS_DIRECTION * a).T + AXIS_POINT, CAMERA), axis=1)
        for a in angles
    ]
    count = len(BOARD)
    seen = Sightings(
        np.repeat(np.arange(6), count),
        np.zeros(6 * count, np.int64),
        np.tile(BOARD, (6, 1)),
        np.concatenate(pixels) + rng.normal(0, 0.1, (6 * count, 2)),
    )
    fit = fit_axis(seen, names(6), angles, CAMERA, head="fixed")
    assert off_axis_mm(fit) < 0.3
    assert np.rad2deg(np.linalg.norm(np.cross(fit.direction, AXIS_DIRECTION))) < 0.1


def test_a_marker_read_wrongly_is_left_out_by_frame() -> None:
    angles = np.arange(10) * STEP
    seen = turning_markers(np.random.default_rng(3), angles, sigma_px=0.1)
    spoiled = seen.seen_px.copy()
    spoiled[(seen.frame == 4) & (seen.body == 2)] += 25.0
    moved = Sightings(seen.frame, seen.body, seen.points_mm, spoiled)
    fit = fit_axis(moved, names(10), angles, CAMERA, head="fixed")
    assert [name for name, _ in fit.left_out] == ["f4"]
    assert off_axis_mm(fit) < 0.2


@pytest.mark.parametrize(
    ("degrees", "message"),
    [
        ((0.0, 30.0), "2 different angles"),
        ((0.0, 40.0, 40.1, 0.0), "2 different angles"),
        ((0.0, 0.0, 0.0), "1 different angles"),
    ],
)
def test_two_angles_are_refused(degrees: tuple[float, ...], message: str) -> None:
    angles = np.deg2rad(np.array(degrees))
    seen = turning_markers(np.random.default_rng(0), angles)
    with pytest.raises(CalibrationError, match=message) as caught:
        fit_axis(seen, names(len(degrees)), angles, CAMERA, head="fixed")
    assert "tens of mm" in caught.value.message


def test_angles_that_do_not_fit_are_refused() -> None:
    true = np.arange(8) * STEP
    seen = turning_markers(np.random.default_rng(0), true)
    with pytest.raises(CalibrationError, match="do not fit what turned"):
        fit_axis(seen, names(8), true * 3.3, CAMERA, head="fixed")


def test_mirrored_angles_leave_the_sense_open() -> None:
    true = np.deg2rad(np.array([0.0, 180.0, 90.0, 270.0]))
    seen = turning_markers(np.random.default_rng(0), true[[0, 1, 0, 1]])
    with pytest.raises(CalibrationError):
        fit_axis(seen, names(4), true[[0, 1, 0, 1]], CAMERA, head="fixed")


def test_a_table_that_stood_still_is_refused() -> None:
    nominal = np.arange(6) * STEP
    seen = turning_markers(np.random.default_rng(0), np.zeros(6), sigma_px=0.02)
    with pytest.raises(CalibrationError):
        fit_axis(seen, names(6), nominal, CAMERA, head="fixed")


def test_scaled_scales_lengths_and_nothing_else() -> None:
    angles = np.arange(8) * STEP
    fit = fit_axis(
        turning_markers(np.random.default_rng(0), angles), names(8), angles, CAMERA, head="fixed"
    )
    small = fit.scaled(0.98, 1e-6, 4e-6)
    assert small.point_mm == pytest.approx(0.98 * fit.point_mm)
    assert small.direction is fit.direction
    along = fit.point_mm
    grown = small.covariance[:3, :3] - 0.98**2 * fit.covariance[:3, :3]
    assert np.allclose(grown, 4e-6 * np.outer(along, along), rtol=1e-6)
