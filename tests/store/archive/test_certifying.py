"""What speaks against a certification, which scans it changes, and the timeline that follows."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.process.pipeline import derive
from turnscan.schemas.archive_events import AnyArchiveEvent, Certified, Withdrawn
from turnscan.schemas.calibration import Calibration
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.quality import Gate, Quality
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.certifying import holding
from turnscan.store.fold import standing_certifications
from turnscan.store.timeline import effective_ranges, timeline
from turnscan.store.verify import verify

from .scans import calibration, import_scan


def failed(h: float = 170.0) -> Calibration:
    quality = Quality(part="plane/0", gates=(Gate.at_most("rms", 0.9, 0.5, "mm"),))
    return calibration(h=h).model_copy(update={"quality": (quality,)})


def event_files(lab: Archive) -> list[str]:
    return sorted(p.name for p in (lab.root / "events").glob("*.json"))


def test_a_failed_calibration_is_kept_and_not_certified(lab: Archive) -> None:
    name = lab.add_calibration(failed())
    (row,) = (r for r in lab.calibration_rows() if r["calibration"] == name)
    assert row["verdict"] == "failed"
    before = event_files(lab)
    with pytest.raises(CalibrationError, match=r"plane/0: rms is 0\.9 mm, limit at most 0\.5 mm") as e:
        lab.certify(name)
    assert "--force --reason" in str(e.value.hint)
    assert event_files(lab) == before
    assert lab.certifications() == []


def test_what_was_forced_says_so_for_good(lab: Archive) -> None:
    name = lab.add_calibration(failed())
    lab.certify(name, rig="r9", reason="the only one")
    (event,) = Archive.open(lab.root).certifications()
    assert event.reason == "the only one"
    assert event.objections is not None
    assert ["limit at most" in event.objections[0], "no rig 'r9'" in event.objections[1]] == [True] * 2
    assert verify(lab) == []


def test_an_unknown_rig(lab: Archive) -> None:
    name = lab.add_calibration(calibration(h=201.0))
    with pytest.raises(CalibrationError, match=r"knows no rig 'r2' \(it knows r1\)"):
        lab.certify(name, rig="r2")
    # A rig whose calibration is there may get its scans later.
    other = lab.add_calibration(calibration().model_copy(update={"rig": "r2"}))
    assert any("it has no scans yet" in w for w in lab.would_certify(other).warnings)
    lab.certify(other)
    lab.certify(name, rig="r2")


def test_scans_with_other_frames(lab: Archive) -> None:
    camera = calibration().intrinsics_or_fail().model_copy(update={"width_px": 640})
    name = lab.add_calibration(calibration().model_copy(update={"camera": camera}))
    with pytest.raises(CalibrationError, match=r"1 of the 1 scans .* with 64 x 48; it is for 640 x 48"):
        lab.certify(name)
    lab.certify(name, to_ns=lab.scan("latest").started_ns)


def test_an_equal_certification_is_not_written_twice(lab: Archive) -> None:
    a, b = (lab.add_calibration(calibration(h=h)) for h in (201.0, 202.0))
    first = lab.certify(a)
    assert lab.certify(a).id == first.id
    assert len(event_files(lab)) == 1
    lab.certify(b)
    assert lab.certify(a).id != first.id, "b has taken its place, so it is stated anew"


def test_overlaps_and_changes_are_told(lab: Archive, source: Path) -> None:
    scan = lab.scan("latest")
    import_scan(lab, source, rig="r2", step=12.0)
    a, b = (lab.add_calibration(calibration(h=h)) for h in (201.0, 202.0))
    (change,) = lab.would_certify(a).changes
    assert (change.scan, change.before, change.after) == (scan.scan, scan.calibration, a)
    lab.certify(a, to_ns=scan.started_ns + 1)
    apart = lab.would_certify(b, from_ns=scan.started_ns + 1)
    assert (apart.overlaps, apart.changes) == ((), ())
    meant = lab.would_certify(b, from_ns=scan.started_ns)
    assert [e.calibration for e in meant.overlaps] == [a]
    assert [(c.before, c.after) for c in meant.changes] == [(a, b)]
    lab.certify(b, from_ns=scan.started_ns)
    assert [(c.before, c.after) for c in lab.would_withdraw(b)] == [(b, a)]
    lab.withdraw(b)
    assert lab.effective(scan).calibration.calibration_id() == a


TIMES = st.one_of(st.none(), st.integers(0, 12))
RANGES = st.tuples(TIMES, TIMES).filter(lambda r: None in r or r[0] < r[1])  # type: ignore[operator]


@given(st.lists(st.tuples(RANGES, st.booleans()), max_size=7))
def test_the_timeline_is_the_newest_that_covers_each_moment(
    claims: list[tuple[tuple[int | None, int | None], bool]],
) -> None:
    events: list[AnyArchiveEvent] = []
    for i, ((begin, end), back) in enumerate(claims):
        name = f"0{i:025d}"
        events.append(
            Certified(id=name, t_ns=i, calibration=f"c-{i}", rig="r1", from_ns=begin, to_ns=end)
        )
        if back:
            events.append(
                Withdrawn(id=f"1{i:025d}", t_ns=50, calibration=f"c-{i}", after=name, note="x")
            )
    standing = standing_certifications(events)
    ranges = effective_ranges(standing, "r1")
    assert (ranges[0][0][0], ranges[-1][0][1]) == (None, None)
    entries = timeline(events).get("r1", [])
    assert len(entries) == len(claims)
    for t_ns in range(14):
        expected = holding(standing, "r1", t_ns)
        found = [
            e for (begin, end), e in ranges if (begin or 0) <= t_ns and (end is None or t_ns < end)
        ]
        assert found == [expected]
        effective = [
            e.certified
            for e in entries
            if any((b or 0) <= t_ns and (end is None or t_ns < end) for b, end in e.effective)
        ]
        assert effective == ([expected] if expected else [])
    for entry, (_, back) in zip(entries, claims, strict=True):
        assert (entry.state == "withdrawn") == back
        assert back or (entry.state == "replaced") == (not entry.effective)


def test_why_a_scan_is_stale_in_one_line(lab: Archive) -> None:
    def why(recipe: str, choice: str = "current") -> str:
        (plan,) = lab.plan(lab.scans(), BUILT_IN[recipe], choice)
        assert not isinstance(plan, Exception)
        line = lab.why_stale(plan)
        assert "\n" not in line
        return line

    recorded = lab.scan("latest").calibration
    assert why("default") == ""
    assert why("paper").startswith("recipe changed: paper (r-")
    moved = lab.add_calibration(calibration(h=201.0, k1=-0.2))
    lab.certify(moved)
    assert why("default") == f"calibration changed: intrinsics, plane/0 ({recorded} to {moved})"
    assert [o.error for o in derive(lab, lab.scans(), BUILT_IN["paper"])] == [None]
    lens = lab.add_calibration(calibration(h=201.0, k1=-0.3))
    assert why("paper", lens).startswith("calibration changed: intrinsics (")
    assert "its stripes changed" not in why("paper", lens)
    (manifest,) = (m for m in lab.derivations() if m.kind == "points" and m.calibration == moved)
    lab.store.local(manifest.path).unlink()
    assert why("paper") == "derived before, but its table is gone"
