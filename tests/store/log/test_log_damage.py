"""Damage is reported, never returned as pixels; what is whole of an unfinished log is salvaged."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logs import images, write_log
from mcap.reader import make_reader

from turnscan.schemas.errors import DamageError, InputError, StorageError, TurnscanError
from turnscan.schemas.events import ScanEnd, ScanStart
from turnscan.store.log_reader import LogFrame, ScanLog
from turnscan.store.salvage import salvage_log


def check_flip(data: bytes, at: int, bit: int, path: Path, frames: list[np.ndarray]) -> None:
    """A flipped bit raises, and before it does no wrong pixel has been given out."""
    broken = bytearray(data)
    broken[at] ^= 1 << bit
    path.write_bytes(broken)
    with pytest.raises(DamageError, match=r"flip\.mcap"):
        for frame in ScanLog(path).frames():
            assert np.array_equal(frame.decode(), frames[frame.frame])


@pytest.mark.parametrize(("chunk_bytes", "stride"), [(300, 7), (1 << 20, 1)])
def test_a_flip_of_any_byte_is_reported(tmp_path: Path, chunk_bytes: int, stride: int) -> None:
    frames = images(2)
    data = write_log(tmp_path / "good.mcap", frames, chunk_bytes=chunk_bytes).read_bytes()
    for at in range(0, len(data), stride):
        check_flip(data, at, at % 8, tmp_path / "flip.mcap", frames)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flip_of_any_bit_is_reported(
    tmp_path_factory: pytest.TempPathFactory, place: float, bit: int
) -> None:
    folder = tmp_path_factory.mktemp("flip")
    frames = images(3, (9, 9), "u2")
    data = write_log(folder / "good.mcap", frames, chunk_bytes=400).read_bytes()
    check_flip(data, int(place * len(data)), bit, folder / "flip.mcap", frames)


def test_bytes_after_the_end_are_reported(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", images(1))
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(DamageError, match="does not end as an MCAP file"):
        list(ScanLog(path).items())


def test_something_else_is_no_log(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"%PDF-1.7")
    with pytest.raises(DamageError, match="does not begin as an MCAP file"):
        list(ScanLog(path).items())
    with pytest.raises(StorageError, match="no such file"):
        list(ScanLog(tmp_path / "none").items())


@pytest.mark.parametrize("flush", [True, False])
def test_salvage_gives_every_whole_frame_of_any_prefix(tmp_path: Path, flush: bool) -> None:
    frames = images(4)
    data = write_log(tmp_path / "good.mcap", frames, flush=flush).read_bytes()
    seen = []
    for cut in range(0, len(data), 7):
        part, new = tmp_path / "scan.mcap.part", tmp_path / "new.mcap"
        new.unlink(missing_ok=True)
        part.write_bytes(data[:cut])
        try:
            saved = salvage_log(part, new, scan="s-new", salvaged_from="s-old")
        except TurnscanError:
            seen.append(0)
            continue
        items = list(ScanLog(new).items())
        got = [i for i in items if isinstance(i, LogFrame)]
        assert len(got) == saved.frames
        for frame in got:
            assert np.array_equal(frame.decode(), frames[frame.frame])
        start, end = items[0], items[-1]
        assert isinstance(start, ScanStart)
        assert (start.scan, start.salvaged_from) == ("s-new", "s-old")
        assert isinstance(end, ScanEnd)
        assert (end.ended, end.frames) == ("salvaged", len(got))
        assert part.read_bytes() == data[:cut]
        seen.append(len(got))
    assert seen == sorted(seen)
    assert seen[-1] == 4
    if flush:
        # Each flush made a frame safe: all counts occur as the file grows.
        assert set(seen) == {0, 1, 2, 3, 4}


def test_salvage_leaves_out_a_broken_chunk_and_says_so(tmp_path: Path) -> None:
    frames = images(4)
    path = write_log(tmp_path / "a.mcap", frames, flush=True)
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    broken = summary.chunk_indexes[1]
    data[broken.chunk_start_offset + broken.chunk_length - 3] ^= 1
    path.write_bytes(data)
    saved = salvage_log(path, tmp_path / "new.mcap", scan="n", salvaged_from="o")
    assert [f.frame for f in ScanLog(tmp_path / "new.mcap").frames()] == [0, 2, 3]
    assert len(saved.lost) == 1
    assert f"the chunk at byte {broken.chunk_start_offset}" in saved.lost[0]


def test_nothing_to_salvage_is_an_error(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", [])
    with pytest.raises(InputError, match="no whole frame"):
        salvage_log(path, tmp_path / "new.mcap", scan="n", salvaged_from="o")


WRITER = """
import sys, numpy as np
from pathlib import Path
from turnscan.store.log_writer import LogWriter
from turnscan.schemas.events import Exposure, ScanStart, TurntableAngle
writer = LogWriter(Path(sys.argv[1]))
writer.write_event(ScanStart(t_ns=0, scan="s", rig="r", source="t", time_source="clock", software="t"))
writer.write_event(TurntableAngle(t_ns=0, commanded_rad=0.0))
for i in range(100000):
    writer.write_image(Exposure(t_ns=i, frame=i, lasers_on=(0,)), np.full((50, 60), i % 256, np.uint8))
    writer.flush()
    print(i, flush=True)
"""


def test_every_flushed_frame_survives_kill_9(tmp_path: Path) -> None:
    part = tmp_path / "scan.mcap.part"
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(part)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    flushed = -1
    for line in process.stdout:
        flushed = int(line)
        if flushed == 40:
            os.kill(process.pid, signal.SIGKILL)
            break
    flushed = max([flushed, *(int(line) for line in process.stdout)])
    process.stdout.close()
    process.wait()
    saved = salvage_log(part, tmp_path / "new.mcap", scan="n", salvaged_from="o")
    assert saved.frames >= flushed + 1
    for frame in ScanLog(tmp_path / "new.mcap").frames():
        assert (frame.decode() == frame.frame % 256).all()


FULL = """
import resource, signal, sys
from pathlib import Path
from turnscan.schemas.errors import StorageError
sys.path.insert(0, sys.argv[2])
from logs import images, write_log
from mcap.reader import make_reader
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
try:
    write_log(Path(sys.argv[1]), images(20, (50, 50)), flush=True)
except StorageError as error:
    print(error, "|", error.hint)
"""


def test_a_full_disk_keeps_what_was_flushed(tmp_path: Path) -> None:
    assert resource.RLIMIT_FSIZE
    part = tmp_path / "scan.mcap.part"
    said = subprocess.run(
        [sys.executable, "-c", FULL, str(part), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "no room for" in said
    assert "what was flushed before is kept" in said
    saved = salvage_log(part, tmp_path / "new.mcap", scan="n", salvaged_from="o")
    assert saved.frames == 4
