"""``turnscan record`` on a disk that is full, or too small."""

from __future__ import annotations

import resource
import subprocess

import pytest
from console import Console, surroundings
from recordings import archive_of, begin, wait_for_frames

from turnscan.store.verify import verify


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
