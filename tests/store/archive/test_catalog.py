"""The catalogue is a projection: made from nothing it is the same, and nobody misses it for long."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from turnscan.process.pipeline import derive
from turnscan.schemas.errors import (
    DamageError,
    NotFoundError,
)
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.verify import verify

from .scans import calibration, import_scan


def test_the_catalogue_is_the_same_made_from_nothing(lab: Archive, source: Path) -> None:
    import_scan(lab, source, step=12.0)
    lab.certify(lab.add_calibration(calibration(h=205.0)))
    list(derive(lab, lab.scans(), BUILT_IN["paper"]))
    lab.tag("latest", {"a": "b"})
    before = lab.catalog.dump()
    assert all(before.values())
    lab.catalog.path.unlink()
    assert Archive.open(lab.root).catalog.dump() == before
    lab.catalog.path.write_bytes(b"no database")
    assert Archive.open(lab.root).catalog.dump() == before


def test_what_is_copied_in_or_taken_out_is_noticed(lab: Archive, source: Path, tmp_path: Path) -> None:
    other = Archive.init(tmp_path / "other")
    scan = import_scan(other, source, step=13.0).scan
    shutil.copytree(other.root / "scans" / scan, lab.root / "scans" / scan)
    again = Archive.open(lab.root)
    assert scan in [s.scan for s in again.scans()]
    shutil.rmtree(lab.root / "scans" / scan)
    assert scan not in [s.scan for s in Archive.open(lab.root).scans()]


LOOKING = """
import sys
from turnscan.store import Archive
for _ in range(25):
    Archive.open(sys.argv[1]).catalog.path.unlink(missing_ok=True)
    assert len(Archive.open(sys.argv[1]).scan_rows()) == 1
"""


def test_a_catalogue_that_vanishes_under_several_readers_is_made_again(lab: Archive) -> None:
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", LOOKING, str(lab.root)], stderr=subprocess.PIPE, text=True
        )
        for _ in range(3)
    ]
    for p in pair:
        _, said = p.communicate(timeout=60)
        assert p.returncode == 0, said
    assert verify(lab) == []


def test_an_entry_finds_its_catalogue_gone_and_makes_it_again(lab: Archive) -> None:
    lab.catalog.path.unlink()
    lab.tag("latest", {"a": "b"})
    assert lab.scan_rows()[0]["tags"] == {"a": "b"}
    lab.catalog.path.write_bytes(b"no database at all, but long enough to be looked at" * 40)
    list(derive(lab, lab.scans(), BUILT_IN["paper"]))
    assert verify(lab) == []


def test_points_are_not_left_out_silently_when_something_is_wrong(lab: Archive) -> None:
    assert lab.points(recipe="paper").collect().is_empty(), "not derived: no rows, and no error"
    with pytest.raises(NotFoundError, match="no calibration 'c-none'"):
        lab.points(calibration="c-none")
    next((lab.root / "calibrations").iterdir()).unlink()
    with pytest.raises(DamageError, match="the file is missing"):
        Archive.open(lab.root).points()


_KILLED = """
import os, sqlite3, sys
c = sqlite3.connect(sys.argv[1], isolation_level=None)
c.execute("PRAGMA cache_size = 1")  # so that pages go to the file before the end of the transaction
c.execute("BEGIN IMMEDIATE")
c.execute("UPDATE scans SET label = 'half-done'")
c.executemany("INSERT INTO events VALUES (?, 'k', 0, ?)", [(f"x{i}", "d" * 900) for i in range(400)])
os._exit(9)
"""


@pytest.mark.parametrize("then", ["read", "write", "remake"])
def test_a_writer_that_was_killed_leaves_nothing_half_done(lab: Archive, then: str) -> None:
    before = lab.catalog.dump()
    path = lab.root / "catalog.sqlite"
    subprocess.run([sys.executable, "-c", _KILLED, str(path)], check=False)
    assert (lab.root / "catalog.sqlite-journal").stat().st_size > 0
    if then == "write":
        lab.tag("latest", {"a": "b"})
        lab.tag("latest", {"a": ""})
        events = {e["event"] for e in before["events"]}
        assert len(lab.catalog.rows("SELECT event FROM events")) == len(events) + 2
        return
    if then == "remake":
        lab.rebuild_catalog()
    assert lab.catalog.dump() == before
    assert not (lab.root / "catalog.sqlite-journal").exists()
    assert Archive.open(lab.root).catalog.dump() == before
