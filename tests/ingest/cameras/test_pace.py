"""The rhythm of arrivals: what is believed, what is counted as missing, what is relearned."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.devices.cameras.pace import Pace

MS = 1_000_000


def run(pace: Pace, times_ms: Iterable[float]) -> list[tuple[bool, int]]:
    return [pace.note(round(t * MS)) for t in times_ms]


def learned(period_ms: float = 10.0) -> Pace:
    """A pace that knows its period; the last arrival was at 0."""
    pace = Pace()
    run(pace, [-20 * period_ms + i * period_ms for i in range(21)])
    assert pace.period_ns == round(period_ms * MS)
    return pace


def test_nothing_is_believed_before_the_period_is_known() -> None:
    pace = Pace()
    assert run(pace, [0, 10, 20, 30]) == [(False, 0)] * 4
    assert pace.period_ns is None


def test_frames_buffered_while_opening_do_not_count_for_the_period() -> None:
    pace = Pace()
    run(pace, [0, 0.1, 0.2, 0.3, *range(10, 110, 10)])
    assert pace.period_ns == 10 * MS


@pytest.mark.parametrize("at_once", [14, 54, 200])
@pytest.mark.parametrize("pause_ms", [0, 20, 900])
def test_however_many_come_at_once_the_period_is_the_others(at_once: int, pause_ms: int) -> None:
    """A machine that is busy while the camera opens hands out all that has queued up."""
    arrivals = [0, pause_ms * MS]
    for _ in range(at_once):
        arrivals.append(arrivals[-1] + MS // 12)
    for _ in range(60):
        arrivals.append(arrivals[-1] + 16 * MS)
    pace = Pace()
    for arrived_ns in arrivals:
        pace.note(arrived_ns)
    assert pace.period_ns == pytest.approx(16 * MS, rel=0.1)


def test_a_lost_frame_is_counted_once_the_rhythm_is_back() -> None:
    assert run(learned(), [10, 20, 40, 50, 60]) == [
        *[(True, 0), (True, 0)],
        *[(False, 0), (True, 1), (True, 0)],
    ]


def test_late_frames_are_neither_believed_nor_missing() -> None:
    # The frames of 20 .. 60 all arrive at 60.
    assert run(learned(), [10, 60, 60.1, 60.2, 60.3, 60.4, 70, 80]) == [
        (True, 0),
        *[(False, 0)] * 5,
        *[(True, 0)] * 2,
    ]


def test_a_source_that_becomes_faster_is_learned_again() -> None:
    pace = learned(100)
    run(pace, [10 * i for i in range(1, 40)])
    assert pace.period_ns == 10 * MS
    assert pace.note(400 * MS) == (True, 0)


def test_rate_over_a_window() -> None:
    pace = learned()
    assert pace.rate_hz(0) is None
    times = [10 * i for i in range(1, 201)]
    run(pace, times)
    assert abs((pace.rate_hz(2000 * MS) or 0) - 100) <= 2
    run(pace, [2000 + 30 * i for i in range(1, 101)])
    assert abs((pace.rate_hz(5000 * MS) or 0) - 100 / 3) <= 2


def test_slow_sources_are_judged_over_more_time() -> None:
    pace = learned(1000)
    run(pace, [1000 * i for i in range(1, 9)])
    # Half a period late is no loss of rate.
    assert (pace.rate_hz(8500 * MS) or 0) > 0.8


@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_missing_frames_are_counted_exactly(kept: list[bool]) -> None:
    """Whatever frames a steady source leaves out: their number is known once two come in a row."""
    pace = learned()
    times = [10 * (i + 1) for i, keep in enumerate(kept) if keep]
    times += [10 * (len(kept) + 1), 10 * (len(kept) + 2)]
    assert sum(missing for _, missing in run(pace, times)) == kept.count(False)


@given(st.lists(st.integers(min_value=0, max_value=30), min_size=1, max_size=20))
def test_nothing_is_missing_of_what_was_only_held_back(holds: list[int]) -> None:
    """Frames leave every 10 ms; a hold of n frames lets n + 1 arrive together."""
    pace = learned()
    now, believed = 0, []
    for hold in holds:
        now += hold + 1
        for k in range(hold + 1):
            believed.append((pace.note(10 * now * MS + k * 1000), k, hold))
        now += 1
        believed.append((pace.note(10 * now * MS), 0, 0))
    for (in_rhythm, missing), k, hold in believed:
        assert missing == 0
        assert not (in_rhythm and hold), (k, hold)
