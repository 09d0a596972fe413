"""SQL over a small archive: every table, its types, and every way to be told what went wrong."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.process.pipeline import derive
from turnscan.schemas.archive_events import Referenced
from turnscan.schemas.errors import DamageError, UsageError
from turnscan.schemas.recipe import BUILT_IN
from turnscan.schemas.tables import TABLES as TABLE_SPECS
from turnscan.store import Archive
from turnscan.store.query import TABLES, run_query

from ..archive.scans import calibration, write_images


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans, two recipes, two calibrations, a reference."""
    folder = tmp_path_factory.mktemp("query")
    (folder / "images").mkdir()
    images = sorted(write_images(folder / "images", 4).glob("*.png"))
    archive = Archive.init(folder / "lab")
    for label, step in (("first", 10.0), ("second", 12.0)):
        poses = poses_by_step(images, step_deg=step)
        import_images(archive, ImportPlan(poses, rig="r1", label=label, calibration=calibration()))
    for recipe in ("default", "paper"):
        assert {o.error for o in derive(archive, archive.scans(), BUILT_IN[recipe])} == {None}
    archive.add_calibration(calibration(h=160.0))
    archive.tag("first", {"room": "it's 12"})
    archive.retire("second")
    archive.record_event(
        Referenced, scan=archive.scan("first").scan, value={"kind": "disc", "diameter_mm": 210.8}
    )
    return archive.root


@pytest.fixture(scope="module")
def lab(template: Path) -> Archive:
    """Read only."""
    return Archive.open(template)


@pytest.fixture
def copy(template: Path, tmp_path: Path) -> Archive:
    shutil.copytree(template, tmp_path / "lab")
    return Archive.open(tmp_path / "lab")


def rows(archive: Archive, sql: str) -> list[dict[str, Any]]:
    return run_query(archive, sql).to_dicts()


# -- tables ---------------------------------------------------------------------------------------


def test_scans(lab: Archive) -> None:
    first, second = rows(lab, "SELECT * FROM scans ORDER BY label")
    assert first["scan"] == lab.scan("first").scan
    assert (first["label"], first["retired"], second["retired"]) == ("first", False, True)
    assert json.loads(first["tags"]) == {"room": "it's 12"}
    assert (first["frames"], first["width_px"], first["height_px"]) == (4, 64, 48)
    assert first["angle_max_rad"] == pytest.approx(np.deg2rad(30))
    assert first["calibration"] == calibration().calibration_id()


def test_calibrations(lab: Archive) -> None:
    found = rows(lab, "SELECT calibration, rig, document FROM calibrations")
    ids = sorted(c.calibration_id() for c in (calibration(), calibration(h=160.0)))
    assert [r["calibration"] for r in found] == ids
    assert {json.loads(r["document"])["rig"] for r in found} == {"r1"}


def test_events_and_references(lab: Archive) -> None:
    kinds = [r["kind"] for r in rows(lab, "SELECT kind FROM events")]
    assert kinds == ["tagged", "retired", "referenced"]
    (found,) = rows(lab, "SELECT * FROM references")
    assert found["scan"] == lab.scan("first").scan
    assert json.loads(found["value"]) == {"kind": "disc", "diameter_mm": 210.8}
    (event,) = rows(lab, "SELECT * FROM events WHERE kind = 'referenced'")
    assert (event["event"], event["t_ns"]) == (found["event"], found["t_ns"])


def test_derivations(lab: Archive) -> None:
    found = {r["key"]: r for r in rows(lab, "SELECT * FROM derivations")}
    assert found.keys() == {m.key for m in lab.derivations()}
    assert len(found) == 8
    for m in lab.derivations():
        row = found[m.key]
        assert (row["kind"], row["rows"], row["bytes"]) == (m.kind, m.rows, m.bytes)
        assert pq.read_metadata(lab.root / row["path"]).num_rows == row["rows"]


@pytest.mark.parametrize("kind", ["stripes", "points"])
def test_derived_rows_come_whole_with_their_origin(lab: Archive, kind: str) -> None:
    found = run_query(lab, f"SELECT * FROM {kind}")
    origin = ["scan", "recipe", "recipe_name", "calibration", "key"]
    assert found.columns == [*origin, *(c.name for c in TABLE_SPECS[kind].columns)]
    made = [m for m in lab.derivations() if m.kind == kind]
    assert found.height == sum(m.rows for m in made) > 0
    for m in made:
        own = found.filter(pl.col("key") == m.key)
        assert own.select(origin).unique().rows() == [
            (m.scan, m.recipe, m.recipe_document["name"], m.calibration, m.key)
        ]
        stored = pq.read_table(lab.root / m.path, partitioning=None)
        for c in TABLE_SPECS[kind].columns:
            np.testing.assert_array_equal(own[c.name].to_numpy(), stored.column(c.name).to_numpy())


def test_joins_and_aggregates(lab: Archive) -> None:
    found = rows(
        lab,
        """
        -- one line a recipe
        WITH mine AS (SELECT key, frame, range_mm FROM points WHERE flags & 4 = 0)
        SELECT s.label, d.recipe_name, count(*) AS n, avg(m.range_mm) AS mean, max(m.frame) AS last
        FROM mine m JOIN derivations d ON d.key = m.key JOIN scans s ON s.scan = d.scan
        GROUP BY s.label, d.recipe_name ORDER BY s.label, d.recipe_name
        """,
    )
    assert [(r["label"], r["recipe_name"]) for r in found] == [
        (label, recipe) for label in ("first", "second") for recipe in ("default", "paper")
    ]
    for r in found:
        (made,) = (
            m
            for m in lab.derivations(lab.scan(r["label"]).scan)
            if m.kind == "points" and m.recipe_document["name"] == r["recipe_name"]
        )
        stored = pq.read_table(lab.root / made.path, partitioning=None)
        strong = (stored.column("flags").to_numpy() & 4) == 0
        ranges = stored.column("range_mm").to_numpy()[strong].astype(np.float64)
        assert (r["n"], r["last"]) == (strong.sum(), stored.column("frame").to_numpy()[strong].max())
        assert r["mean"] == pytest.approx(ranges.mean(), rel=1e-5)


def test_whole_numbers_do_not_wrap_around(lab: Archive) -> None:
    """Files hold narrow unsigned numbers, whose arithmetic in polars would."""
    (found,) = rows(
        lab,
        "SELECT min(frame - 10) AS a, max(laser * 300 + 300) AS b, min(row - 1000) AS c, "
        "min(flags - 9) AS d FROM points",
    )
    assert found["a"] == -10
    assert found["b"] == 300
    assert -1000 <= found["c"] < -900
    assert found["d"] == -9


def test_show_lists_every_table(lab: Archive) -> None:
    assert sorted(r["name"] for r in rows(lab, "SHOW TABLES")) == sorted(TABLES)
    assert sorted(r["name"] for r in rows(lab, " show tables")) == sorted(TABLES)


def test_explain_and_brackets_are_taken(lab: Archive) -> None:
    (plan,) = run_query(lab, "EXPLAIN SELECT frame FROM points WHERE frame = 3").to_dicts()[:1]
    assert "Logical Plan" in plan
    assert rows(lab, "(SELECT label FROM scans) UNION ALL (SELECT rig FROM calibrations)")
    assert rows(lab, "/* DROP */ SELECT 1 AS one") == [{"one": 1}]


@pytest.mark.parametrize("name", TABLES)
def test_an_empty_archive_has_empty_tables_of_the_same_types(
    tmp_path: Path, lab: Archive, name: str
) -> None:
    empty = run_query(Archive.init(tmp_path / "lab"), f"SELECT * FROM {name}")
    assert empty.height == 0
    assert empty.schema == run_query(lab, f"SELECT * FROM {name}").schema


def test_aggregates_of_nothing(tmp_path: Path) -> None:
    archive = Archive.init(tmp_path / "lab")
    assert rows(archive, "SELECT count(*) AS n, max(z_mm) AS z FROM points") == [{"n": 0, "z": None}]


# -- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sql",
    [
        "CREATE TABLE t AS SELECT * FROM scans",
        "DROP TABLE scans",
        "UPDATE scans SET label = 'x'",
        "DELETE FROM scans",
        "INSERT INTO scans SELECT * FROM scans",
        "TRUNCATE TABLE scans",
        "-- SELECT\nDROP TABLE scans",
        "/* SELECT */ DROP TABLE scans",
        "selection",
        "",
    ],
)
def test_only_reading_is_taken(lab: Archive, sql: str) -> None:
    with pytest.raises(UsageError, match="only SELECT, WITH, SHOW and EXPLAIN are taken") as caught:
        run_query(lab, sql)
    assert caught.value.hint == "nothing in an archive is edited"


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT",
        "SELECT * FROM nothing",
        "SELECT nope FROM points",
        "SELECT frame FROM points WHERE",
        "SELECT frame + FROM points",
        "SELECT no_such_function(frame) FROM points",
        "SELECT frame, count(*) FROM points",
        "SELECT 1; DROP TABLE scans",
        "WITH a AS (SELECT 1) DELETE FROM scans",
        "SELECT 'open FROM scans",
        "SELECT x_mm + scan FROM points",
        "SELECT CAST('x' AS INT) FROM scans",
        "SELECT * FROM read_csv('/nonexistent/file.csv')",
        "SELECT s.* FROM scans s JOIN points p ON s.scan = p.frame",
    ],
)
def test_errors_of_sql_are_usage_errors_with_a_hint(lab: Archive, sql: str) -> None:
    with pytest.raises(UsageError, match=r"^the query failed: .") as caught:
        run_query(lab, sql)
    assert "\n" not in caught.value.message
    assert caught.value.hint is not None
    assert "scans, calibrations, events, references, derivations, stripes, points" in caught.value.hint


# -- damage ---------------------------------------------------------------------------------------


def points_file(archive: Archive) -> Path:
    return archive.root / next(m for m in archive.derivations() if m.kind == "points").path


def test_a_truncated_or_missing_table_is_named(copy: Archive) -> None:
    path = points_file(copy)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(DamageError, match=path.name) as caught:
        run_query(copy, "SELECT count(*) FROM points")
    assert "its manifest says" in caught.value.message
    assert "turnscan repair" in (caught.value.hint or "")
    path.unlink()
    with pytest.raises(DamageError, match=f"{path.name}.* is missing"):
        run_query(copy, "SELECT count(*) FROM points")
    assert run_query(copy, "SELECT count(*) AS n FROM stripes")["n"][0] > 0


@pytest.mark.parametrize("part", ["foot", "head of the foot", "pages"])
def test_a_table_of_the_right_size_that_cannot_be_read_is_named(copy: Archive, part: str) -> None:
    path = points_file(copy)
    data = bytearray(path.read_bytes())
    foot = int.from_bytes(data[-8:-4], "little")
    places = {
        "foot": slice(-8, -4),
        "head of the foot": slice(-8 - foot, -8 - foot + 64),
        "pages": slice(4, len(data) // 2),
    }
    data[places[part]] = bytes(len(data[places[part]]))
    path.write_bytes(data)
    with pytest.raises(DamageError, match=path.name) as caught:
        run_query(copy, "SELECT * FROM points")
    assert "damaged table" in caught.value.message


def test_flipped_bytes_never_look_like_wrong_sql(copy: Archive) -> None:
    """Page checksums are for verify; but what polars stumbles over is reported as what it is."""
    path = points_file(copy)
    good = path.read_bytes()
    foot = len(good) - 8 - int.from_bytes(good[-8:-4], "little")
    reported = 0
    for at in [*range(4, foot, 211), *range(foot, len(good), 31)]:
        bad = bytearray(good)
        bad[at] ^= 0x55
        path.write_bytes(bad)
        try:
            run_query(copy, "SELECT * FROM points")
        except DamageError as error:
            assert path.name in error.message
            reported += 1
    assert reported > 30


def test_damage_is_no_excuse_for_wrong_sql(copy: Archive) -> None:
    path = points_file(copy)
    path.unlink()
    with pytest.raises(UsageError, match="nope"):
        run_query(copy, "SELECT nope FROM scans")


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT label FROM scans WHERE label <> 'points'",
        "SELECT label FROM scans WHERE label <> 'it''s points'",
        "SELECT label FROM scans -- not the points",
        "SELECT label /* points and stripes */ FROM scans",
        "SELECT 'points' AS what, 'DROP TABLE scans' AS why FROM scans",
    ],
)
def test_names_in_literals_and_comments_open_nothing(copy: Archive, sql: str) -> None:
    shutil.rmtree(copy.root / "derived" / "points")
    assert run_query(copy, sql).height == 2


def test_a_query_touches_nothing(copy: Archive) -> None:
    def state() -> dict[Path, tuple[int, int]]:
        return {
            p: (p.stat().st_mtime_ns, p.stat().st_size) for p in copy.root.rglob("*") if p.is_file()
        }

    before = state()
    for name in TABLES:
        run_query(Archive.open(copy.root), f"SELECT * FROM {name}")
    assert state() == before
