"""Damage of each kind is found; what can be put right is, and nothing is deleted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from turnscan.process.pipeline import derive
from turnscan.schemas.errors import (
    DamageError,
    DocumentError,
)
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.repair import repair
from turnscan.store.verify import verify

from .scans import calibration, flip, import_scan


def test_a_good_archive_verifies(lab: Archive) -> None:
    lab.certify(lab.add_calibration(calibration(h=205.0)))
    assert verify(lab) == []


def damage(lab: Archive, what: str) -> str:
    """Damage one thing; returns a part of the path that must be found."""
    scan = lab.scan("latest").scan
    folder = lab.root / "scans" / scan
    points = next(m for m in lab.derivations() if m.kind == "points")
    if what == "log":
        flip(folder / "scan.mcap", 3000)
        return "scan.mcap"
    if what == "summary":
        text = (folder / "scan.json").read_text()
        (folder / "scan.json").write_text(text.replace('"frames": 4', '"frames": 5'))
        return "scan.json"
    if what == "scan-manifest":
        text = (folder / "manifest-sha256.txt").read_text()
        (folder / "manifest-sha256.txt").write_text(
            text[:10] + ("1" if text[10] == "0" else "0") + text[11:]
        )
        return "scan.mcap"
    if what == "table":
        flip(lab.root / points.path, 300)
        return points.path
    if what == "manifest":
        path = (lab.root / points.path).with_suffix(".json")
        path.write_text(path.read_text().replace('"rows":', '"rowz":'))
        return path.name
    if what == "stray":
        path = (lab.root / points.path).with_name("k-ffffffffffff.parquet")
        path.write_bytes(b"x")
        return path.name
    if what == "event":
        lab.tag("latest", {"a": "b"})
        path = next((lab.root / "events").iterdir())
        path.write_text("{")
        return path.name
    path = next((lab.root / "calibrations").iterdir())
    path.write_text(path.read_text().replace('"fx_px": 300.0', '"fx_px": NaN'))
    return path.name


@pytest.mark.parametrize(
    "what",
    ["log", "summary", "scan-manifest", "table", "manifest", "stray", "event", "calibration"],
)
def test_verify_finds_each_kind_of_damage(lab: Archive, what: str) -> None:
    path = damage(lab, what)
    found = verify(lab)
    assert any(path in f.path for f in found), found
    assert all(f.what and f.hint for f in found)


@pytest.mark.parametrize("what", ["table", "manifest", "stray"])
def test_repair_moves_damaged_tables_aside_and_process_derives_them(lab: Archive, what: str) -> None:
    damage(lab, what)
    before = {p for p in lab.root.rglob("k-*") if p.is_file()}
    planned = repair(lab, dry_run=True)
    assert {p for p in lab.root.rglob("k-*") if p.is_file()} == before
    done = repair(lab)
    assert [r.path for r in planned] == [r.path for r in done]
    assert len({p for p in lab.root.rglob("k-*") if p.is_file()}) == len(before), "nothing is deleted"
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["default"])
    assert outcome.error is None
    assert verify(lab) == []


def test_a_damaged_log_stops_its_scan_alone(lab: Archive, source: Path) -> None:
    damage(lab, "log")
    second = import_scan(lab, source, step=12.0)
    a, b = derive(lab, lab.scans(), BUILT_IN["paper"])
    assert isinstance(a.error, DamageError)
    assert "scan.mcap: damaged at byte" in str(a.error)
    assert (b.scan, b.error) == (second.scan, None)


def test_a_damaged_summary_is_named_when_the_catalogue_needs_it(lab: Archive) -> None:
    damage(lab, "summary")
    text = lab.root / "scans" / lab.scan("latest").scan / "scan.json"
    text.write_text(text.read_text().replace('"frames"', '"framez"'))
    lab.catalog.path.unlink()
    with pytest.raises(DocumentError, match=r"scan\.json: .*framez"):
        Archive.open(lab.root)


def test_an_unfinished_scan_is_salvaged_and_kept(lab: Archive) -> None:
    from turnscan.schemas.events import Exposure, ScanStart, TurntableAngle
    from turnscan.store.log_writer import LogWriter

    with lab.new_scan(keep_part=True) as draft:
        writer = LogWriter(draft.part)
        writer.write_event(
            ScanStart(
                t_ns=5, scan=draft.scan, rig="r1", source="test", time_source="clock", software="t"
            )
        )
        writer.write_event(TurntableAngle(t_ns=6, commanded_rad=0.25))
        writer.write_image(Exposure(t_ns=7, frame=0, lasers_on=(0,)), np.zeros((48, 64), np.uint8))
        writer.flush()
        part = draft.part.read_bytes()
        held = repair(lab)
        assert any("being written" in r.did for r in held)
        writer.abandon()
    assert any("not sealed" in f.what for f in verify(lab))
    did = repair(lab)
    assert any("salvaged 1 frames" in r.did for r in did)
    assert draft.part.read_bytes() == part
    new = lab.scan("latest")
    assert (new.ended, new.salvaged_from, new.frames) == ("salvaged", draft.scan, 1)
    assert not any("salvaged 1 frames" in r.did for r in repair(lab)), "once is enough"


def test_a_changed_manifest_or_event_is_noticed_even_if_it_is_still_json(lab: Archive) -> None:
    lab.tag("latest", {"a": "b"})
    points = next(m for m in lab.derivations() if m.kind == "points")
    for path, old, new in (
        ((lab.root / points.path).with_suffix(".json"), '"frames": 4', '"frames": 3'),
        (next((lab.root / "events").iterdir()), '"a": "b"', '"a": "c"'),
    ):
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        found = verify(lab)
        assert any(path.name in f.path and "its own digest" in f.what for f in found), found
        path.write_text(text)
    assert verify(lab) == []


def test_repair_waits_for_a_publication_that_is_under_way(lab: Archive) -> None:
    import threading

    points = next(m for m in lab.derivations() if m.kind == "points")
    manifest = (lab.root / points.path).with_suffix(".json")
    text = manifest.read_bytes()
    done: list[str] = []
    with lab.store.holding(alone=False):
        manifest.unlink()  # A table that is published already, and its manifest not yet.
        tidy = threading.Thread(target=lambda: done.extend(r.did for r in repair(lab)))
        tidy.start()
        tidy.join(0.5)
        assert tidy.is_alive()
        manifest.write_bytes(text)
    tidy.join(30)
    assert done == ["rebuilt"]
    assert verify(lab) == []
