"""A log is followed while it grows: the same items, facts and digests as when it is read at its end."""

from __future__ import annotations

import hashlib
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from logs import images

from turnscan.schemas.errors import DamageError, InputError
from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.store.log_digest import digest_log
from turnscan.store.log_follow import GrowingLog
from turnscan.store.log_reader import LogFrame, ScanLog
from turnscan.store.log_writer import LogWriter


def begin(path: Path) -> LogWriter:
    writer = LogWriter(path)
    start = ScanStart(t_ns=1, scan="s-x", rig="r", source="test", time_source="clock", software="t")
    writer.write_event(start)
    return writer


def put(writer: LogWriter, n: int, image: np.ndarray) -> None:
    writer.write_event(TurntableAngle(t_ns=10 + 10 * n, commanded_rad=0.1 * n))
    writer.write_image(Exposure(t_ns=11 + 10 * n, frame=n, lasers_on=(0,)), image)


def finish(writer: LogWriter, count: int) -> None:
    writer.write_event(ScanEnd(t_ns=10**6, ended="complete", frames=count))
    writer.finish()


def test_a_frame_is_given_as_soon_as_its_chunk_is_written(tmp_path: Path) -> None:
    path, made = tmp_path / "log", images(6)
    writer = begin(path)
    whole = threading.Event()
    growing = GrowingLog(path, whole.wait)
    seen: list[LogFrame] = []
    done = threading.Event()

    def follow() -> None:
        for item in growing.items():
            if isinstance(item, LogFrame):
                seen.append(item)
        done.set()

    thread = threading.Thread(target=follow)
    thread.start()
    for n, image in enumerate(made):
        put(writer, n, image)
        writer.flush()
        until = time.monotonic() + 10
        while len(seen) <= n and time.monotonic() < until:
            time.sleep(0.005)
        assert len(seen) == n + 1, "the log is not finished, and the frame is there"
    finish(writer, len(made))
    assert not done.wait(0.05), "nobody has said yet that the file is whole"
    whole.set()
    thread.join(10)
    assert done.is_set()
    assert all(np.array_equal(f.decode(), m) for f, m in zip(seen, made, strict=True))
    assert growing.facts() == digest_log(ScanLog(path))
    assert growing.log_sha256() == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_file_that_grows_byte_by_byte_reads_the_same(tmp_path: Path) -> None:
    """Whatever part of a record is visible, it is waited for whole."""
    source, path = tmp_path / "source", tmp_path / "log"
    writer = begin(source)
    for n, image in enumerate(images(3)):
        put(writer, n, image)
        writer.flush()
    finish(writer, 3)
    data = source.read_bytes()
    path.write_bytes(b"")
    at = 0

    def more(_: float) -> bool:
        nonlocal at
        step = 1 + at % 97
        with path.open("ab") as file:
            file.write(data[at : at + step])
        at += step
        return at >= len(data)

    growing = GrowingLog(path, more)
    kinds = [(type(i), i.t_ns) for i in growing.items()]
    assert kinds == [(type(i), i.t_ns) for i in ScanLog(source).items()]
    assert growing.facts() == digest_log(ScanLog(source))
    assert growing.log_sha256() == hashlib.sha256(data).hexdigest()


def test_a_flipped_byte_is_noticed_while_following(tmp_path: Path) -> None:
    path = tmp_path / "log"
    writer = begin(path)
    for n, image in enumerate(images(3, (40, 40))):
        put(writer, n, image)
    finish(writer, 3)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    growing = GrowingLog(path, lambda _: True)
    with pytest.raises(DamageError):
        list(growing.items())


def test_a_writer_that_is_gone_ends_the_following(tmp_path: Path) -> None:
    path = tmp_path / "log"
    writer = begin(path)
    put(writer, 0, images(1)[0])
    writer.flush()

    def gone(_: float) -> bool:
        raise InputError("the recorder ended before its log did")

    with pytest.raises(InputError, match="recorder ended"):
        list(GrowingLog(path, gone).items())
    writer.abandon()


def test_a_refused_write_can_be_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chunk that did not fit goes, half of it on disk or not; what was there before stands."""
    import errno
    import os

    from turnscan.schemas.errors import StorageError

    path = tmp_path / "log"
    writer = begin(path)
    made = images(4)
    put(writer, 0, made[0])
    writer.flush()
    real = os.writev

    def full(handle: int, views: list[memoryview]) -> int:
        real(handle, [views[0][:7]])
        raise OSError(errno.ENOSPC, "No space left on device")

    put(writer, 1, made[1])
    put(writer, 2, made[2])
    with monkeypatch.context() as patch:
        patch.setattr(os, "writev", full)
        with pytest.raises(StorageError, match="no room"):
            writer.flush()
    assert writer.images == 3
    assert writer.drop_unwritten() == 6
    assert writer.images == 1
    writer.write_event(ScanEnd(t_ns=10**6, ended="interrupted", frames=1))
    writer.finish()
    (frame,) = ScanLog(path).frames()
    assert np.array_equal(frame.decode(), made[0])
    assert digest_log(ScanLog(path)).frames == 1
