"""``turnscan record`` as users run it: whole scans, Ctrl-C, kill -9, full disks, going on."""

from __future__ import annotations

import json
import random
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from console import Console, Inside, surroundings
from rig_files import write_rig

from turnscan.process.pipeline import derive
from turnscan.schemas.events import DeviceLine, LaserState, ScanEnd
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.verify import verify


@pytest.fixture
def lab(tmp_path: Path) -> Console:
    """A console with an archive and a rig file of a small simulated rig."""
    console = Inside(tmp_path)
    console("init", "lab")
    console.archive = tmp_path / "lab"
    write_rig(tmp_path)
    return console


def archive_of(console: Console) -> Archive:
    assert console.archive is not None
    return Archive.open(console.archive)


def points_of(archive: Archive, scans: list[str]) -> pl.DataFrame:
    """Points of some logs as one table, without what differs from one recording to the next."""
    marks = ", ".join(f"'{s}'" for s in scans)
    table = archive.points(where=f"scan IN ({marks})").collect()
    columns = ["angle_rad", "laser", "row", "u_px", "x_mm", "y_mm", "z_mm", "amplitude_dn"]
    return table.select(columns).sort(["angle_rad", "laser", "row"])


def begin(console: Console, *words: object) -> subprocess.Popen[str]:
    """A recording in a process and group of its own."""
    return subprocess.Popen(
        console.command("record", *words),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        cwd=console.cwd,
        env=surroundings(),
        start_new_session=True,
    )


def growing(archive: Path) -> list[Path]:
    """Logs that are neither sealed nor salvaged."""
    parts = (archive / "scans").glob("*/scan.mcap.part")
    return sorted(p for p in parts if not p.with_name("salvaged.txt").exists())


def wait_for_frames(archive: Path, count: int, process: subprocess.Popen[str]) -> Path:
    """The growing log, once it holds so many frames."""
    until = time.monotonic() + 60
    while time.monotonic() < until and process.poll() is None:
        for part in growing(archive):
            if frames_on_disk(part.read_bytes()) >= count:
                return part
        time.sleep(0.01)
    raise AssertionError(process.communicate())


def test_a_scan_is_recorded_extracted_and_sealed(lab: Console) -> None:
    row = lab.json("record", "--label", "bust", "--tag", "owner=lab2")
    assert (row["ended"], row["frames"], row["dropped"], row["label"]) == ("complete", 16, 0, "bust")
    assert row["points"] > 16 * 60
    archive = archive_of(lab)
    assert verify(archive) == []
    shown = lab.json("scan", "show", "bust")
    assert (shown["source"], shown["tags"]) == ("simulated", {"owner": "lab2"})
    assert {d["table"] for d in shown["derivations"]} == {"stripes", "points"}
    assert lab.json("status") == []
    lab("export", "bust", "cloud.ply")


def test_live_tables_are_byte_for_byte_those_that_process_derives(lab: Console) -> None:
    lab("record", "--to-deg", "60")
    archive = archive_of(lab)
    made = {m.path: (archive.root / m.path).read_bytes() for m in archive.derivations()}
    assert len(made) == 2
    shutil.rmtree(archive.root / "derived")
    (archive.root / "catalog.sqlite").unlink()
    again = Archive.open(archive.root)
    (outcome,) = derive(again, again.scans(), BUILT_IN["default"])
    assert outcome.derived == ("stripes", "points")
    assert {m.path: (archive.root / m.path).read_bytes() for m in again.derivations()} == made


def test_the_paper_recipe_runs_beside_as_well(lab: Console) -> None:
    assert lab.json("record", "--recipe", "paper", "--to-deg", "10")["points"] > 0
    assert lab.json("status", "--recipe", "paper") == []


def test_without_extraction_process_does_it_later(lab: Console) -> None:
    done = lab("record", "--no-extract", "--to-deg", "6")
    assert "no points yet: turnscan process" in done.stderr
    assert [row["table"] for row in lab.json("status")] == ["stripes and points"]
    lab("process", "latest")
    assert lab.json("status") == []


def test_a_failing_extraction_leaves_the_recording_whole_and_says_so(lab: Console) -> None:
    (lab.cwd / "off.toml").write_text(
        'name = "off"\n[[stages]]\nstage = "extract"\nbackground = "off-frame"\n'
        '[[stages]]\nstage = "triangulate"\n'
    )
    done = lab("record", "--recipe", "off.toml", "--to-deg", "10", "--json")
    assert "extraction beside the recording failed" in done.stderr
    assert "laser-off frame" in done.stderr
    assert json.loads(done.stdout)["frames"] == 6
    assert verify(archive_of(lab)) == []
    lab("process", "latest")


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_seals_what_there_is_and_resume_takes_the_rest(lab: Console, number: int) -> None:
    whole = lab.json("record", "--to-deg", "200", "--label", "whole")
    process = begin(lab, "--to-deg", "200", "--label", "cut")
    assert lab.archive is not None
    wait_for_frames(lab.archive, 5, process)
    process.send_signal(number)
    out, err = process.communicate(timeout=150)
    assert process.returncode == 130, (out, err)
    assert "Traceback" not in err
    assert "to go on with what is missing: turnscan record --rig rig.toml --resume" in err
    archive = archive_of(lab)
    cut = archive.scan("cut")
    assert cut.ended == "interrupted"
    assert 0 < cut.frames < 101
    items = list(archive.log(cut.scan).items())
    last = [i for i in items if isinstance(i, LaserState)][-1]
    assert not last.on
    assert any(isinstance(i, DeviceLine) for i in items[-8:]), "the last words to the controller"
    (end,) = [i for i in items if isinstance(i, ScanEnd)]
    assert (end.ended, end.frames) == ("interrupted", cut.frames)

    rest = lab.json("record", "--resume", "cut")
    assert (rest["continues"], rest["label"]) == (cut.scan, "cut")
    assert cut.frames + rest["frames"] == whole["frames"] == 101
    assert points_of(archive, [cut.scan, rest["scan"]]).equals(points_of(archive, [whole["scan"]]))


def test_a_resumed_scan_is_shown_processed_and_exported_as_one(lab: Console) -> None:
    process = begin(lab, "--to-deg", "200", "--label", "cut")
    assert lab.archive is not None
    wait_for_frames(lab.archive, 5, process)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=150)
    second = lab.json("record", "--resume", "cut")
    first = second["continues"]
    for word in ("cut", first, second["scan"], "latest"):
        shown = lab.json("scan", "show", word)
        assert [log["scan"] for log in shown["logs"]] == [first, second["scan"]]
        assert {d["scan"] for d in shown["derivations"]} == {first, second["scan"]}
    text = lab("scan", "show", "cut").stdout
    assert "101, of them 0" in text
    assert "0 to 200" in text
    lab("export", "cut", "both.csv")
    rows = pl.read_csv(lab.cwd / "both.csv", infer_schema_length=None)
    assert rows.height == sum(d["rows"] for d in shown["derivations"] if d["table"] == "points")
    assert len(lab.json("process", "cut", "--recipe", "paper")) == 2
    lab("scan", "tag", "cut", "part=both")
    assert all(r["tags"] == {"part": "both"} for r in lab.json("scan", "list"))
    error = lab.fails("record", "--resume", "latest")
    assert "no pose" in error


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


def frames_on_disk(part: bytes) -> int:
    """Frames in the whole chunks of a log that was cut off, counted by the format's rules alone."""
    import struct

    import zstandard

    at, frames = 8, 0
    image: set[int] = set()
    while at + 9 <= len(part):
        opcode, length = struct.unpack_from("<BQ", part, at)
        if at + 9 + length > len(part):
            break
        if opcode == 0x06:
            (size,) = struct.unpack_from("<Q", part, at + 9 + 16)
            (name,) = struct.unpack_from("<I", part, at + 9 + 28)
            (stored,) = struct.unpack_from("<Q", part, at + 9 + 32 + name)
            data = part[at + 9 + 40 + name :][:stored]
            inner = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
            i = 0
            while i < len(inner):
                kind, n = struct.unpack_from("<BQ", inner, i)
                (channel,) = struct.unpack_from("<H", inner, i + 9)
                if kind == 0x04 and b"/image" in inner[i : i + 9 + n]:
                    image.add(channel)
                frames += kind == 0x05 and channel in image
                i += 9 + n
        at += 9 + length
    return frames


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


def test_a_full_disk_stops_it_cleanly_and_keeps_what_was_written(lab: Console) -> None:
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))

    done = subprocess.run(
        lab.command("record", "--to-deg", "340", "--no-extract"),
        capture_output=True,
        text=True,
        check=False,
        cwd=lab.cwd,
        env=surroundings(),
        preexec_fn=limited,
        timeout=60,
    )
    assert done.returncode == 1, (done.stdout, done.stderr)
    assert done.stderr.count("error: ") == 1
    assert "no room" in done.stderr
    assert "Traceback" not in done.stderr
    # Not even its end can be written here: the limit holds for that, too.
    assert "turnscan repair salvages it" in done.stderr
    rest = lab.json("record", "--resume", "latest", "--no-extract")
    archive = archive_of(lab)
    first, second = archive.chain(rest["scan"])
    assert first.ended == "salvaged"
    assert first.frames > 5
    assert first.frames + second.frames == 171
    assert verify(archive) == []


def test_a_disk_that_is_really_full_still_takes_the_end_of_the_log(lab: Console) -> None:
    """Somebody else fills a small file system meanwhile: what was kept back ends the log well."""
    disk = lab.cwd / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=24m", "turnscan-test", disk],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip("mounting a small file system needs rights")
    try:
        lab.archive = None
        lab("init", disk / "lab")
        lab.archive = disk / "lab"
        (disk / "filler").write_bytes(bytes(2 << 20))
        process = begin(lab, "--to-deg", "340", "--no-extract")
        wait_for_frames(lab.archive, 5, process)
        with (disk / "filler").open("ab", buffering=0) as filler:
            try:
                while True:
                    filler.write(bytes(1 << 16))
            except OSError:
                pass
        _, err = process.communicate(timeout=150)
        assert process.returncode == 1, err
        assert err.count("error: ") == 1
        assert "no room" in err
        archive = archive_of(lab)
        (scan,) = archive.scans()
        assert scan.ended == "interrupted"
        assert 0 < scan.frames < 171
        (disk / "filler").unlink()
        assert verify(archive) == []
        rest = lab.json("record", "--resume", "latest", "--no-extract")
        assert scan.frames + rest["frames"] == 171
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


def test_too_little_room_is_said_before_anything_moves(lab: Console) -> None:
    from turnscan.ingest.session import room

    assert room.needed_bytes(10**9, 4000, 3000, "mono8") > 10**15
    rig = lab.cwd / "rig.toml"
    rig.write_text(rig.read_text().replace("step_deg = 2", "step_deg = 0.001\nframes_per_pose = 1000"))
    error = lab.fails("record", "--to-deg", "360")
    assert "the scan needs about" in error
    assert "are free" in error
    assert archive_of(lab).store.list("scans") == []


@pytest.mark.parametrize(
    ("words", "said", "code"),
    [
        (("--rig", "none.toml"), "none.toml", 1),
        (("--to-deg", "0"), "nothing to scan", 1),
        (("--to-deg", "9000"), "the scan turns from", 1),
        (("--resume", "nobody"), "no scan 'nobody'", 1),
        (("--resume", "x", "--to-deg", "5"), "--resume goes on with the plan", 2),
        (("--resume", "x", "--label", "y"), "--resume goes on with the plan", 2),
    ],
)
def test_bad_input_is_one_clear_error(lab: Console, words: Any, said: str, code: int) -> None:
    assert said in lab.fails("record", *words, code=code)


def test_another_rig_cannot_go_on_with_a_scan(lab: Console) -> None:
    lab("record", "--to-deg", "6", "--no-extract")
    rig = lab.cwd / "rig.toml"
    rig.write_text(rig.read_text().replace('name = "sim"', 'name = "other"'))
    assert "is of rig 'sim'" in lab.fails("record", "--resume", "latest")


def test_an_imported_scan_has_no_plan_to_go_on_with(lab: Console, tiny_files: Path) -> None:
    lab("import", "images", tiny_files / "photos", "--step-deg", "10", "--rig", "sim")
    assert "was not recorded by turnscan record" in lab.fails("record", "--resume", "latest")


def test_the_same_seed_gives_the_same_points(lab: Console) -> None:
    rows = [lab.json("record") for _ in range(2)]
    archive = archive_of(lab)
    one, two = (points_of(archive, [r["scan"]]) for r in rows)
    assert one.equals(two)
    assert np.isfinite(one["x_mm"].to_numpy()).all()
