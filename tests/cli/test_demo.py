"""The demo: one command, no data, and numbers that keep what the paper promises."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from console import Console, Inside

from turnscan.cli.demo import RANGES_MM


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Console, list[dict[str, object]]]:
    """A folder in which the demo has run, and the rows that it wrote."""
    run = Console(tmp_path_factory.mktemp("demo"))
    return run, run.json("demo", "room")


def test_errors_stay_within_the_papers_table(
    demonstrated: tuple[Console, list[dict[str, object]]],
) -> None:
    _, rows = demonstrated
    assert [r["recipe"] for r in rows] == ["default"] * 4 + ["paper"] * 4
    for row, (low, high, paper_mm) in zip(rows, RANGES_MM * 2, strict=True):
        assert row["range_m"] == f"{low / 1000:g}-{high / 1000:g}"
        assert row["paper_mm"] == paper_mm
        assert int(str(row["points"])) > 1000
        assert float(str(row["rms_mm"])) < 0.5 * paper_mm, row
        assert abs(float(str(row["bias_mm"]))) < 0.1 * paper_mm, row
        assert float(str(row["gross_percent"])) < 0.5, row


def test_it_leaves_a_cloud_a_picture_and_an_archive(
    demonstrated: tuple[Console, list[dict[str, object]]],
) -> None:
    run, rows = demonstrated
    room = run.cwd / "room"
    points = sum(int(str(r["points"])) for r in rows if r["recipe"] == "default")
    head = (room / "room.ply").read_bytes()[:4000]
    (vertices,) = [line for line in head.split(b"\n") if line.startswith(b"element vertex ")]
    # All but the few points that lie nearer or farther than the paper's ranges.
    assert points <= int(vertices.split()[2]) < 1.05 * points
    picture = (room / "room.png").read_bytes()
    assert struct.unpack(">II", picture[16:24]) == (1400, 720)
    lab = Inside(run.cwd, room / "archive")
    assert lab.json("status", "--check") == []
    assert {d["recipe"] for d in lab.json("scan", "show", "demo")["derivations"]} == {
        "default",
        "paper",
    }


def test_only_a_folder_of_its_own_is_replaced(
    demonstrated: tuple[Console, list[dict[str, object]]], tmp_path: Path
) -> None:
    run, _ = demonstrated
    before = (run.cwd / "room" / "room.ply").stat()
    inside = Inside(run.cwd)
    assert "--overwrite replaces it" in inside.fails("demo", "room")
    assert (run.cwd / "room" / "room.ply").stat() == before
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("three years of work")
    for words in (("demo", mine), ("demo", mine, "--overwrite")):
        assert "is not empty" in inside.fails(*words)
    assert (mine / "thesis.txt").read_text() == "three years of work"
    assert "thesis.txt" in inside.fails("demo", mine / "thesis.txt")


def test_overwrite_replaces_an_earlier_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from turnscan.cli.demo import make_folder

    folder = tmp_path / "room"
    make_folder(folder, overwrite=False)
    (folder / "archive").mkdir()
    (folder / "archive" / "old.txt").write_text("old")
    make_folder(folder, overwrite=True)
    assert [p.name for p in folder.iterdir()] == ["turnscan-demo.txt"]
