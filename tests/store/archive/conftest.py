"""One processed archive, copied for each test of this folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive

from .scans import import_scan, write_images


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("images"), 4)


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory, source: Path) -> Path:
    """An archive with one processed scan, to be copied by tests."""
    archive = Archive.init(tmp_path_factory.mktemp("archive") / "lab")
    import_scan(archive, source)
    assert [o.error for o in derive(archive, archive.scans(), BUILT_IN["default"])] == [None]
    return archive.root


@pytest.fixture
def lab(tmp_path: Path, template: Path) -> Archive:
    shutil.copytree(template, tmp_path / "lab")
    return Archive.open(tmp_path / "lab")
