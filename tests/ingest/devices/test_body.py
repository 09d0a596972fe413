"""The emulated motor against closed forms: ramps, missed steps, stalls, play."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.devices.emulator.motor import NS, Motor

T0 = 1_000 * NS


def at(seconds: float) -> int:
    return T0 + round(seconds * NS)


@given(
    st.floats(-50_000, 50_000).filter(lambda x: abs(x) > 1),
    st.floats(10, 20_000),
    st.floats(10, 100_000),
)
def test_a_motion_is_a_trapezoid(way: float, speed: float, acceleration: float) -> None:
    motor = Motor(T0)
    motor.move(way, speed, acceleration, T0)
    top = min(speed, math.sqrt(abs(way) * acceleration))
    total = abs(way) / top + top / acceleration
    assert motor.moving(at(0.999 * total))
    assert not motor.moving(at(1.001 * total))
    assert motor.counted(at(total + 1)) == way
    assert motor.counted(at(total / 2)) == pytest.approx(way / 2, rel=1e-6, abs=1e-6)
    ramp = top / acceleration
    assert motor.counted(at(ramp / 2)) == pytest.approx(
        math.copysign(acceleration * (ramp / 2) ** 2 / 2, way), rel=1e-5, abs=1e-5
    )


def test_the_past_can_be_asked_for() -> None:
    motor = Motor(T0)
    motor.move(1000, 1000, 1e6, T0)
    motor.move(0, 1000, 1e6, at(5))
    assert motor.counted(at(0.5)) == pytest.approx(500, abs=1)
    assert motor.counted(at(3)) == 1000
    assert motor.counted(at(5.5)) == pytest.approx(500, abs=1)
    assert motor.counted(T0 - NS) == 0


def test_missed_steps_part_the_count_from_the_shaft() -> None:
    motor = Motor(T0)
    motor.move(1000, 500, 5000, T0, missed=30)
    assert motor.rotor(at(0.5)) == motor.counted(at(0.5))
    assert motor.counted(at(10)) == 1000
    assert motor.rotor(at(10)) == 970
    motor.move(0, 500, 5000, at(10), missed=30)  # downwards it lags behind, too
    assert motor.rotor(at(20)) == 0
    motor.recount(7, at(21))
    assert motor.counted(at(22)) == 7
    assert motor.rotor(at(22)) == 0


def test_a_stall_never_ends_and_stands_half_way() -> None:
    motor = Motor(T0)
    motor.move(1000, 500, 5000, T0, stall=True)
    assert motor.moving(at(1e6))
    assert motor.rotor(at(1e6)) == pytest.approx(500, abs=1)
    motor.stop(5000, at(1e6))
    assert not motor.moving(at(1e6) + 1)


@given(st.floats(0.01, 1.9))
def test_braking_takes_its_way(when: float) -> None:
    motor = Motor(T0)
    motor.move(1000, 500, 5000, T0)  # 0.1 s of ramp, 2.1 s in all
    moving_at = 500 * min(when / 0.1, 1.0)
    where = motor.counted(at(when))
    motor.stop(5000, at(when))
    assert motor.counted(at(100)) == pytest.approx(where + moving_at**2 / 2 / 5000, abs=0.01)
    assert not motor.moving(at(100))
    dead = Motor(T0)
    dead.move(1000, 500, 5000, T0)
    dead.stop(0, at(when))
    assert dead.counted(at(100)) == where


@given(st.lists(st.integers(-300, 300), min_size=1, max_size=12), st.floats(0.5, 60))
def test_play_is_the_textbook_operator(targets: list[int], play: float) -> None:
    """The table moves only when a flank of the gap pushes it: y = min(max(y, x), x + play)."""
    motor = Motor(T0, play=play)
    now, y = T0, 0.0
    for target in targets:
        motor.move(target, 1000, 10_000, now)
        now += 10 * NS
        y = min(max(y, target), target + play)
        assert motor.table(now) == pytest.approx(y, abs=1e-6)
