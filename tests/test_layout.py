"""The tree is what pyproject.toml says: every package listed and typed, nothing imported bare."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("cli", "ingest", "process", "schemas", "store")


def project() -> dict[str, dict[str, object]]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_is_listed() -> None:
    found = {"turnscan"}
    for room in ROOMS:
        for init in (ROOT / room).rglob("__init__.py"):
            parts = init.parent.relative_to(ROOT).parts
            found.add(".".join(("turnscan", *parts)))
    tool = project()["tool"]
    assert set(tool["setuptools"]["packages"]) == found  # type: ignore[index]


def test_rooms_are_typed() -> None:
    for room in ROOMS:
        assert (ROOT / room / "py.typed").exists()


def test_importing_turnscan_loads_nothing_heavy() -> None:
    code = (
        "import sys, turnscan; heavy = {'numpy', 'polars', 'cv2', 'pyarrow'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys, turnscan.cli.main;"
        "heavy = {'numpy', 'polars', 'cv2', 'pyarrow', 'google.protobuf'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")


def test_locks_hold_hashes_and_no_addresses() -> None:
    for lock in (ROOT / "requirements").glob("*.lock"):
        text = lock.read_text()
        assert "://" not in text
        pins = [line for line in text.splitlines() if "==" in line]
        assert pins
        assert text.count("--hash=sha256:") >= len(pins)
