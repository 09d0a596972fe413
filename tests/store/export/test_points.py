"""Point formats, read back by readers that share nothing with the writers."""

from __future__ import annotations

import csv
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pye57
import pytest
import trimesh

from turnscan.schemas.tables import POINTS
from turnscan.store.export import export_points

from .clouds import POINT_FORMATS, SCANS, batch, cloud, column, info, read_pcd, read_ply, xyz_mm


@pytest.fixture
def two() -> list[pa.RecordBatch]:
    """Two scans, the first in two batches."""
    first = cloud(1000)
    return [first.slice(0, 300), first.slice(300), cloud(720, scan=1)]


NAMES = {"x_mm": "x", "y_mm": "y", "z_mm": "z"}


def check_packed(found: np.ndarray, batches: list[pa.RecordBatch]) -> None:
    names = found.dtype.names
    assert names is not None
    assert names[:3] == ("x", "y", "z")
    assert set(names) == {NAMES.get(c.name, c.name) for c in POINTS.columns} | {"scan_index"}
    for name in (*(c.name for c in POINTS.columns), "scan_index"):
        there = found[NAMES.get(name, name)]
        assert there.dtype == column(batches, name).dtype, name
        np.testing.assert_array_equal(there, column(batches, name), err_msg=name)


def test_ply_keeps_every_bit(tmp_path: Path, two: list[pa.RecordBatch]) -> None:
    out = tmp_path / "cloud.ply"
    export_points(two, out, info(two))
    found, comments = read_ply(out)
    check_packed(found, two)
    text = "\n".join(comments)
    assert [c for c in comments if c.startswith("scan ")] == [f"scan {s}" for s in SCANS]
    for words in (
        "recipe default (r-0123456789ab)",
        "calibration c-1",
        "key " + "a" * 64,
        "x [mm]: scene x",
    ):
        assert words in text
    assert "angle_rad [rad]" in text


def test_ply_opens_in_trimesh(tmp_path: Path, two: list[pa.RecordBatch]) -> None:
    out = tmp_path / "cloud.ply"
    export_points(two, out, info(two))
    found = trimesh.load(out)
    assert isinstance(found, trimesh.PointCloud)
    np.testing.assert_array_equal(found.vertices, xyz_mm(two))


def test_pcd_keeps_every_bit(tmp_path: Path, two: list[pa.RecordBatch]) -> None:
    out = tmp_path / "cloud.pcd"
    export_points(two, out, info(two))
    found, comments = read_pcd(out)
    check_packed(found, two)
    assert "lengths in mm" in comments
    assert f"scan {SCANS[1]}" in comments


def test_csv_reads_back_to_the_same_floats(tmp_path: Path, two: list[pa.RecordBatch]) -> None:
    out = tmp_path / "cloud.csv"
    export_points(two, out, info(two))
    with out.open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["scan", *(c.name for c in POINTS.columns), "recipe", "calibration", "key"]
    assert {(r[0], *r[-3:]) for r in rows} == {
        (SCANS[0], "default (r-0123456789ab)", "c-1", "k-" + "a" * 12),
        (SCANS[1], "default (r-0123456789ab)", "c-2", "k-" + "b" * 12),
    }
    assert [r[0] for r in rows] == [SCANS[i] for i in column(two, "scan_index")]
    for at, c in enumerate(POINTS.columns, start=1):
        kind = np.dtype(c.type)
        there = np.array([r[at] for r in rows]).astype(np.float64).astype(kind)
        np.testing.assert_array_equal(there, column(two, c.name), err_msg=c.name)


def test_parquet_keeps_values_units_and_origin(tmp_path: Path, two: list[pa.RecordBatch]) -> None:
    out = tmp_path / "cloud.parquet"
    export_points(two, out, info(two))
    table = pq.read_table(out)
    assert table.column("scan").to_pylist() == [SCANS[i] for i in column(two, "scan_index")]
    for c in POINTS.columns:
        np.testing.assert_array_equal(table.column(c.name).to_numpy(), column(two, c.name))
        about = table.schema.field(c.name).metadata
        assert about == {b"unit": c.unit.encode(), b"description": c.description.encode()}
    assert SCANS[0] in table.schema.metadata[b"turnscan.export"].decode()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_in_metres_with_all_attributes(
    tmp_path: Path, two: list[pa.RecordBatch], suffix: str
) -> None:
    out = tmp_path / f"cloud{suffix}"
    export_points(two, out, info(two))
    found = laspy.read(out)
    assert (str(found.header.version), found.header.point_format.id) == ("1.4", 6)
    assert found.header.are_points_compressed == (suffix == ".laz")
    assert found.header.global_encoding.wkt
    metres = np.stack([found.x, found.y, found.z], axis=1)
    np.testing.assert_allclose(metres, xyz_mm(two) / 1000, atol=0.5001e-6, rtol=0)
    np.testing.assert_allclose(found.header.maxs, metres.max(axis=0), atol=1e-9)
    np.testing.assert_allclose(found.header.mins, metres.min(axis=0), atol=1e-9)
    np.testing.assert_array_equal(found.point_source_id, column(two, "scan_index"))
    np.testing.assert_array_equal(found.intensity, np.rint(column(two, "amplitude_dn")))
    assert set(found.return_number) == set(found.number_of_returns) == {1}
    for c in POINTS.columns:
        if c.name not in NAMES:
            np.testing.assert_array_equal(found[c.name], column(two, c.name), err_msg=c.name)
    (text,) = [v for v in found.header.vlrs if (v.user_id, v.record_id) == ("LASF_Spec", 3)]
    assert f"scan {SCANS[1]}" in text.record_data.decode()


def test_las_says_what_it_cannot_reach(tmp_path: Path) -> None:
    from turnscan.schemas.errors import InputError

    far = [batch({"x_mm": [0, -3e6], "y_mm": [0, 0], "z_mm": [0, 0]})]
    with pytest.raises(InputError, match=r"3000 m .* along x; LAS .* reaches 2147 m"):
        export_points(far, tmp_path / "far.las", info(far))
    assert list(tmp_path.iterdir()) == []


def test_e57_holds_a_scan_each_in_metres(tmp_path: Path, two: list[pa.RecordBatch]) -> None:
    out = tmp_path / "cloud.e57"
    export_points(two, out, info(two))
    file = pye57.E57(str(out))
    assert file.scan_count == 2
    for number, own in enumerate((two[:2], two[2:])):
        assert file.get_header(number)["name"].value() == SCANS[number]
        found = file.read_scan_raw(number)
        there = np.stack([found[f"cartesian{a}"] for a in "XYZ"], axis=1)
        np.testing.assert_allclose(there, xyz_mm(own) / 1000, rtol=1e-7, atol=1e-10)
        np.testing.assert_array_equal(found["intensity"], column(own, "amplitude_dn"))
        np.testing.assert_array_equal(found["rowIndex"], column(own, "row"))
        np.testing.assert_array_equal(found["columnIndex"], column(own, "frame"))
    file.close()


def test_e57_takes_scans_that_share_a_batch_and_long_sweeps(tmp_path: Path) -> None:
    first, second = cloud(10), cloud(10, scan=1)
    mixed = pa.Table.from_batches([first, second]).combine_chunks().to_batches()
    out = tmp_path / "mixed.e57"
    export_points(mixed, out, info(mixed))
    file = pye57.E57(str(out))
    assert [file.get_header(i).point_count for i in range(file.scan_count)] == [10, 10]
    file.close()
    long = [batch({"frame": [0, 70000], "x_mm": [1, 2], "y_mm": [1, 2], "z_mm": [1, 2]})]
    out = tmp_path / "long.e57"
    export_points(long, out, info(long))
    file = pye57.E57(str(out))
    found = file.read_scan_raw(0)
    assert "columnIndex" not in found, "a frame number is left out rather than cut to 16 bits"
    np.testing.assert_allclose(found["cartesianX"], [0.001, 0.002], rtol=1e-7)
    file.close()


def count(path: Path) -> int:
    if path.suffix == ".ply":
        return len(read_ply(path)[0])
    if path.suffix == ".pcd":
        return len(read_pcd(path)[0])
    if path.suffix == ".csv":
        return len(path.read_text().splitlines()) - 1
    if path.suffix == ".parquet":
        return pq.read_table(path).num_rows
    if path.suffix == ".e57":
        file = pye57.E57(str(path))
        rows = sum(file.get_header(i).point_count for i in range(file.scan_count))
        file.close()
        return rows
    return len(laspy.read(path).points)


@pytest.mark.parametrize("suffix", POINT_FORMATS)
@pytest.mark.parametrize("rows", ["no batches", "an empty batch", "one point"])
def test_small_tables_are_whole_files(tmp_path: Path, suffix: str, rows: str) -> None:
    batches = {"no batches": [], "an empty batch": [cloud(0)], "one point": [cloud(1)]}[rows]
    out = tmp_path / f"small{suffix}"
    export_points(batches, out, info(batches))
    assert count(out) == sum(b.num_rows for b in batches)
