"""The whole walk on the real turntable scan: photographs and a calibration in, a measured table out."""

from __future__ import annotations

import shutil
from pathlib import Path

import polars as pl
import pytest
from console import Console, Inside, every_file, write_json
from real import SRV, check_srv, measure

IMPORT = ("--rig", "srv", "--label", "figure", "--tag", "object=figure")


@pytest.fixture(scope="module")
def walk(test_data: Path, srv_files: Path, tmp_path_factory: pytest.TempPathFactory) -> Console:
    """An archive with the real scan, imported and processed by the commands of the README."""
    run = Console(tmp_path_factory.mktemp("walk"))
    assert "made archive" in run("init", "lab").stderr
    run.archive = run.cwd / "lab"
    sealed = run.json(
        *("import", "images", test_data / "srv_turntable" / "scan"),
        *("--angles", srv_files / "angles.csv", "--calibration", srv_files / "cal.json", *IMPORT),
    )
    assert sealed["frames"] == 80
    assert sealed["calibration"] == SRV.calibration_id()
    (did,) = run.json("process")
    assert did["did"] == "derived stripes and points"
    assert did["why"] == "never derived"
    assert (did["scan"], did["frames"]) == (sealed["scan"], 80)
    assert did["points"] > 30_000
    return run


@pytest.fixture
def copied(walk: Console, tmp_path: Path) -> Console:
    """A copy of the archive, to be changed."""
    assert walk.archive is not None
    shutil.copytree(walk.archive, tmp_path / "lab")
    return Console(tmp_path, tmp_path / "lab")


def check_table(table: pl.DataFrame) -> None:
    columns = (table[n].to_numpy().astype(float) for n in ("x_mm", "y_mm", "z_mm"))
    check_srv(measure(*columns, table["frame"].to_numpy()))


def test_the_table_measures_what_the_data_set_measured(walk: Console, tmp_path: Path) -> None:
    out = tmp_path / "figure.parquet"
    done = walk("export", "figure", out)
    table = pl.read_parquet(out)
    assert f"wrote {len(table)} points" in done.stderr
    check_table(table)


def test_second_process_does_nothing_and_touches_no_file(walk: Console) -> None:
    assert walk.archive is not None
    before = every_file(walk.archive)
    done = walk("process")
    assert done.stdout == ""
    assert done.stderr == "nothing to do: 1 scan up to date\n"
    assert every_file(walk.archive) == before


def test_query_export_status_and_scan_say_the_same(walk: Console, tmp_path: Path) -> None:
    (row,) = walk.json("query", "SELECT count(*) AS n, count(DISTINCT frame) AS f FROM points")
    walk("export", "latest", tmp_path / "figure.ply")
    head = (tmp_path / "figure.ply").read_bytes()[:4000]
    assert f"element vertex {row['n']}\n".encode() in head
    assert row["f"] == 80
    assert walk.json("status", "--check") == []
    (listed,) = walk.json("scan", "list", "--where", "rig = 'srv'")
    assert listed["label"] == "figure"
    assert listed["tags"] == {"object": "figure"}
    assert listed["size_px"] == "640x480"
    shown = walk.json("scan", "show", "figure")
    assert shown["scan"] == listed["scan"]
    tables = {d["table"]: d["rows"] for d in shown["derivations"]}
    assert tables["points"] == row["n"]
    assert tables["stripes"] >= row["n"]


def test_a_moved_laser_plane_redoes_the_points_alone(copied: Console) -> None:
    assert copied.archive is not None
    inside = Inside(copied.cwd, copied.archive)
    stripes = every_file(copied.archive / "derived" / "stripes")
    assert len(stripes) == 2
    lasers = [{"laser": 0, "normal": SRV.lasers[0].normal, "distance_mm": 166.3}]
    moved = write_json(copied.cwd / "moved.json", {**SRV.plain(), "lasers": lasers})
    added = copied("calibration", "add", moved, "--certify").stdout.strip()
    assert added.startswith("c-")
    assert added != SRV.calibration_id()

    (stale,) = copied.json("status")
    assert stale["table"] == "points"
    assert stale["why"] == f"calibration changed: plane/0 ({SRV.calibration_id()} to {added})"
    assert inside.run("status", "--check").returncode == 1
    planned = inside("process", "--dry-run")
    assert "would derive 1 of 2 tables" in planned.stderr
    assert "calibration changed: plane/0" in planned.stdout
    assert every_file(copied.archive / "derived" / "stripes") == stripes
    # The plan was no deed, and the old points are found where they are asked for.
    (old,) = inside.json("process", "--calibration", "recorded")
    assert old["did"] == "nothing"

    (did,) = copied.json("process")
    assert did["did"] == "derived points"
    assert did["why"] == stale["why"]
    assert every_file(copied.archive / "derived" / "stripes") == stripes
    rows = inside.json("query", "SELECT calibration, count(*) AS n FROM points GROUP BY calibration")
    assert {r["calibration"] for r in rows} == {added, SRV.calibration_id()}
    # 0.26 mm of plane distance is seen in the cloud; the recorded one still measures right.
    inside("export", "latest", "new.parquet")
    inside("export", "latest", "old.parquet", "--calibration", "recorded")
    new, old_table = (pl.read_parquet(copied.cwd / f"{n}.parquet") for n in ("new", "old"))
    check_table(old_table)
    shift = abs(float(new["range_mm"].mean()) - float(old_table["range_mm"].mean()))  # type: ignore[arg-type]
    assert 0.1 < shift < 5


def test_a_calibration_that_comes_later(test_data: Path, srv_files: Path, tmp_path: Path) -> None:
    run = Inside(tmp_path)
    run("init", "lab")
    run.archive = tmp_path / "lab"
    photos = sorted((test_data / "srv_turntable" / "scan").glob("step_num1??.jpg"))[:4]
    run("import", "images", *photos, "--step-deg", "4.5", "--rig", "bench")
    said = Console(tmp_path, run.archive).fails("process")
    assert "no calibration" in said
    assert "calibration" in said.split("hint: ")[1]
    assert not list((run.archive / "derived").rglob("*.parquet"))
    run("calibration", "add", srv_files / "cal.json", "--certify", "--rig", "bench")
    (did,) = run.json("process")
    assert did["did"] == "derived stripes and points"
    (listed,) = run.json("calibration", "list")
    assert listed["certified"].startswith("bench ")


def test_a_picture_and_a_mesh_of_the_scan(walk: Console, tmp_path: Path) -> None:
    import cv2
    import trimesh

    walk("export", "latest", tmp_path / "figure.png")
    picture = cv2.imread(str(tmp_path / "figure.png"))
    assert picture is not None
    assert (picture < 250).mean() > 0.01
    assert "exists already" in walk.fails("export", "latest", tmp_path / "figure.png")
    walk("export", "latest", tmp_path / "figure.stl")
    mesh = trimesh.load(tmp_path / "figure.stl")
    # The disc faces the camera, so its triangles look up.
    flat = (abs(mesh.triangles_center[:, 2]) < 2) & (abs(mesh.triangles_center[:, :2]) < 90).all(axis=1)
    assert flat.sum() > 500
    # Triangles of neighbouring rows are as small as the noise of their corners: some lean over.
    assert (mesh.face_normals[flat, 2] > 0).mean() > 0.9


def test_stale_picks_what_is_to_be_derived(copied: Console) -> None:
    assert copied("process", "--stale").stderr == "no scan to process\n"
    (did,) = copied.json("process", "--stale", "--recipe", "paper")
    assert did["did"] == "derived stripes and points"
