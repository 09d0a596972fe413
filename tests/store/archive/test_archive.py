"""The archive: sealing, content addresses, events, plans, publishing, catalogue, damage."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.process.pipeline import derive
from turnscan.schemas.calibration import Calibration
from turnscan.schemas.errors import (
    CalibrationError,
    ConflictError,
    DamageError,
    DocumentError,
    FormatVersionError,
    NotFoundError,
    StorageError,
    UsageError,
)
from turnscan.schemas.manifests import ScanSummary
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.repair import repair
from turnscan.store.verify import verify

from .scans import calibration, write_images


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("images"), 4)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory, source: Path) -> Path:
    """An archive with one processed scan, to be copied by tests."""
    archive = Archive.init(tmp_path_factory.mktemp("archive") / "lab")
    import_scan(archive, source)
    assert [o.error for o in derive(archive, archive.scans(), BUILT_IN["default"])] == [None]
    return archive.root


def import_scan(
    archive: Archive, source: Path, *, rig: str = "r1", c: Calibration | None = None, step: float = 10.0
) -> ScanSummary:
    poses = poses_by_step(sorted(source.glob("*.png")), step_deg=step)
    document = calibration() if c is None else c
    return import_images(archive, ImportPlan(poses, rig=rig, label="first", calibration=document))


@pytest.fixture
def lab(tmp_path: Path, template: Path) -> Archive:
    shutil.copytree(template, tmp_path / "lab")
    return Archive.open(tmp_path / "lab")


# -- opening --------------------------------------------------------------------------------------


def test_init_refuses_what_is_not_empty(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("mine")
    with pytest.raises(ConflictError, match="is not empty"):
        Archive.init(tmp_path)
    Archive.init(tmp_path / "new")
    with pytest.raises(ConflictError, match="is an archive already"):
        Archive.init(tmp_path / "new")


def test_open_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match=r"no archive \(it has no turnscan\.toml\)"):
        Archive.open(tmp_path)


def test_find_looks_upward(lab: Archive) -> None:
    deep = lab.root / "scans" / "deep"
    deep.mkdir()
    assert Archive.find(deep).root == lab.root
    with pytest.raises(NotFoundError, match="no archive in"):
        Archive.find("/")


def test_a_newer_archive_is_refused_and_untouched(lab: Archive) -> None:
    path = lab.root / "turnscan.toml"
    text = path.read_text().replace("version = 1", "version = 2")
    path.write_text(text)
    with pytest.raises(
        FormatVersionError, match=r"turnscan\.archive version 2, this turnscan reads up to 1"
    ):
        Archive.open(lab.root)
    assert path.read_text() == text


# -- scans ----------------------------------------------------------------------------------------


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


# -- calibrations ---------------------------------------------------------------------------------


def test_calibrations_are_content_addressed(lab: Archive) -> None:
    c = calibration(h=200.0)
    name = lab.add_calibration(c)
    assert name == c.calibration_id() == lab.add_calibration(c)
    assert lab.calibration(name[:6]) == c
    with pytest.raises(NotFoundError, match="no calibration"):
        lab.calibration("c-000000000000")


def test_the_effective_calibration(lab: Archive) -> None:
    scan = lab.scan("latest")
    recorded = scan.calibration
    start = scan.started_ns
    assert lab.effective(scan).calibration.calibration_id() == recorded
    a, b = (lab.add_calibration(calibration(h=h)) for h in (201.0, 202.0))
    lab.certify(a)
    assert lab.effective(scan).calibration.calibration_id() == a
    lab.certify(b, from_ns=start + 1)
    lab.certify(b, to_ns=start)
    lab.certify(b, rig="another")
    assert lab.effective(scan).calibration.calibration_id() == a, "none of b's ranges covers it"
    lab.certify(b, from_ns=start, to_ns=start + 1)
    assert lab.effective(scan).calibration.calibration_id() == b
    assert lab.effective(scan, "recorded").calibration.calibration_id() == recorded
    assert lab.effective(scan, a).calibration.calibration_id() == a
    lab.withdraw(b)
    assert lab.effective(scan).calibration.calibration_id() == a
    lab.withdraw(a)
    assert lab.effective(scan).calibration.calibration_id() == recorded
    with pytest.raises(CalibrationError, match="is not certified"):
        lab.withdraw(a)
    assert Archive.open(lab.root).effective(scan).calibration.calibration_id() == recorded


def test_events_are_ordered_though_the_clock_steps_back(
    lab: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    from turnscan.schemas import ids
    from turnscan.store import archive as module

    old = ids.new_ulid(1_000_000_000)
    a, b = (lab.add_calibration(calibration(h=h)) for h in (201.0, 202.0))
    lab.certify(a)
    monkeypatch.setattr(module, "new_ulid", lambda: old)
    lab.certify(b)
    names = sorted(os.listdir(lab.root / "events"))
    assert json.loads((lab.root / "events" / names[-1]).read_text())["calibration"] == b
    assert lab.effective(lab.scan("latest")).calibration.calibration_id() == b


def test_an_edited_calibration_is_noticed(lab: Archive) -> None:
    path = next((lab.root / "calibrations").iterdir())
    path.write_text(path.read_text().replace('"fx_px": 300.0', '"fx_px": 301.0'))
    with pytest.raises(DamageError, match="the file was changed"):
        lab.calibration(path.stem)
    assert any("the file was changed" in f.what for f in verify(lab))


# -- catalogue ------------------------------------------------------------------------------------


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


# -- derivations ----------------------------------------------------------------------------------


def test_same_key_same_bytes(lab: Archive) -> None:
    made = {m.kind: m for m in lab.derivations()}
    before = {k: (lab.root / m.path).read_bytes() for k, m in made.items()}
    shutil.rmtree(lab.root / "derived")
    list(derive(Archive.open(lab.root), lab.scans(), BUILT_IN["default"]))
    for kind, manifest in made.items():
        assert (lab.root / manifest.path).read_bytes() == before[kind]


def test_parquet_is_as_the_format_says(lab: Archive) -> None:
    import pyarrow.parquet as pq

    from turnscan.schemas.tables import POINTS

    manifest = next(m for m in lab.derivations() if m.kind == "points")
    with pq.ParquetFile(lab.root / manifest.path, page_checksum_verification=True) as file:
        assert file.schema_arrow.equals(POINTS.arrow_schema(), check_metadata=False)
        group = file.metadata.row_group(0)
        assert {group.column(i).compression for i in range(group.num_columns)} == {"ZSTD"}
        names = file.schema_arrow.names
        assert "BYTE_STREAM_SPLIT" in group.column(names.index("x_mm")).encodings
        assert group.column(0).has_column_index
        assert file.metadata.metadata[b"turnscan.key"].decode() == manifest.key
        table = file.read()
    order = table["frame"].to_numpy().astype(np.int64) * 65536 + table["row"].to_numpy()
    assert (np.diff(order) >= 0).all()


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def test_a_flipped_page_is_reported_when_read(lab: Archive) -> None:
    manifest = next(m for m in lab.derivations() if m.kind == "points")
    path = lab.root / manifest.path
    good = path.read_bytes()
    whole = [b.to_pydict() for b in lab.read(manifest)]
    reported = 0
    places = range(4, manifest.bytes, 23)
    for at in places:
        flip(path, at)
        try:
            # What no checksum covers (page heads) may flip, but never a value that is given out.
            assert repr([b.to_pydict() for b in lab.read(manifest)]) == repr(whole)
        except DamageError as error:
            assert f"{path.name}: " in str(error)
            reported += 1
        assert verify(lab), "the digest of the whole file finds every flip"
        path.write_bytes(good)
    assert reported > 0.6 * len(places)


def test_cut_or_missing_tables_are_reported(lab: Archive) -> None:
    manifest = next(m for m in lab.derivations() if m.kind == "points")
    path = lab.root / manifest.path
    path.write_bytes(path.read_bytes()[:-5])
    for reading in (lambda: list(lab.read(manifest)), lambda: lab.points().collect()):
        with pytest.raises(DamageError, match="bytes, its manifest says"):
            reading()
    path.unlink()
    with pytest.raises(DamageError, match="is missing"):
        list(lab.read(manifest))
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["default"])
    assert outcome.error is not None or outcome.derived == ("points",)


def test_a_table_that_was_deleted_is_derived_again(lab: Archive) -> None:
    shutil.rmtree(lab.root / "derived" / "points")
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["default"])
    assert outcome.error is None
    assert outcome.derived == ("points",)
    assert verify(lab) == []


KILLED = """
import os, signal, sys
from pathlib import Path
from turnscan.store import Archive
from turnscan.store.bytes import LocalFolder
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
count = int(sys.argv[2])
link = os.link
def counted(*a, **k):
    global count
    count -= 1
    if count == 0 and sys.argv[3] == "before": os.kill(os.getpid(), signal.SIGKILL)
    link(*a, **k)
    if count == 0: os.kill(os.getpid(), signal.SIGKILL)
os.link = counted
archive = Archive.open(sys.argv[1])
list(derive(archive, archive.scans(), BUILT_IN["paper"]))
"""


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("publish", [1, 2, 3, 4])
def test_a_killed_process_leaves_nothing_half_published(lab: Archive, publish: int, when: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(lab.root), str(publish), when], check=False
    )
    assert done.returncode == -9
    archive = Archive.open(lab.root)
    archive.points(recipe="default").collect()
    (outcome,) = derive(archive, archive.scans(), BUILT_IN["paper"])
    assert outcome.error is None
    repair(archive)
    assert os.listdir(archive.root / "staging") == []
    assert verify(archive) == []
    assert archive.points(recipe="paper").collect().height > 0


TWO = """
import sys
from turnscan.store import Archive
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
archive = Archive.open(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
for o in derive(archive, archive.scans(), BUILT_IN["paper"]):
    assert o.error is None, o.error
"""


def test_two_processes_deriving_the_same_key_both_succeed(lab: Archive) -> None:
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", TWO, str(lab.root)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for p in pair:
        assert p.stdout is not None
        assert p.stdout.readline() == "ready\n"
    for p in pair:
        p.communicate("go\n", timeout=60)
        assert p.returncode == 0
    archive = Archive.open(lab.root)
    assert len([m for m in archive.derivations() if m.recipe == BUILT_IN["paper"].recipe_id()]) == 2
    assert verify(archive) == []


def test_workers_do_not_change_the_result(lab: Archive, source: Path, tmp_path: Path) -> None:
    import_scan(lab, source, step=12.0)
    shutil.copytree(lab.root, tmp_path / "copy")
    copy = Archive.open(tmp_path / "copy")
    one = list(derive(lab, lab.scans(), BUILT_IN["paper"], workers=1))
    two = list(derive(copy, copy.scans(), BUILT_IN["paper"], workers=2))
    assert [(o.scan, o.derived, o.points) for o in one] == [(o.scan, o.derived, o.points) for o in two]
    a = {m.key: m.sha256 for m in lab.derivations()}
    assert a == {m.key: m.sha256 for m in copy.derivations()}


FULL = """
import resource, signal, sys
from turnscan.store import Archive
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
archive = Archive.open(sys.argv[1])
archive.scans()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
for o in derive(archive, archive.scans(), BUILT_IN["paper"]):
    print(type(o.error).__name__, o.error, o.error.hint)
"""


def test_a_full_disk_publishes_nothing_and_says_so(lab: Archive) -> None:
    before = sorted(p for p in (lab.root / "derived").rglob("*") if p.is_file())
    said = subprocess.run(
        [sys.executable, "-c", FULL, str(lab.root)], capture_output=True, text=True, check=True
    ).stdout
    assert "StorageError" in said
    assert "the disk is full" in said
    assert "free some space" in said
    assert sorted(p for p in (lab.root / "derived").rglob("*") if p.is_file()) == before
    assert os.listdir(lab.root / "staging") == []
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["paper"])
    assert outcome.error is None


# -- verify and repair ----------------------------------------------------------------------------


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


def test_storage_errors_name_the_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises((StorageError, ConflictError)):
        Archive.init(tmp_path / "file" / "lab")


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


def test_a_killed_worker_is_said_and_results_come_in_order() -> None:
    from turnscan.process.workers import in_processes
    from turnscan.schemas.errors import InputError

    with pytest.raises(InputError, match="a worker process was killed"):
        list(in_processes(2, os._exit, [(3,), (3,)]))
    assert list(in_processes(2, pow, [(i, 2) for i in range(9)])) == [i * i for i in range(9)]


STOPPED = """
import sys
from turnscan.process.workers import in_processes
import time
print("ready", flush=True)
list(in_processes(2, time.sleep, [(30,)] * 8))
"""


def test_an_interrupt_ends_all_workers_at_once() -> None:
    import signal
    import time

    process = subprocess.Popen(
        [sys.executable, "-c", STOPPED],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(2.0)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode != 0
    assert said.count("Traceback") <= 1, said


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


def test_a_lost_calibration_is_found_and_comes_back_from_the_log(lab: Archive, source: Path) -> None:
    name = lab.scan("latest").calibration
    other = import_scan(lab, source, step=12.0, c=calibration(h=160.0))
    (lab.root / "calibrations" / f"{name}.json").unlink()
    again = Archive.open(lab.root)
    found = verify(again)
    assert any(name in f.path and "is missing" in f.what for f in found), found
    a, b = derive(again, again.scans(), BUILT_IN["paper"])
    assert isinstance(a.error, DamageError)
    assert (b.scan, b.error) == (other.scan, None), "one scan's damage stops no other"
    assert any("restored from the log" in r.did for r in repair(again))
    again = Archive.open(lab.root)
    assert verify(again) == []
    assert [o.error for o in derive(again, again.scans(), BUILT_IN["paper"])] == [None, None]


def test_the_calibrations_size_is_checked_without_an_undistort_stage(lab: Archive) -> None:
    from turnscan.schemas.recipe import Extract, Recipe, Triangulate

    wrong = calibration().model_copy(
        update={"camera": calibration().camera.model_copy(update={"width_px": 640})}
    )
    name = lab.add_calibration(wrong)
    recipe = Recipe(name="bare", stages=(Extract(), Triangulate()))
    (outcome,) = derive(lab, lab.scans(), recipe, name)
    assert isinstance(outcome.error, CalibrationError)
    assert "frames are 64 x 48, the calibration is for 640 x 48" in str(outcome.error)


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
