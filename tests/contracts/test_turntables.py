"""What every Turntable and Lasers driver does, whatever it speaks. All on real pseudo-terminals."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import pytest

from turnscan.ingest.devices.contracts import DeviceInfo, Position
from turnscan.schemas.errors import DeviceError

from ..ingest.devices.bench import DIALECTS, TIMEOUT_S, Bench, bench

#: Longest that one call may take beside its motion: to get in step again, for itself, and slack.
BOUND_S = 3 * TIMEOUT_S + 0.5


@pytest.fixture(params=DIALECTS)
def made(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A driver that is not connected yet."""
    with bench(request.param) as it:
        yield it


@pytest.fixture
def ready(made: Bench) -> Bench:
    made.controller.connect()
    return made


class TestTurntables:
    """The contract of Turntable."""

    def test_connecting_says_what_it_is_holds_the_motor_and_keeps_lasers_off(self, made: Bench) -> None:
        info = made.controller.connect()
        assert isinstance(info, DeviceInfo)
        assert info.name
        assert info.facts["dialect"] == made.settings.dialect
        assert info.facts["missed_steps"] in ("seen", "not seen")
        state = made.emulator.state()
        assert state.motor_held
        assert not state.outputs_lit
        assert made.controller.reports_position

    def test_it_stands_where_it_was_sent_and_says_so(self, ready: Bench) -> None:
        for angle in (10.0, 33.333, 5.5, -20.0, 0.0, 360.0):
            position = ready.controller.move_to(math.radians(angle))
            assert isinstance(position, Position)
            assert not position.moving
            true = ready.emulator.state()
            assert not true.turning
            assert math.degrees(true.angle_rad) == pytest.approx(angle, abs=0.51 * ready.microstep_deg)
            assert position.angle_rad == pytest.approx(true.angle_rad, abs=math.radians(0.001))
            assert ready.emulator.state(position.t_ns).angle_rad == pytest.approx(true.angle_rad)

    def test_moving_where_it_stands_is_fine(self, ready: Bench) -> None:
        for _ in range(3):
            assert ready.controller.move_to(0.5).angle_rad == pytest.approx(0.5, abs=0.002)

    @pytest.mark.parametrize("angle", [401.0, -100.5, 1e9, math.nan, math.inf])
    def test_beyond_the_soft_limits_nothing_moves(self, ready: Bench, angle: float) -> None:
        for move in (
            lambda: ready.controller.move_to(math.radians(angle)),
            lambda: ready.controller.start_move(math.radians(angle), 1.0),
        ):
            with pytest.raises(DeviceError, match="soft limits"):
                move()
        assert ready.emulator.state().microsteps == 0

    @pytest.mark.parametrize("speed", [0.0, math.nan])
    def test_an_impossible_speed_is_refused(self, ready: Bench, speed: float) -> None:
        with pytest.raises(DeviceError, match="deg/s"):
            ready.controller.start_move(0.1, speed)

    def test_a_started_motion_is_seen_turning_and_its_angles_are_true(self, ready: Bench) -> None:
        ready.controller.start_move(math.radians(300), math.radians(60))
        angles = []
        while (position := ready.controller.position()).moving:
            true = ready.emulator.state(position.t_ns).angle_rad
            # 60 deg/s, 20 times as fast: the answer is stamped at the middle of a few milliseconds.
            assert math.degrees(abs(position.angle_rad - true)) < 60 * 20 * 0.02
            angles.append(position.angle_rad)
        assert len(angles) > 5
        assert angles == sorted(angles)
        assert math.degrees(position.angle_rad) == pytest.approx(300, abs=ready.microstep_deg)

    def test_stop_brakes_and_the_position_stays_known(self, ready: Bench) -> None:
        ready.controller.start_move(math.radians(390), math.radians(30))
        time.sleep(0.1)
        ready.controller.stop()
        state = ready.emulator.state()
        assert not state.turning
        assert 1 < math.degrees(state.angle_rad) < 389
        position = ready.controller.position()
        assert not position.moving
        assert position.angle_rad == pytest.approx(
            state.angle_rad, abs=math.radians(ready.microstep_deg)
        )
        ready.controller.move_to(0.3)
        assert ready.emulator.state().angle_rad == pytest.approx(0.3, abs=0.002)

    def test_stopping_at_rest_is_fine(self, ready: Bench) -> None:
        ready.controller.stop()
        assert not ready.controller.position().moving

    def test_the_motor_is_released_at_any_time_and_held_again(self, made: Bench) -> None:
        made.controller.release()  # not connected: nothing to do
        made.controller.connect()
        made.controller.start_move(math.radians(390), math.radians(30))
        made.controller.release()
        made.controller.release()
        state = made.emulator.state()
        assert not state.motor_held
        assert not state.turning
        made.controller.move_to(0.25)
        state = made.emulator.state()
        assert state.motor_held
        assert state.angle_rad == pytest.approx(0.25, abs=0.002)

    @pytest.mark.parametrize("dialect", DIALECTS)
    def test_the_gears_play_is_taken_up_from_one_side(self, dialect: str) -> None:
        with bench(dialect, backlash_deg=0.8) as it:
            it.controller.connect()
            for angle in (10.0, 4.0, 4.1, -7.0, -7.0, 2.0, 1.9):
                it.controller.move_to(math.radians(angle))
                true = math.degrees(it.emulator.state().angle_rad)
                assert true == pytest.approx(angle, abs=0.51 * it.microstep_deg)

    def test_the_play_is_real(self) -> None:
        """Without taking it up, the same table would stand wrong: the test above could fail."""
        with bench("turnscan", backlash_deg=0.8) as it:
            it.controller.connect()
            it.controller.move_to(math.radians(10))
            it.controller.start_move(math.radians(5), 1.0)
            while it.controller.position().moving:
                pass
            assert math.degrees(it.emulator.state().angle_rad) == pytest.approx(5.8, abs=0.05)

    def test_closing_frees_the_port_and_switches_all_off(self, ready: Bench) -> None:
        ready.controller.switch(0, on=True)
        ready.controller.close()
        ready.controller.close()
        state = ready.emulator.state()
        assert not state.outputs_lit
        assert not state.motor_held
        for call in (
            ready.controller.position,
            lambda: ready.controller.move_to(0.1),
            lambda: ready.controller.switch(0, on=True),
            ready.controller.stop,
        ):
            with pytest.raises(DeviceError, match="not open"):
                call()
        ready.controller.release()
        ready.controller.all_off()
        ready.controller.connect()
        ready.controller.move_to(0.1)

    def test_the_port_is_taken_alone(self, ready: Bench) -> None:
        with bench(ready.settings.dialect) as other:
            other.controller._link.port = ready.emulator.port
            with pytest.raises(DeviceError, match="busy") as caught:
                other.controller.connect()
            assert caught.value.hint
        assert ready.controller.move_to(0.2).angle_rad == pytest.approx(0.2, abs=0.002)

    def test_every_line_is_heard_with_its_time(self, ready: Bench) -> None:
        ready.controller.move_to(0.2)
        assert {d for d, *_ in ready.lines} == {"turntable"}
        assert {d for _, d, *_ in ready.lines} == {"sent", "received"}
        times = [t for *_, t in ready.lines]
        assert times == sorted(times)
        assert all(text for _, _, text, _ in ready.lines)

    def test_a_late_reply_is_never_taken_for_the_present_one(self, ready: Bench) -> None:
        """Every reply, in turn, comes after its command was given up."""
        ready.controller.move_to(math.radians(20))
        from turnscan.schemas.rig import Fault

        plan = ready.emulator.plan
        for _ in range(4):
            plan.faults = (
                Fault(kind="delay", at=plan._seen["any"] + 1, count=2, delay_s=1.3 * TIMEOUT_S),
            )
            for target in (30.0, 20.0):
                began = time.monotonic()
                try:
                    position = ready.controller.move_to(math.radians(target))
                except DeviceError:
                    pass
                else:
                    true = ready.emulator.state(position.t_ns).angle_rad
                    assert math.degrees(true) == pytest.approx(target, abs=ready.microstep_deg)
                assert time.monotonic() - began < 3 * BOUND_S
            plan.faults = ()
            try:
                reported = ready.controller.position()
            except DeviceError:
                continue
            true = ready.emulator.state(reported.t_ns).angle_rad
            assert reported.angle_rad == pytest.approx(true, abs=math.radians(ready.microstep_deg))
        assert plan.struck


class TestLasers:
    """The contract of Lasers."""

    def test_one_by_one(self, made: Bench) -> None:
        count = {"turnscan": 3, "horus": 2, "grbl": 1}[made.settings.dialect]
        with bench(made.settings.dialect, lasers=count) as it:
            it.controller.connect()
            for laser in range(count):
                it.controller.switch(laser, on=True)
                assert it.emulator.state().outputs_lit == {laser + 1}
                it.controller.switch(laser, on=True)
                it.controller.switch(laser, on=False)
                assert not it.emulator.state().outputs_lit
            for laser in range(count):
                it.controller.switch(laser, on=True)
            assert it.emulator.state().outputs_lit == set(range(1, count + 1))
            it.controller.all_off()
            it.controller.all_off()
            assert not it.emulator.state().outputs_lit

    def test_a_laser_that_is_not_in_the_rig_file_is_refused(self, ready: Bench) -> None:
        with pytest.raises(DeviceError, match="no laser 7"):
            ready.controller.switch(7, on=True)

    def test_all_off_also_while_the_table_turns(self, ready: Bench) -> None:
        ready.controller.switch(0, on=True)
        ready.controller.start_move(math.radians(390), math.radians(30))
        began = time.monotonic()
        ready.controller.all_off()
        assert time.monotonic() - began < BOUND_S
        assert not ready.emulator.state().outputs_lit

    def test_kept_alive_it_stays_lit(self, ready: Bench) -> None:
        ready.controller.switch(0, on=True)
        until = time.monotonic() + 1.2
        while time.monotonic() < until:
            time.sleep(0.1)
            ready.controller.keep_alive()
        assert ready.emulator.state().outputs_lit == {1}

    def test_before_connecting_there_is_nothing_to_switch_off(self, made: Bench) -> None:
        made.controller.all_off()
        assert made.lines == []
