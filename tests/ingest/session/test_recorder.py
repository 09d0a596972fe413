"""The recorder: time order, what comes late, queues that are full, disks that are full."""

from __future__ import annotations

import random
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from turnscan.ingest.session.recorder import Recorder
from turnscan.ingest.session.room import KeptBack, check_room, needed_bytes
from turnscan.schemas.errors import DeviceError, StorageError
from turnscan.schemas.events import DeviceLine, Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.store.log_digest import digest_log
from turnscan.store.log_reader import LogFrame, ScanLog
from turnscan.store.log_writer import LogWriter

START = ScanStart(t_ns=0, scan="s-x", rig="r", source="test", time_source="given", software="t")


def frame(n: int, t_ns: int) -> Exposure:
    return Exposure(t_ns=t_ns, frame=n, lasers_on=(0,))


def image(n: int) -> np.ndarray:
    return np.random.default_rng(n).integers(0, 256, (64, 64), np.uint8)


def items(path: Path) -> list[object]:
    return list(ScanLog(path).items())


def test_what_comes_in_any_order_is_written_in_the_order_of_time(tmp_path: Path) -> None:
    recorder = Recorder(LogWriter(tmp_path / "log"))
    recorder.put(START)
    times = list(range(10, 90))
    random.Random(3).shuffle(times)
    for n in range(0, 80, 8):
        for t in sorted(times[n : n + 8], reverse=True):
            if t % 3:
                recorder.put(TurntableAngle(t_ns=t, commanded_rad=float(t)))
            else:
                assert recorder.put_frame(frame(t, t), image(t), wait=True)
        recorder.settle(5)
    recorder.settle(89)
    recorder.close(95, "complete", "")
    found = items(tmp_path / "log")
    seen = [i.t_ns for i in found if isinstance(i, (TurntableAngle, LogFrame))]
    assert seen == sorted(times)
    for item in found:
        if isinstance(item, LogFrame):
            assert np.array_equal(item.decode(), image(item.frame))


def test_late_facts_are_refused_late_frames_counted_late_remarks_kept(tmp_path: Path) -> None:
    recorder = Recorder(LogWriter(tmp_path / "log"))
    recorder.put(START)
    recorder.put(TurntableAngle(t_ns=50, commanded_rad=0.0))
    recorder.settle(100)
    with pytest.raises(DeviceError, match="came after 100"):
        recorder.put(TurntableAngle(t_ns=99, commanded_rad=1.0))
    assert not recorder.put_frame(frame(0, 99), image(0), wait=False)
    assert recorder.dropped == 1
    recorder.put(DeviceLine(t_ns=99, device="d", direction="sent", line="x"))
    assert recorder.put_frame(frame(0, 100), image(0), wait=False)
    recorder.close(100, "complete", "")
    (line,) = [i for i in items(tmp_path / "log") if isinstance(i, DeviceLine)]
    assert line.t_ns == 100


def test_a_full_queue_drops_and_counts_or_is_waited_for(tmp_path: Path) -> None:
    recorder = Recorder(LogWriter(tmp_path / "log"), queue_bytes=2 * 4096)
    recorder.put(START)
    recorder.put(TurntableAngle(t_ns=1, commanded_rad=0.0))
    # Nothing is settled, so nothing leaves the queue: three frames are more than it holds.
    taken = [recorder.put_frame(frame(n, 10 + n), image(n), wait=False) for n in range(6)]
    assert taken == [True, True, True, False, False, False]
    assert (recorder.frames, recorder.dropped, recorder.backlog_bytes) == (3, 3, 3 * 4096)
    recorder.settle(12)
    assert recorder.put_frame(frame(3, 20), image(3), wait=True)
    recorder.close(30, "complete", "")
    frames = [i for i in items(tmp_path / "log") if isinstance(i, LogFrame)]
    assert [f.frame for f in frames] == [0, 1, 2, 3]


def test_a_frame_is_on_the_disk_as_soon_as_nothing_else_waits(tmp_path: Path) -> None:
    """What a kill cannot take: chunks are closed when the writer has nothing to do, not when full."""
    from turnscan.store.salvage import salvage_log

    writer = LogWriter(tmp_path / "log")
    recorder = Recorder(writer)
    recorder.put(START)
    for n in range(3):
        recorder.put(TurntableAngle(t_ns=10 * n + 1, commanded_rad=0.0))
        recorder.put_frame(frame(n, 10 * n + 2), image(n), wait=True)
        recorder.settle(10 * n + 2)
        before = -1
        for _ in range(500):
            if writer.size_bytes == before and not recorder.backlog_bytes:
                break
            before = writer.size_bytes
            threading.Event().wait(0.01)
        copy = tmp_path / f"cut{n}"
        copy.write_bytes((tmp_path / "log").read_bytes())
        saved = salvage_log(copy, tmp_path / f"new{n}", scan="s-y", salvaged_from="s-x")
        assert saved.frames == n + 1
    recorder.abandon()


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond ``size``: the nearest thing to a full disk that needs no rights."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_ends_the_log_with_what_got_there(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with largest_file(300_000):
        recorder = Recorder(LogWriter(path))
        recorder.put(START)
        with pytest.raises(StorageError, match="no room"):
            for n in range(200):
                recorder.put(TurntableAngle(t_ns=10 * n + 1, commanded_rad=0.01 * n))
                recorder.put_frame(frame(n, 10 * n + 2), image(n), wait=True)
                recorder.settle(10 * n + 2)
                threading.Event().wait(0.003)
    recorder.close(10_000, "complete", "as planned")  # Room again: what was kept back was given back.
    found = items(path)
    end = found[-1]
    assert isinstance(end, ScanEnd)
    assert end.ended == "interrupted"
    assert "no room" in end.note
    frames = [i for i in found if isinstance(i, LogFrame)]
    assert len(frames) == end.frames > 2
    for n, item in enumerate(frames):
        assert item.frame == n
        assert np.array_equal(item.decode(), image(n))
    assert digest_log(ScanLog(path)).frames == end.frames


def test_without_room_for_an_end_the_part_stays_to_be_salvaged(tmp_path: Path) -> None:
    from turnscan.store.salvage import salvage_log

    path = tmp_path / "log"
    with largest_file(30_000):
        recorder = Recorder(LogWriter(path))
        recorder.put(START)
        with pytest.raises(StorageError):
            for n in range(200):
                recorder.put(TurntableAngle(t_ns=10 * n + 1, commanded_rad=0.01 * n))
                recorder.put_frame(frame(n, 10 * n + 2), image(n), wait=True)
                recorder.settle(10 * n + 2)
                threading.Event().wait(0.003)
        resource.setrlimit(
            resource.RLIMIT_FSIZE, (path.stat().st_size, resource.getrlimit(resource.RLIMIT_FSIZE)[1])
        )
        size = path.stat().st_size
        with largest_file(max(size - 20_000, 1)), pytest.raises(StorageError):
            recorder.close(10_000, "complete", "")
    recorder.abandon()
    saved = salvage_log(path, tmp_path / "new", scan="s-y", salvaged_from="s-x")
    assert saved.frames >= 1


def test_room_is_asked_for_before_and_the_amount_is_said(tmp_path: Path) -> None:
    needed = needed_bytes(1000, 1280, 1024, "mono8")
    assert 0.42 * 1000 * 1280 * 1024 < needed < 1000 * 1280 * 1024
    assert needed_bytes(1000, 1280, 1024, "bgr8") > 2.5 * needed
    assert check_room(tmp_path, 1) > 0
    with pytest.raises(StorageError, match=r"needs about 9000000.0 GB, .* are free"):
        check_room(tmp_path, 9_000_000_000_000_000)


def test_room_that_is_kept_back_is_real_and_given_back(tmp_path: Path) -> None:
    kept = KeptBack(tmp_path / "room")
    assert (tmp_path / "room").stat().st_blocks * 512 >= 4 << 20
    kept.give_back()
    kept.give_back()
    assert not (tmp_path / "room").exists()
