"""A log read with a thread that decompresses ahead gives what it gives without one, damage included."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from logs import images, write_log

from turnscan.schemas.errors import TurnscanError
from turnscan.store import log_ahead
from turnscan.store.log_reader import LogFrame, ScanLog
from turnscan.store.log_walk import RecordWalk


class Pixels:
    """What is made of a frame: its number and its pixels; and which threads made it."""

    def __init__(self, *, worth: bool) -> None:
        self._worth = worth
        self.threads: set[str] = set()

    def __call__(self, item: LogFrame) -> object:
        # Whoever is at it leaves the next one to others.
        time.sleep(0.002)
        self.threads.add(threading.current_thread().name.split("_")[0])
        return item.frame, item.decode().tobytes()

    def worth_a_thread(self) -> bool:
        return self._worth


def told(path: Path, *, ahead: int, each: Pixels | None = None) -> tuple[list[object], str]:
    """Every item with its pixels, and how the reading ended."""
    out: list[object] = []
    try:
        for item in ScanLog(path).items(ahead=ahead, each=each):
            out.append((item.frame, item.decode().tobytes()) if isinstance(item, LogFrame) else item)
    except TurnscanError as error:
        return out, str(error)
    return out, "whole"


@pytest.mark.parametrize("chunk_bytes", [200, 1000, 1 << 20])
def test_it_gives_the_same_items(tmp_path: Path, chunk_bytes: int) -> None:
    path = write_log(tmp_path / "a.mcap", images(12), chunk_bytes=chunk_bytes)
    items, end = told(path, ahead=2)
    assert end == "whole"
    assert (items, end) == told(path, ahead=0)
    assert sum(isinstance(i, tuple) for i in items) == 12


# In small chunks a frame stands in another one than its exposure.
@pytest.mark.parametrize("chunk_bytes", [200, 5000])
@pytest.mark.parametrize("ahead", [0, 1, 3])
@pytest.mark.parametrize("worth", [False, True])
def test_what_is_made_of_frames_comes_in_their_place(
    tmp_path: Path, chunk_bytes: int, ahead: int, worth: bool
) -> None:
    path = write_log(tmp_path / "a.mcap", images(60), chunk_bytes=chunk_bytes)
    each = Pixels(worth=worth)
    assert told(path, ahead=ahead, each=each) == told(path, ahead=0)
    if not (worth and ahead):
        assert each.threads == {"MainThread"}
    elif chunk_bytes == 5000:
        assert "decompress" in each.threads


def test_what_stands_before_a_fault_comes_first(tmp_path: Path) -> None:
    whole = write_log(tmp_path / "a.mcap", images(6), chunk_bytes=300).read_bytes()
    broken = tmp_path / "b.mcap"
    for at in range(8, len(whole), 37):
        data = bytearray(whole)
        data[at] ^= 4
        broken.write_bytes(data)
        alone = told(broken, ahead=0)
        assert told(broken, ahead=2) == alone, at
        assert told(broken, ahead=1, each=Pixels(worth=True)) == alone, at


def test_of_large_chunks_few_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_log(tmp_path / "a.mcap", images(60), chunk_bytes=5000)
    alone = told(path, ahead=0)
    begun = 0
    submit = ThreadPoolExecutor.submit

    def counted(pool: ThreadPoolExecutor, *job: Any) -> Any:
        nonlocal begun
        begun += 1
        return submit(pool, *job)

    monkeypatch.setattr(ThreadPoolExecutor, "submit", counted)
    for limit, waiting in ((1, 2), (1 << 24, 5)):
        monkeypatch.setattr(log_ahead, "_WAITING_BYTES", limit)
        begun = 0
        walk = iter(RecordWalk(path, ahead=1))
        next(walk)
        assert begun == waiting
        assert len(list(walk)) > 60
        assert told(path, ahead=1) == alone


def test_no_thread_stays_behind(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", images(12), chunk_bytes=200)
    before = threading.active_count()
    items = ScanLog(path).items(ahead=2)
    for _ in range(12):
        next(items)
    assert threading.active_count() > before
    items.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before
