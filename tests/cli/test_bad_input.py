"""What users get wrong and what disks do: one error that names it, a way out, nothing half-made."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from console import Console, Inside, every_file, write_json


@pytest.fixture
def lab(tiny_lab: Path, tmp_path: Path) -> Inside:
    """A copy of the tiny archive, to be spoilt."""
    shutil.copytree(tiny_lab, tmp_path / "lab")
    return Inside(tmp_path, tmp_path / "lab")


@pytest.fixture
def photos(tiny_files: Path, tmp_path: Path) -> Path:
    """A copy of the tiny scan's images, to be spoilt."""
    shutil.copytree(tiny_files / "photos", tmp_path / "photos")
    return tmp_path / "photos"


def archive_of(console: Console) -> Path:
    assert console.archive is not None
    return console.archive


def only(folder: Path, pattern: str) -> Path:
    (found,) = folder.rglob(pattern)
    return found


# -- import -----------------------------------------------------------------------------------------


def cut_short(photos: Path) -> str:
    path = photos / "img1.png"
    path.write_bytes(path.read_bytes()[:-40])
    return "cut off"


def no_image(photos: Path) -> str:
    (photos / "img1.png").write_bytes(b"this is no image")
    return "PNG"


def wrong_bytes(photos: Path) -> str:
    path = photos / "img1.png"
    data = bytearray(path.read_bytes())
    data[60:90] = bytes(30)
    path.write_bytes(data)
    return "img1.png"


def other_size(photos: Path) -> str:
    cv2.imwrite(str(photos / "img1.png"), np.zeros((48, 80), np.uint8))
    return "80 x 48"


def other_depth(photos: Path) -> str:
    cv2.imwrite(str(photos / "img1.png"), np.zeros((48, 64), np.uint16))
    return "16 bit"


@pytest.mark.parametrize("spoil", [cut_short, no_image, wrong_bytes, other_size, other_depth])
def test_a_bad_image_is_named_and_nothing_is_imported(
    lab: Inside, photos: Path, spoil: Callable[[Path], str]
) -> None:
    expected = spoil(photos)
    before = every_file(archive_of(lab) / "scans")
    said = lab.fails("import", "images", photos, "--step-deg", "5")
    assert "img1.png" in said
    assert expected in said
    assert every_file(archive_of(lab) / "scans") == before
    assert not list((archive_of(lab) / "staging").iterdir())
    assert len(lab.json("scan", "list")) == 1


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("file,angle_deg\nimg0.png,0\nimg2.png,10\n", "no row for img1.png"),
        ("file,angle_deg\nimg0.png,0\nimg1.png,x\nimg2.png,10\n", "line 3: angle_deg is 'x'"),
        ("file,angle_deg\nimg0.png,0\nimg1.png,nan\nimg2.png,10\n", "line 3: angle_deg is 'nan'"),
        ("file,angle_deg\nimg0.png,0\nimg0.png,5\nimg1.png,5\nimg2.png,9\n", "line 3: img0.png"),
        ("file,angle_deg\nimg0.png,0\nimg9.png,5\n", "line 3: no image named 'img9.png'"),
        ("name,angle\nimg0.png,0\n", "columns are ['name', 'angle']"),
        ("file,angle_deg\n", "has no rows"),
    ],
)
def test_a_bad_table_of_angles_is_named(lab: Inside, photos: Path, table: str, expected: str) -> None:
    (lab.cwd / "angles.csv").write_text(table)
    said = lab.fails("import", "images", photos, "--angles", lab.cwd / "angles.csv")
    assert "angles.csv" in said
    assert expected in said


def test_a_calibration_of_another_size_is_refused(lab: Inside, photos: Path, tiny_files: Path) -> None:
    document = json.loads((tiny_files / "cal.json").read_text())
    document["camera"] |= {"width_px": 640, "height_px": 480}
    path = write_json(lab.cwd / "big.json", document)
    said = lab.fails("import", "images", photos, "--step-deg", "5", "--calibration", path)
    assert "is 64 x 48" in said
    assert "is for 640 x 480" in said
    # Certified later it is refused, and if that is forced, when processing; what was derived stands.
    before = every_file(archive_of(lab) / "derived")
    said = lab.fails("calibration", "add", path, "--certify")
    assert "with 64 x 48; it is for 640 x 480" in said
    lab("calibration", "add", path, "--certify", "--force", "--reason", "new scans will be larger")
    said = lab.fails("process", "--recipe", "paper")
    assert "640 x 480" in said
    assert every_file(archive_of(lab) / "derived") == before


def test_the_same_content_is_imported_once(lab: Inside, photos: Path) -> None:
    said = lab.fails("import", "images", photos, "--step-deg", "10")
    (scan,) = lab.json("scan", "list")
    assert f"are scan {scan['scan']} already" in said
    lab("import", "images", photos, "--step-deg", "10", "--again")
    assert len(lab.json("scan", "list")) == 2


# -- documents --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('"fx_px": NaN', "contains NaN"),
        ('"fx_px": 1e999', "camera.fx_px"),
        ('"fx_px": -3', "camera.fx_px"),
        ('"fx_px": "wide"', "camera.fx_px"),
    ],
)
def test_a_calibration_with_a_bad_number_is_refused(
    lab: Inside, tiny_files: Path, text: str, expected: str
) -> None:
    document = (tiny_files / "cal.json").read_text().replace('"fx_px": 300.0', text)
    (lab.cwd / "bad.json").write_text(document)
    said = lab.fails("calibration", "add", lab.cwd / "bad.json")
    assert "bad.json" in said
    assert expected in said
    assert len(lab.json("calibration", "list")) == 1


EXTRACT, TRIANGULATE = ('[[stages]]\nstage = "extract"\n', '[[stages]]\nstage = "triangulate"\n')


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f'name = "a"\n[[stages]]\nstage = "sharpen"\n{EXTRACT}{TRIANGULATE}', "sharpen"),
        (f'name = "a"\n{EXTRACT}base = 3\n{TRIANGULATE}', "base"),
        (f'name = "a"\n{EXTRACT}base_dn = nan\n{TRIANGULATE}', "base_dn"),
        (f'name = "a"\n{EXTRACT}method = "magic"\n{TRIANGULATE}', "magic"),
        (f'name = "a"\n{TRIANGULATE}{EXTRACT}', "out of order"),
        (f'name = "a"\n{EXTRACT}[[stages]]\nstage = "undistort"\n', "needs the stages extract and"),
        ('name = "a"\n', "no [[stages]]"),
        ("name = \n", "not TOML"),
    ],
)
def test_a_bad_recipe_is_named(lab: Inside, text: str, expected: str) -> None:
    path = lab.cwd / "mine.toml"
    path.write_text(text)
    said = lab.fails("process", "--recipe", path)
    assert "mine.toml" in said
    assert expected in said


def test_a_recipe_that_is_not_there(lab: Inside) -> None:
    assert "default, paper" in lab.fails("process", "--recipe", "best")
    assert "recipe show" in lab.fails("process", "--recipe", "mine.toml")


# -- names and words --------------------------------------------------------------------------------


def test_no_archive_and_a_newer_archive(lab: Inside, tmp_path: Path) -> None:
    lost = Inside(tmp_path)
    for words in (("status",), ("process",), ("query", "SELECT 1"), ("verify",), ("scan", "list")):
        said = lost.fails(*words)
        assert f"no archive in {tmp_path} or above" in said
        assert "turnscan init" in said
    settings = archive_of(lab) / "turnscan.toml"
    text = settings.read_text()
    assert "version = 1\n" in text
    settings.write_text(text.replace("version = 1\n", "version = 2\n"))
    before = every_file(archive_of(lab))
    assert "newer turnscan" in lab.fails("process")
    assert every_file(archive_of(lab)) == before


def test_names_that_nothing_has(lab: Inside) -> None:
    for words in (
        ("scan", "show", "s-nothing"),
        ("process", "bust"),
        ("status", "bust"),
        ("export", "bust", "out.ply"),
        ("scan", "tag", "bust", "a=b"),
        ("calibration", "show", "c-123"),
        ("process", "--calibration", "c-123"),
    ):
        said = lab.fails(*words)
        assert words[2 if words[0] in {"scan", "calibration"} else -1] in said or "bust" in said
    assert not (lab.cwd / "out.ply").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("polish",), "polish"),
        (("process", "--fast"), "--fast"),
        (("status", "--format", "xml"), "xml"),
        (("process", "--workers", "0"), "workers"),
        (("import", "images", "photos"), "--step-deg or --angles"),
        (
            ("import", "images", "photos", "--step-deg", "1", "--angles", "a.csv"),
            "--step-deg or --angles",
        ),
        (("import", "images", "photos", "--step-deg", "wide"), "'--step-deg'"),
        (("import", "images", "photos", "--step-deg", "1", "--tag", "owner"), "name=value"),
        (("process", "latest", "--all"), "--all"),
        (("process", "latest", "--where", "frames = 3"), "--where"),
        (("status", "--json", "--format", "csv"), "--json"),
        (("export", "latest"), "OUT"),
        (("query", "DELETE FROM scans"), "SELECT"),
        (("query", "SELECT nothing FROM scans"), "nothing"),
        (("scan", "list", "--where", "colour = 3"), "colour"),
        (("calibration", "certify", "c-", "--from", "2026-05-02", "--to", "2026-05-01"), "--to"),
        (("calibration", "certify", "c-", "--from", "yesterday"), "ISO 8601"),
    ],
)
def test_usage_is_exit_code_two(
    lab: Inside, photos: Path, words: tuple[str, ...], expected: str
) -> None:
    assert expected in lab.fails(*words, code=2)


def test_out_files_are_not_replaced_or_guessed(lab: Inside) -> None:
    out = lab.cwd / "cloud.ply"
    lab("export", "latest", out)
    first = out.read_bytes()
    assert "--overwrite" in lab.fails("export", "latest", out)
    lab("export", "latest", out, "--overwrite")
    assert out.read_bytes() == first
    assert ".ply" in lab.fails("export", "latest", lab.cwd / "cloud.xyz", code=2)
    lab.fails("export", "latest", lab.cwd / "no" / "folder" / "cloud.ply")
    assert "turnscan process" in lab.fails("export", "latest", out, "--recipe", "paper", "--overwrite")
    assert out.read_bytes() == first


# -- damage -----------------------------------------------------------------------------------------


def flip(path: Path, where: float = 0.4) -> None:
    data = bytearray(path.read_bytes())
    data[int(len(data) * where)] ^= 0x10
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def one_row_more(path: Path) -> None:
    manifest = json.loads(path.read_text())
    write_json(path, manifest | {"rows": manifest["rows"] + 1})


@pytest.mark.parametrize(
    ("pattern", "spoil"),
    [
        ("scan.mcap", flip),
        ("scan.mcap", cut),
        ("scan.json", flip),
        ("manifest-sha256.txt", flip),
        ("k-*.parquet", flip),
        ("k-*.parquet", cut),
        ("k-*.parquet", Path.unlink),
        ("k-*.json", one_row_more),
        ("k-*.json", cut),
        ("c-*.json", flip),
    ],
)
def test_verify_lists_what_is_damaged(lab: Inside, pattern: str, spoil: Callable[[Path], None]) -> None:
    assert lab.json("verify") == []
    path = sorted(archive_of(lab).rglob(pattern))[0]
    spoil(path)
    done = lab.run("verify", "--json")
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    # Either of a table and its manifest may be the one that is wrong: both have the same stem.
    named = path.parent.name if path.name.startswith(("scan", "manifest")) else path.stem
    assert any(named in f["path"] for f in found), found
    assert all(f["what"] and f["hint"] for f in found)
    assert "not as they were written" in done.stderr


def test_a_damaged_log_is_not_processed(lab: Inside) -> None:
    before = every_file(archive_of(lab) / "derived")
    log = only(archive_of(lab), "scan.mcap")
    flip(log)
    assert "scan.mcap" in lab.fails("process", "--recipe", "paper")
    assert every_file(archive_of(lab) / "derived") == before
    assert not list((archive_of(lab) / "staging").iterdir())


def test_a_damaged_table_is_reported_repaired_and_derived_again(lab: Inside) -> None:
    points = only(archive_of(lab) / "derived" / "points", "*.parquet")
    whole = points.read_bytes()
    flip(points)
    assert points.name in lab.fails("export", "latest", lab.cwd / "cloud.ply")
    assert not (lab.cwd / "cloud.ply").exists()
    planned = lab.json("repair", "--dry-run")
    assert any(points.name in r["path"] and "quarantine" in r["did"] for r in planned)
    assert points.exists()
    lab("repair")
    assert not points.exists()
    (did,) = lab.json("process")
    assert did["did"] == "derived points"
    assert points.read_bytes() == whole
    assert lab.json("verify") == []
