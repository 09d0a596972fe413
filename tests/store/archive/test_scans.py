"""Scans are sealed, named, tagged, retired; equal content is noticed."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.process.pipeline import derive
from turnscan.schemas.errors import (
    ConflictError,
    InputError,
    NotFoundError,
    UsageError,
)
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.verify import verify

from .scans import calibration, import_scan


def test_a_sealed_scan_is_checked_by_sha256sum(lab: Archive) -> None:
    scan = lab.scan("latest").scan
    folder = lab.root / "scans" / scan
    assert sorted(os.listdir(folder)) == ["manifest-sha256.txt", "scan.json", "scan.mcap"]
    done = subprocess.run(
        ["sha256sum", "-c", "manifest-sha256.txt"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count(": OK") == 2


def test_importing_the_same_content_twice_is_noticed(lab: Archive, source: Path) -> None:
    known = lab.scan("latest").scan
    for p in source.glob("*.png"):
        os.utime(p)
    with pytest.raises(ConflictError, match=f"are scan {known} already"):
        import_scan(lab, source)
    assert len(lab.scans()) == 1
    assert len(os.listdir(lab.root / "scans")) == 1
    assert import_scan(lab, source, step=11.0).scan != known


def test_scans_are_named_by_id_prefix_label_and_latest(lab: Archive, source: Path) -> None:
    first = lab.scan("latest")
    assert lab.scan(first.scan) == lab.scan(first.scan[:20]) == lab.scan("first") == first
    assert lab.scan(first.scan[2:12]) == first
    second = import_scan(lab, source, step=12.0)
    assert lab.scan("latest") == second
    with pytest.raises(NotFoundError, match="'first' fits 2 scans"):
        lab.scan("first")
    with pytest.raises(NotFoundError, match="no scan 'none'"):
        lab.scan("none")


def test_tags_labels_and_retirement_are_events(lab: Archive) -> None:
    scan = lab.scan("latest").scan
    log = (lab.root / "scans" / scan / "scan.mcap").read_bytes()
    lab.tag(scan, {"owner": "a", "x": "1"}, "bust")
    lab.tag(scan, {"x": ""})
    row = lab.scan_rows()[0]
    assert (row["label"], row["tags"]) == ("bust", {"owner": "a"})
    lab.retire(scan)
    assert lab.scans() == []
    assert lab.scan_rows(retired=True)[0]["retired"] is True
    lab.retire(scan, back=True)
    assert len(lab.scans()) == 1
    assert len(os.listdir(lab.root / "events")) == 4
    assert (lab.root / "scans" / scan / "scan.mcap").read_bytes() == log


def test_where_selects_and_only_reads(lab: Archive) -> None:
    assert len(lab.scan_rows(where="rig = 'r1' AND frames = 4")) == 1
    assert lab.scan_rows(where="rig = 'other'") == []
    assert lab.scan_rows(where="tags ->> 'owner' = 'a'") == []
    for bad in (
        "rigg = 1",
        "1; DROP TABLE scans",
        "1) UNION SELECT * FROM events --",
        "load_extension('x')",
    ):
        with pytest.raises(UsageError, match="--where"):
            lab.scan_rows(where=bad)
    assert len(lab.scans()) == 1


def test_the_same_content_imported_again_has_points_of_its_own(lab: Archive, source: Path) -> None:
    first = lab.scan("latest")
    poses = poses_by_step(sorted(source.glob("*.png")), step_deg=10.0)
    started = first.started_ns
    plan = ImportPlan(poses, rig="r1", calibration=calibration(), started_ns=started, again=True)
    second = import_images(lab, plan)
    assert second.content_sha256 == first.content_sha256
    outcomes = list(derive(lab, lab.scans(), BUILT_IN["default"]))
    assert [o.derived for o in outcomes] == [(), ("stripes", "points")]
    points = lab.points().collect()
    assert set(points["scan"]) == {first.scan, second.scan}
    assert verify(lab) == []


def test_angles_of_many_turns_stay_exact(tmp_path: Path, source: Path) -> None:
    archive = Archive.init(tmp_path / "lab")
    a = import_scan(archive, source)
    poses = poses_by_step(sorted(source.glob("*.png")), step_deg=10.0, start_deg=360.0 * 90)
    b = import_images(archive, ImportPlan(poses, rig="r1", calibration=calibration()))
    list(derive(archive, archive.scans(), BUILT_IN["default"]))
    one, two = (
        archive.points(where=f"scan = '{s.scan}'").select("x_mm", "y_mm", "z_mm").collect().to_numpy()
        for s in (a, b)
    )
    assert np.allclose(one, two, atol=1e-3)


def test_a_frame_of_another_size_stops_its_scan(lab: Archive) -> None:
    from turnscan.schemas.events import Exposure, ScanStart, TurntableAngle
    from turnscan.store.log_writer import LogWriter

    with lab.new_scan() as draft:
        with LogWriter(draft.part) as writer:
            writer.write_event(
                ScanStart(t_ns=5, scan="x", rig="r1", source="test", time_source="clock", software="t")
            )
            writer.write_event(TurntableAngle(t_ns=6, commanded_rad=0.0))
            for i, shape in enumerate([(48, 64), (40, 64)]):
                writer.write_image(
                    Exposure(t_ns=7 + i, frame=i, lasers_on=(0,)), np.zeros(shape, np.uint8)
                )
        scan = lab.seal(draft, draft.examine())
    (outcome,) = derive(lab, [scan], BUILT_IN["default"], lab.scan("first").calibration or "")
    assert isinstance(outcome.error, InputError)
    assert "frame 1: is 64 x 40, the scan's first frame is 64 x 48" in str(outcome.error)
