"""Archives are made, found, and refused when they cannot be what they should."""

from __future__ import annotations

from pathlib import Path

import pytest

from turnscan.schemas.errors import (
    ConflictError,
    FormatVersionError,
    NotFoundError,
    StorageError,
)
from turnscan.store import Archive


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


def test_storage_errors_name_the_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises((StorageError, ConflictError)):
        Archive.init(tmp_path / "file" / "lab")
