"""What all tests share: where the real data is, and quiet, private surroundings."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real photographs and logs (TURNSCAN_TEST_DATA, default ../shared/data)."""
    named = os.environ.get("TURNSCAN_TEST_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        if named or os.environ.get("CI"):
            pytest.fail(f"no test data at {folder}: set TURNSCAN_TEST_DATA to the folder")
        pytest.skip(f"real data not found at {folder} (set TURNSCAN_TEST_DATA)")
    return folder


@pytest.fixture(autouse=True)
def _private_surroundings(monkeypatch: pytest.MonkeyPatch) -> None:
    """No archive of the developer's is found through the environment."""
    monkeypatch.delenv("TURNSCAN_ARCHIVE", raising=False)
