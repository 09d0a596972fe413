"""Scans of several logs: which belong together, what names them, and what can be taken up again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.schemas.errors import ConflictError, InputError, NotFoundError
from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.schemas.manifests import ScanSummary
from turnscan.store import Archive
from turnscan.store.log_writer import LogWriter
from turnscan.store.names import chain_of
from turnscan.store.resumable import scan_to_resume
from turnscan.store.verify import verify

from .scans import calibration


def write(writer: LogWriter, scan: str, continues: str | None, label: str) -> None:
    start = ScanStart(
        t_ns=5,
        scan=scan,
        rig="r1",
        label=label,
        source="test",
        time_source="clock",
        software="t",
        continues=continues,
    )
    writer.write_event(start)
    writer.write_calibration(calibration(), 5)
    writer.write_event(TurntableAngle(t_ns=6, commanded_rad=0.25))
    writer.write_image(Exposure(t_ns=7, frame=0, lasers_on=(0,)), np.zeros((48, 64), np.uint8))


def add(archive: Archive, continues: str | None = None, label: str = "bust") -> ScanSummary:
    with archive.new_scan() as draft:
        with LogWriter(draft.part) as writer:
            write(writer, draft.scan, continues, label)
            writer.write_event(ScanEnd(t_ns=8, ended="interrupted", frames=1))
        return archive.seal(draft, draft.examine())


def cut_off(archive: Archive, continues: str | None = None) -> str:
    """A recording that was killed: a .part with one frame."""
    with archive.new_scan(keep_part=True) as draft:
        writer = LogWriter(draft.part)
        write(writer, draft.scan, continues, "bust")
        writer.flush()
        writer.abandon()
    return draft.scan


def test_any_log_of_a_chain_leads_to_all_of_it(lab: Archive) -> None:
    one = add(lab).scan
    two = add(lab, one).scan
    three = add(lab, two).scan
    other = add(lab, label="other").scan
    for name in (one, two, three):
        assert [s.scan for s in lab.chain(name)] == [one, two, three]
    assert [s.scan for s in lab.chain(other)] == [other]
    assert lab.scan("bust").scan == one, "the label of a chain is not ambiguous"
    lab.rebuild_catalog()
    assert [s.continues for s in lab.chain(one)] == [None, one, two]
    assert verify(lab) == []


def test_two_scans_of_one_label_are_still_ambiguous(lab: Archive) -> None:
    add(lab)
    add(lab)
    with pytest.raises(NotFoundError, match="'bust' fits 2 scans"):
        lab.scan("bust")


def test_a_retired_log_is_left_out(lab: Archive) -> None:
    one = add(lab).scan
    two = add(lab, one).scan
    lab.retire(two)
    assert [s.scan for s in lab.chain(one)] == [one]
    assert [s.scan for s in lab.chain(two)] == [one, two]


@given(st.lists(st.integers(0, 30), max_size=30))
def test_every_member_of_a_chain_gives_the_same_chain(parents: list[int]) -> None:
    """Any links at all, also to logs that are gone: no loop hangs, no log stands twice."""
    rows = [
        {"scan": f"s{n:02d}", "continues": f"s{p:02d}" if p != n else None}
        for n, p in enumerate(parents)
    ]
    for row in rows:
        chain = chain_of(row["scan"] or "", rows)
        assert row["scan"] in chain
        assert len(set(chain)) == len(chain)
        if all(p < n for n, p in enumerate(parents)):
            assert all(chain_of(name, rows) == chain for name in chain)


def test_what_was_cut_off_is_salvaged_once_and_taken_up(lab: Archive) -> None:
    one = add(lab).scan
    killed = cut_off(lab, one)
    logs = scan_to_resume(lab, "latest")
    assert [s.scan for s in logs[:1]] == [one]
    assert (logs[1].salvaged_from, logs[1].continues) == (killed, one)
    again = scan_to_resume(lab, killed)
    assert [s.scan for s in again] == [s.scan for s in logs]
    assert [s.scan for s in scan_to_resume(lab, killed[2:20].lower())] == [s.scan for s in logs]
    assert [s.scan for s in scan_to_resume(lab, "latest")] == [s.scan for s in logs]
    assert verify(lab) == []


def test_what_is_being_recorded_is_left_alone(lab: Archive) -> None:
    with lab.new_scan() as draft:
        draft.part.write_bytes(b"")
        with pytest.raises(ConflictError, match="being written"):
            scan_to_resume(lab, draft.scan)


def test_what_holds_nothing_or_does_not_exist_is_said(lab: Archive) -> None:
    with lab.new_scan(keep_part=True) as draft:
        draft.part.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(InputError, match="before its first frame"):
        scan_to_resume(lab, "latest")
    with lab.new_scan(keep_part=True) as draft:
        draft.part.write_bytes(b"")
    with pytest.raises(InputError, match="before its first frame"):
        scan_to_resume(lab, draft.scan)
    assert verify(lab) == [], "what holds nothing is no damage"
    with pytest.raises(NotFoundError):
        scan_to_resume(lab, "nobody")
