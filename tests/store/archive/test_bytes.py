"""The narrow way to the bytes: put-if-absent is atomic, never replaces, and cleans up after itself."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from turnscan.schemas.errors import DamageError, StorageError
from turnscan.store.bytes import LocalFolder


@pytest.fixture
def store(tmp_path: Path) -> LocalFolder:
    return LocalFolder(tmp_path)


def test_what_is_put_stays(store: LocalFolder) -> None:
    assert store.put_if_absent("a/b/c", b"one")
    assert not store.put_if_absent("a/b/c", b"two")
    assert store.get("a/b/c") == b"one"
    assert store.get_range("a/b/c", 1, 2) == b"ne"
    assert store.head("a/b/c") == 3
    assert store.head("a/b") is not None
    assert store.list("a/b") == ["c"]
    assert store.list("none") == []
    assert os.listdir(store.root / "staging") == []
    store.delete("a/b/c")
    store.delete("a/b/c")
    assert store.head("a/b/c") is None
    with pytest.raises(DamageError, match="the file is missing"):
        store.get("a/b/c")


def test_staged_files_vanish_when_something_fails(store: LocalFolder) -> None:
    with pytest.raises(RuntimeError, match="stop"), store.staged() as path:
        path.write_bytes(b"x")
        raise RuntimeError("stop")
    assert os.listdir(store.root / "staging") == []


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.ENOSPC, "the disk is full"), (errno.EACCES, "Permission denied"), (errno.EIO, "error")],
)
def test_what_the_file_system_refuses_is_said(store: LocalFolder, number: int, message: str) -> None:
    with pytest.raises(StorageError, match=message), store.staged():
        raise OSError(number, os.strerror(number))


def test_without_hard_links_a_rename_serves(
    store: LocalFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    assert store.put_if_absent("a", b"one")
    assert not store.put_if_absent("a", b"two")
    assert store.get("a") == b"one"
    assert os.listdir(store.root / "staging") == []


RACE = """
import sys
from pathlib import Path
from turnscan.store.bytes import LocalFolder
store = LocalFolder(Path(sys.argv[1]))
sys.stdin.readline()
print(sum(store.put_if_absent(f"f/{i}", f"{sys.argv[2]} {i}".encode() * 1000) for i in range(200)))
"""


def test_of_two_writers_one_wins_each_time(store: LocalFolder) -> None:
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", RACE, str(store.root), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for name in "ab"
    ]
    for p in pair:
        assert p.stdin is not None
        p.stdin.write("go\n")
        p.stdin.flush()
    wins = [int(p.communicate(timeout=60)[0]) for p in pair]
    assert sum(wins) == 200
    for i in range(200):
        assert store.get(f"f/{i}") in (f"a {i}".encode() * 1000, f"b {i}".encode() * 1000)
