"""Every fault in every dialect: never hangs, never a wrong angle, never a laser left on.

A small session (turn, light, look, dark) meets each fault at each sort of command. It either goes on,
or ends in DeviceErrors, each within its time; what it believes is compared with what is physically so.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from turnscan.schemas.errors import DeviceError
from turnscan.schemas.rig import Fault

from .bench import DIALECTS, TIMEOUT_S, Bench, bench

#: One call: to get in step again, itself, to stop and reset after a failure, and slack for two cores.
BOUND_S = 5 * TIMEOUT_S + 1.0

ON_THE_WIRE = ("delay", "garbage", "lost-command", "lost-reply", "nak", "hang-up")
SORTS = ("move", "laser", "status", pytest.param("any", marks=pytest.mark.slow))


@dataclass
class Story:
    """What happened: angles that were believed, and the errors."""

    believed: list[tuple[float, float]] = field(default_factory=list)
    errors: list[DeviceError] = field(default_factory=list)
    longest_s: float = 0.0

    def tell(self, act: Callable[[], Any]) -> Any:
        began = time.monotonic()
        try:
            return act()
        except DeviceError as error:
            assert error.hint, error
            self.errors.append(error)
            return None
        finally:
            self.longest_s = max(self.longest_s, time.monotonic() - began)


def small_session(it: Bench, *, retries: int = 1) -> Story:
    """Three poses, each tried again once after a failure, then everything off, as a session does it."""
    story = Story()
    controller, state = it.controller, it.emulator.state
    if story.tell(controller.connect) is None and story.tell(controller.connect) is None:
        return story

    def pose(angle: float) -> bool:
        position = controller.move_to(angle)
        # It stands now; the report's time is a guess that may lie in the last step of the motion.
        assert position.angle_rad == pytest.approx(angle, abs=math.radians(it.settings.tolerance_deg))
        story.believed.append((position.angle_rad, state().angle_rad))
        controller.switch(0, on=True)
        looked = controller.position()
        story.believed.append((looked.angle_rad, state(looked.t_ns).angle_rad))
        controller.switch(0, on=False)
        return True

    for angle in (0.2, 0.4, 0.6):
        for _ in range(1 + retries):
            if story.tell(lambda angle=angle: pose(angle)):
                break
    story.tell(controller.all_off)
    story.tell(controller.release)
    controller.close()
    return story


def check(it: Bench, story: Story, *, angles: bool = True) -> None:
    """What must hold whatever went wrong."""
    assert it.emulator.plan.struck, "the fault hit nothing: the test would prove nothing"
    # A pose is several calls; none of them waits longer than BOUND_S.
    assert story.longest_s < 4 * BOUND_S
    if it.settings.dialect == "turnscan":  # after a hang-up only the watchdog is left
        until = time.monotonic() + 2 * it.settings.watchdog_s
        while it.emulator.state().outputs_lit and time.monotonic() < until:
            time.sleep(0.02)
    state = it.emulator.state()
    assert not state.outputs_lit, story.errors
    if angles:
        for believed, true in story.believed:
            assert math.degrees(abs(believed - true)) < it.settings.tolerance_deg


@pytest.mark.parametrize("on", SORTS)
@pytest.mark.parametrize("kind", ON_THE_WIRE)
@pytest.mark.parametrize("dialect", DIALECTS)
def test_one_fault_on_the_wire(dialect: str, kind: Any, on: Any) -> None:
    fault = Fault(kind=kind, on=on, at=2, delay_s=1.5 * TIMEOUT_S)
    if kind == "nak" and on == "status" and dialect != "turnscan":
        pytest.skip("a status question is no line in this dialect: it cannot be refused")
    with bench(dialect, faults=(fault,)) as it:
        story = small_session(it)
        check(it, story)
        if kind == "hang-up":
            assert any("hung up" in str(e) for e in story.errors)
        else:
            # One fault, and each pose is tried again: the session comes through.
            assert len(story.believed) >= 6, story.errors


@pytest.mark.parametrize("kind", ["delay", "garbage", "lost-command", "lost-reply", "nak"])
def test_turnscan_just_repeats_what_got_lost(kind: Any) -> None:
    """Numbers and CRCs are there for this: no error at all, wherever the fault hits."""
    for on in ("move", "laser", "status", "motor"):
        at = 1 if on == "motor" else 2
        fault = Fault(kind=kind, on=on, at=at, delay_s=0.3 * TIMEOUT_S)
        with bench("turnscan", faults=(fault,)) as it:
            story = small_session(it)
            check(it, story)
            assert story.errors == []
            assert len(story.believed) == 6


@pytest.mark.parametrize("dialect", ["horus", "grbl"])
def test_every_line_that_a_driver_sends_is_on_the_page(dialect: str) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "controllers.md").read_text()
    section = re.split(r"^## ", page, flags=re.MULTILINE)
    about = next(s for s in section if s.startswith(f"`{dialect}`"))
    known = {
        re.sub(r"<[^>]*>+|=[\d.]+", "=#", text).replace("==", "=")
        for text in re.findall(r"`([^`]+)`", about)
    }
    with bench(dialect) as it:
        small_session(it)
        it.controller.connect()
        it.controller.start_move(math.radians(300), 0.2)
        time.sleep(0.05)
        it.controller.release()
        sent = {text for text in it.sent() if text != "\\x18"}
    assert len(sent) > 10
    for text in sent:
        shape = re.sub(r"(?<=[XFST=])-?[\d.]+", "=#", text).replace("==", "=")
        assert shape in known or shape.split("=")[0] in known, (text, shape)
    assert "byte 0x18" in about


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_short_delay_is_no_fault(dialect: str) -> None:
    fault = Fault(kind="delay", at=1, count=1000, delay_s=0.02)
    with bench(dialect, faults=(fault,)) as it:
        story = small_session(it)
        check(it, story)
        assert story.errors == []


@pytest.mark.parametrize(
    "kind",
    [
        "lost-command",
        pytest.param("lost-reply", marks=pytest.mark.slow),
        pytest.param("garbage", marks=pytest.mark.slow),
        pytest.param("nak", marks=pytest.mark.slow),
        pytest.param("delay", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("dialect", DIALECTS)
def test_from_some_moment_on_nothing_gets_through(dialect: str, kind: Any) -> None:
    """The laser burns when the line goes bad for good; only the board can still switch it off."""
    with bench(dialect) as it:
        it.controller.connect()
        it.controller.move_to(0.3)
        it.controller.switch(0, on=True)
        now = it.emulator.plan._seen["any"]
        it.emulator.plan.faults = (Fault(kind=kind, at=now + 1, count=10_000, delay_s=100),)
        story = Story()
        for act in (it.controller.position, it.controller.all_off, it.controller.release):
            story.tell(act)
        assert story.errors
        story.tell(it.controller.close)
        assert story.longest_s < 2 * BOUND_S
        lit = it.emulator.state().outputs_lit
        if kind == "lost-command" and dialect != "turnscan":
            # No byte reaches a board without watchdog: the error must say what to fear.
            assert lit
            assert any("LASER MAY BE LIT" in str(e) for e in story.errors)
        else:
            time.sleep(1.5 * it.settings.watchdog_s)
            assert not it.emulator.state().outputs_lit


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_stall_ends_in_an_error_that_says_where_it_stands(dialect: str) -> None:
    with bench(dialect, faults=(Fault(kind="stall", at=2),)) as it:
        story = small_session(it)
        check(it, story)
        assert len(story.errors) == 1
        assert "stands at" in str(story.errors[0])
        assert len(story.believed) == 6


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_motor_that_is_blocked_for_good(dialect: str) -> None:
    with bench(dialect, faults=(Fault(kind="stall", at=1, count=100),)) as it:
        story = small_session(it)
        check(it, story)
        assert story.believed == []


def test_missed_steps_are_found_where_there_is_an_encoder_and_made_good() -> None:
    with bench("turnscan", faults=(Fault(kind="missed-steps", at=2, steps=40),)) as it:
        story = small_session(it)
        check(it, story)
        assert len(story.errors) == 1
        assert "steps were missed" in (story.errors[0].hint or "")
        # The pose was tried again, from where the encoder says that the table stands.
        assert len(story.believed) == 6


def test_missed_steps_below_the_tolerance_are_reported_as_they_are() -> None:
    with bench("turnscan", faults=(Fault(kind="missed-steps", at=1, steps=3),)) as it:
        it.controller.connect()
        position = it.controller.move_to(0.2)
        assert position.angle_rad == pytest.approx(it.emulator.state().angle_rad, abs=1e-6)
        assert position.angle_rad < 0.2 - 0.001


@pytest.mark.parametrize("dialect", ["horus", "grbl"])
def test_boards_without_encoder_say_that_they_cannot_see_missed_steps(dialect: str) -> None:
    with bench(dialect, faults=(Fault(kind="missed-steps", at=2, steps=40),)) as it:
        assert it.controller.connect().facts["missed_steps"] == "not seen"
        story = small_session(it)
        check(it, story, angles=False)
        assert story.errors == []


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_board_that_restarts_by_itself_is_not_believed_any_more(dialect: str) -> None:
    """Power failed for a moment: its count begins at 0 wherever the table stands."""
    with bench(dialect) as it:
        it.controller.connect()
        it.controller.move_to(0.5)
        it.emulator._firmware.boot()
        time.sleep(0.05)
        for _ in range(2):
            with pytest.raises(DeviceError, match="position is lost"):
                it.controller.move_to(0.6)
        assert it.emulator.state().angle_rad == pytest.approx(0.5, abs=0.002)
        it.controller.all_off()


def test_the_watchdog_is_told_when_it_struck() -> None:
    with bench("turnscan") as it:
        it.controller.connect()
        it.controller.switch(0, on=True)
        time.sleep(1.5 * it.settings.watchdog_s)
        assert not it.emulator.state().outputs_lit
        with pytest.raises(DeviceError, match="watchdog"):
            it.controller.position()
        it.controller.position()


def test_horus_lasers_are_not_cut_off_in_the_middle_of_a_motion() -> None:
    with bench("horus", speed_deg_s=60) as it:
        it.controller.connect()
        it.controller.switch(0, on=True)
        with pytest.raises(DeviceError, match="cuts its lasers off"):
            it.controller.start_move(math.radians(300), math.radians(1))
        it.controller.start_move(math.radians(300), math.radians(5))


def test_horus_builds_that_send_ok_early_are_understood() -> None:
    with bench("horus") as it:
        it.emulator._firmware.early_ok = True  # type: ignore[attr-defined]
        story = small_session(it)
        assert story.errors == []
        assert len(story.believed) == 6
        it.controller.connect()
        it.controller.switch(0, on=True)
        it.controller.start_move(math.radians(300), 0.5)
        time.sleep(0.05)
        assert it.controller.position().moving
        it.controller.all_off()
        state = it.emulator.state()
        assert not state.outputs_lit
        assert not state.turning
        it.controller.move_to(0.3)
        assert it.emulator.state().angle_rad == pytest.approx(0.3, abs=0.002)


def test_horus_keeps_its_lasers_lit_beyond_the_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    from turnscan.ingest.devices.dialects import horus

    monkeypatch.setattr(horus, "CUT_OFF_S", 0.6)
    with bench("horus") as it:
        it.emulator._firmware._cut_off_ns = 600_000_000
        it.controller.connect()
        it.controller.switch(0, on=True)
        until = time.monotonic() + 1.5
        while time.monotonic() < until:
            time.sleep(0.05)
            it.controller.keep_alive()
        assert it.emulator.state().outputs_lit == {1}
        time.sleep(0.8)  # the emulated cut-off is real: without keep_alive it strikes
        assert not it.emulator.state().outputs_lit
