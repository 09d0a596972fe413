"""A log read with a thread that decompresses ahead gives what it gives without one, damage included."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from logs import images, write_log

from turnscan.schemas.errors import TurnscanError
from turnscan.store.log_reader import LogFrame, ScanLog


def told(path: Path, *, ahead: bool) -> tuple[list[object], str]:
    """Every item with its pixels, and how the reading ended."""
    out: list[object] = []
    try:
        for item in ScanLog(path).items(ahead=ahead):
            out.append((item.frame, item.decode().tobytes()) if isinstance(item, LogFrame) else item)
    except TurnscanError as error:
        return out, str(error)
    return out, "whole"


@pytest.mark.parametrize("chunk_bytes", [200, 1000, 1 << 20])
def test_it_gives_the_same_items(tmp_path: Path, chunk_bytes: int) -> None:
    path = write_log(tmp_path / "a.mcap", images(12), chunk_bytes=chunk_bytes)
    items, end = told(path, ahead=True)
    assert end == "whole"
    assert (items, end) == told(path, ahead=False)
    assert sum(isinstance(i, tuple) for i in items) == 12


def test_what_stands_before_a_fault_comes_first(tmp_path: Path) -> None:
    whole = write_log(tmp_path / "a.mcap", images(6), chunk_bytes=300).read_bytes()
    broken = tmp_path / "b.mcap"
    for at in range(8, len(whole), 37):
        data = bytearray(whole)
        data[at] ^= 4
        broken.write_bytes(data)
        assert told(broken, ahead=True) == told(broken, ahead=False), at


def test_no_thread_stays_behind(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", images(12), chunk_bytes=200)
    before = threading.active_count()
    items = ScanLog(path).items(ahead=True)
    for _ in range(12):
        next(items)
    assert threading.active_count() > before
    items.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before
