"""Drift checks on scans whose truth is known: a wavy wall, noise, and a rig that moves in between."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from turnscan.process.drift import Target, sweep_overlap, target_offsets
from turnscan.schemas.errors import InputError

Columns = dict[str, np.ndarray]
ROWS = 120
NOISE_MM = 0.2


def sweep(
    degrees: float, *, step: float = 2.0, late_mm: float = 0.0, sway_mm: float = 0.0, seed: int = 3
) -> Columns:
    """POINTS of a scan over ``degrees``; from 360 on ranges are late_mm + sway_mm cos(angle) off."""
    rng = np.random.default_rng(seed)
    turned = np.arange(0.0, degrees + 1e-9, step)
    frame, row = (
        a.ravel() for a in np.meshgrid(np.arange(len(turned)), np.arange(ROWS), indexing="ij")
    )
    angle = np.radians(turned[frame])
    truth = 3000.0 + 400.0 * np.sin(2 * angle) + 0.5 * row
    off = np.where(turned[frame] >= 360.0 - 1e-9, late_mm + sway_mm * np.cos(angle), 0.0)
    distance = truth + off + rng.normal(0, NOISE_MM, len(frame))
    return {
        "frame": frame.astype(np.uint32),
        "laser": np.zeros(len(frame), np.uint8),
        "row": row.astype(np.uint16),
        "angle_rad": np.fmod(angle, math.tau).astype(np.float32),
        "u_px": (200.0 + 1e5 / distance).astype(np.float32),
        "range_mm": distance.astype(np.float32),
    }


def read(columns: Columns, size: int = 1000) -> Iterator[Columns]:
    for at in range(0, len(columns["frame"]), size):
        yield {n: v[at : at + size] for n, v in columns.items()}


@pytest.mark.parametrize("seed", range(5))
def test_a_rig_that_stood_still(seed: int) -> None:
    drift = sweep_overlap(lambda: read(sweep(420.0, seed=seed)))
    assert (drift.pairs, drift.turns) == (31, pytest.approx(420 / 360, rel=1e-6))
    assert abs(drift.bias_mm) < 0.02
    assert drift.drift_mm < 0.05
    assert drift.noise_mm == pytest.approx(NOISE_MM, rel=0.1)
    assert drift.sigmas < 3.5


def test_a_rig_that_moved() -> None:
    drift = sweep_overlap(lambda: read(sweep(420.0, late_mm=0.5)))
    assert drift.bias_mm == pytest.approx(0.5, abs=0.02)
    assert drift.bias_px == pytest.approx(-0.5 * 1e5 / 3200.0**2, rel=0.3)
    assert drift.sigmas > 20


def test_an_axis_that_moved_has_another_sign_on_the_other_side() -> None:
    drift = sweep_overlap(lambda: read(sweep(720.0, sway_mm=1.0)))
    assert abs(drift.bias_mm) < 0.1
    assert drift.drift_mm == pytest.approx(math.sqrt(0.5), rel=0.15)
    assert drift.sigmas > 10


def test_angles_between_those_of_the_first_sweep_are_interpolated() -> None:
    # 360 is no multiple of 2.2 degrees: the last sweep looks between the frames of the first one.
    drift = sweep_overlap(lambda: read(sweep(440.0, step=2.2)))
    # What is left is the wall's curvature: a parabola's sagitta of 400 * 4 * step^2 / 8.
    assert abs(drift.bias_mm) < 400 * 4 * math.radians(2.2) ** 2 / 8
    moved = sweep_overlap(lambda: read(sweep(440.0, step=2.2, late_mm=3.0)))
    assert moved.bias_mm - drift.bias_mm == pytest.approx(3.0, abs=0.05)


def test_batches_do_not_matter() -> None:
    columns = sweep(420.0, late_mm=0.1)
    assert sweep_overlap(lambda: read(columns, 77)) == sweep_overlap(lambda: read(columns, 10**6))


@pytest.mark.parametrize("degrees", [90.0, 358.0, 360.0])
def test_one_turn_is_not_enough(degrees: float) -> None:
    with pytest.raises(InputError, match=r"no angle is seen twice|only \d frames"):
        sweep_overlap(lambda: read(sweep(degrees)))
    with pytest.raises(InputError, match="over 0 deg"):
        sweep_overlap(lambda: iter(()))


def wall(offset_mm: float, tilt: float = 0.1) -> Columns:
    """A tilted wall through (0, 500 + offset, 80), with noise along its normal."""
    rng = np.random.default_rng(2)
    x, z = rng.uniform(-60, 60, (2, 4000))
    normal = np.array([math.sin(tilt), math.cos(tilt), 0.0])
    along = np.array([math.cos(tilt), -math.sin(tilt), 0.0])
    points = (
        np.array([0.0, 500.0, 80.0])
        + x[:, None] * along
        + z[:, None] * np.array([0.0, 0.0, 1.0])
        + (offset_mm + rng.normal(0, NOISE_MM, 4000))[:, None] * normal
    )
    return {f"{n}_mm": points[:, i].astype(np.float32) for i, n in enumerate("xyz")}


@pytest.mark.parametrize("offset", [0.0, 0.3, -2.0])
def test_targets_tell_the_distance_along_the_normal(offset: float) -> None:
    (found,) = target_offsets([wall(offset)], [Target("t", 0.0, 500.0, 80.0, sd_mm=0.1)])
    assert found.offset_mm == pytest.approx(offset, abs=0.03)
    assert found.sigma_mm == pytest.approx(0.1, rel=0.05)
    assert found.sigmas == pytest.approx(abs(found.offset_mm or 0.0) / 0.1, rel=0.05)
    assert found.points > 300


def test_outliers_near_a_target_are_left_out() -> None:
    columns = {n: np.concatenate([v, v[:300]]) for n, v in wall(0.0).items()}
    columns["y_mm"][-300:] += 12.0
    (found,) = target_offsets([columns], [Target("t", 0.0, 500.0, 80.0)])
    assert abs(found.offset_mm or 9.0) < 0.05


def test_a_target_where_nothing_is() -> None:
    (found,) = target_offsets([wall(0.0)], [Target("t", 0.0, -500.0, 80.0)])
    assert (found.points, found.offset_mm) == (0, None)
