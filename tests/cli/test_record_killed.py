"""``turnscan record`` killed at any moment: nothing flushed is lost, and it goes on."""

from __future__ import annotations

import json
import random
import time

import polars as pl
import pytest
from console import Console
from recordings import archive_of, begin, frames_on_disk, growing, points_of, wait_for_frames

from turnscan.store.verify import verify


def killed(
    console: Console, label: str, after_s: float, after_frames: int = 0
) -> tuple[bytes | None, int]:
    """Record, kill -9 so long after so many frames; the log's part and the frames flushed by then."""
    process = begin(console, "--to-deg", "120", "--label", label)
    assert console.archive is not None
    if after_frames:
        wait_for_frames(console.archive, after_frames, process)
    time.sleep(after_s)
    process.kill()
    process.communicate(timeout=150)
    parts = growing(console.archive)
    part = parts[-1].read_bytes() if parts else None
    return part, 0 if part is None else frames_on_disk(part)


def kill_and_resume(
    console: Console, label: str, whole: pl.DataFrame, after_s: float, after_frames: int = 0
) -> int:
    """One random moment: nothing flushed is lost, and the scan is finished as if nothing had been."""
    part, flushed = killed(console, label, after_s, after_frames)
    before = len(archive_of(console).scans())
    if part is None:
        console("repair")  # Killed while it was sealed, perhaps.
        return -1
    row = console.json("record", "--resume", "latest")
    archive = archive_of(console)
    chain = archive.chain(row["scan"])
    if flushed:
        assert row["continues"] == chain[0].scan
        assert chain[0].ended == "salvaged"
        assert chain[0].frames >= flushed
    if not flushed and len(part) < 200:
        return 0  # Not even its plan was written: the rig file's holds.
    assert sum(s.frames for s in chain) == 61
    console("process", row["scan"])
    archive = archive_of(console)
    assert points_of(archive, [s.scan for s in chain]).equals(whole)
    assert len(archive.scans()) >= before
    assert verify(archive) == []
    return flushed


def test_kill_9_loses_nothing_that_was_flushed(lab: Console) -> None:
    row = lab.json("record", "--to-deg", "120", "--label", "whole")
    whole = points_of(archive_of(lab), [row["scan"]])
    rng = random.Random(5)
    for n in range(2):
        flushed = kill_and_resume(lab, f"k{n}", whole, rng.uniform(0, 0.1), rng.randint(2, 20))
        assert 0 < flushed < 61


@pytest.mark.slow
def test_kill_9_at_fifty_random_moments(lab: Console) -> None:
    row = lab.json("record", "--to-deg", "120", "--label", "whole")
    whole = points_of(archive_of(lab), [row["scan"]])
    rng = random.Random(11)
    found = [kill_and_resume(lab, f"k{n}", whole, rng.uniform(0.3, 5.0)) for n in range(50)]
    assert sum(0 < n < 61 for n in found) >= 5, found


def test_killed_before_the_first_frame_resume_begins_anew(lab: Console) -> None:
    archive = archive_of(lab)
    with archive.new_scan(keep_part=True) as draft:
        draft.part.write_bytes(b"\x89MCAP0\r\n")
    done = lab("record", "--resume", draft.scan, "--json")
    assert "recording from the beginning" in done.stderr
    assert json.loads(done.stdout)["frames"] == 16


def test_killed_after_its_last_frame_a_scan_is_done_when_it_is_salvaged(lab: Console) -> None:
    lab("record", "--no-extract")
    archive = archive_of(lab)
    (scan,) = archive.scans()
    folder = archive.root / "scans" / scan.scan
    (folder / "scan.mcap").rename(folder / "scan.mcap.part")
    (folder / "scan.json").unlink()
    (folder / "manifest-sha256.txt").unlink()
    (archive.root / "catalog.sqlite").unlink()
    row = lab.json("record", "--resume", "latest")
    assert (row["ended"], row["frames"]) == ("salvaged", 16)
    assert verify(archive_of(lab)) == []


def test_killed_before_its_first_frame_a_scan_keeps_its_plan(lab: Console) -> None:
    from turnscan.schemas.events import ScanStart
    from turnscan.store.log_writer import LogWriter

    plan = {"to_deg": 10.0, "step_deg": 5.0}
    with archive_of(lab).new_scan(keep_part=True) as draft:
        writer = LogWriter(draft.part)
        writer.write_event(
            ScanStart(
                t_ns=5,
                scan=draft.scan,
                rig="sim",
                label="early",
                source="simulated",
                time_source="clock",
                software="t",
                plan=plan,
            )
        )
        writer.flush()
        writer.abandon()
    done = lab("record", "--resume", "latest", "--json", "--no-extract")
    row = json.loads(done.stdout)
    assert (row["frames"], row["label"], row["continues"]) == (3, "early", None)
