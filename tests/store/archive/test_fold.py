"""The archive's state is a fold: the order in which files are listed does not matter."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from turnscan.schemas.archive_events import Certified, Restored, Retired, Tagged, Withdrawn
from turnscan.schemas.ids import new_ulid
from turnscan.store.fold import in_order, scan_states, standing_certifications

IDS = [new_ulid(1_700_000_000_000_000_000 + i * 10**9) for i in range(12)]
RECORDED = {"s-a": ("one", {"k": "0"}), "s-b": ("", {})}


def event(i: int, kind: str, choice: int):
    base = {"id": IDS[i], "t_ns": 10**6 - i}
    scan = ["s-a", "s-b"][choice % 2]
    if kind == "tagged":
        return Tagged(
            **base, scan=scan, label=f"l{choice}", tags={"k": "" if choice == 3 else str(choice)}
        )
    if kind == "retired":
        return Retired(**base, scan=scan)
    if kind == "restored":
        return Restored(**base, scan=scan)
    if kind == "withdrawn":
        return Withdrawn(**base, calibration="c", after=IDS[choice])
    return Certified(**base, calibration="c", rig="r")


KINDS = st.sampled_from(["tagged", "retired", "restored", "withdrawn", "certified"])


@given(st.lists(st.tuples(KINDS, st.integers(0, 3)), max_size=12), st.randoms())
def test_listing_order_does_not_matter(what: list[tuple[str, int]], rng: random.Random) -> None:
    events = [event(i, kind, choice) for i, (kind, choice) in enumerate(what)]
    shuffled = events[:]
    rng.shuffle(shuffled)
    assert [e.id for e in in_order(events)] == [e.id for e in in_order(shuffled)]
    assert scan_states(events, RECORDED) == scan_states(shuffled, RECORDED)
    assert standing_certifications(events) == standing_certifications(shuffled)


def test_an_event_follows_what_it_names_whatever_its_ulid() -> None:
    late = Certified(id=IDS[9], t_ns=0, calibration="c", rig="r")
    early = Withdrawn(id=IDS[1], t_ns=0, calibration="c", after=late.id)
    assert [e.id for e in in_order([early, late])] == [late.id, early.id]
    assert standing_certifications([early, late]) == []


def test_tags_labels_and_retirement() -> None:
    events = [
        Tagged(id=IDS[0], t_ns=0, scan="s-a", label="two", tags={"x": "1", "k": ""}),
        Retired(id=IDS[1], t_ns=0, scan="s-a"),
        Retired(id=IDS[2], t_ns=0, scan="s-b"),
        Restored(id=IDS[3], t_ns=0, scan="s-b"),
        Tagged(id=IDS[4], t_ns=0, scan="s-gone", tags={"x": "1"}),
    ]
    states = scan_states(events, RECORDED)
    assert (states["s-a"].label, states["s-a"].tags, states["s-a"].retired) == ("two", {"x": "1"}, True)
    assert states["s-b"].retired is False
    assert set(states) == {"s-a", "s-b"}


def test_ranges_are_half_open() -> None:
    e = Certified(id=IDS[0], t_ns=0, calibration="c", rig="r", from_ns=10, to_ns=20)
    assert [e.covers(t) for t in (9, 10, 19, 20)] == [False, True, True, False]
    assert Certified(id=IDS[0], t_ns=0, calibration="c", rig="r").covers(0)
