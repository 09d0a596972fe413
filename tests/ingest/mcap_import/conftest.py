"""An empty archive."""

from __future__ import annotations

from pathlib import Path

import pytest

from turnscan.store import Archive


@pytest.fixture
def lab(tmp_path: Path) -> Archive:
    return Archive.init(tmp_path / "lab")
