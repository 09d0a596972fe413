"""What is known of each image: from a step, or from a CSV whose every mistake is named by its line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.poses import Pose, poses_by_step, poses_from_csv, with_times
from turnscan.schemas.errors import InputError

IMAGES = [Path(f"run/img{i}.png") for i in (1, 2, 10)]


def table(folder: Path, *lines: str) -> Path:
    path = folder / "angles.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def brief(poses: list[Pose]) -> list[tuple[str, float, tuple[int, ...]]]:
    return [(p.path.name, p.angle_deg, p.lasers_on) for p in poses]


# -- by step --------------------------------------------------------------------------------------


def test_a_step_gives_each_image_its_angle() -> None:
    poses = poses_by_step(IMAGES, step_deg=-1.5, start_deg=10.0, laser=3)
    assert brief(poses) == [
        ("img1.png", 10.0, (3,)),
        ("img2.png", 8.5, (3,)),
        ("img10.png", 7.0, (3,)),
    ]


@given(st.integers(1, 2000), st.floats(-10, 10), st.floats(-400, 400))
def test_angles_do_not_drift(count: int, step: float, start: float) -> None:
    poses = poses_by_step([Path(f"{i}.png") for i in range(count)], step_deg=step, start_deg=start)
    assert poses[-1].angle_deg == start + (count - 1) * step


def test_one_background_comes_first_and_is_for_all() -> None:
    images = [Path("a1.png"), Path("a2.png"), Path("dark.png")]
    poses = poses_by_step(images, step_deg=2.0, start_deg=5.0, background="dark*")
    assert brief(poses) == [
        ("dark.png", 5.0, ()),
        ("a1.png", 5.0, (0,)),
        ("a2.png", 7.0, (0,)),
    ]


def test_each_background_comes_before_its_lit_frame() -> None:
    images = [Path(n) for n in ("off1.png", "off2.png", "on1.png", "on2.png")]
    poses = poses_by_step(images, step_deg=2.0, background="off*.png")
    assert brief(poses) == [
        ("off1.png", 0.0, ()),
        ("on1.png", 0.0, (0,)),
        ("off2.png", 2.0, ()),
        ("on2.png", 2.0, (0,)),
    ]
    pair = poses_by_step(images[1:3], step_deg=2.0, background="off*.png")
    assert brief(pair) == [("off2.png", 0.0, ()), ("on1.png", 0.0, (0,))]


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("nothing*", "0 laser-off frames fit 'nothing\\*', beside 3 lit ones"),
        ("img1*", "2 laser-off frames fit 'img1\\*', beside 1 lit ones"),
        ("img*", "3 laser-off frames fit"),
    ],
)
def test_backgrounds_that_fit_no_rule(pattern: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        poses_by_step(IMAGES, step_deg=1.0, background=pattern)


def test_a_single_image_that_is_dark() -> None:
    with pytest.raises(InputError, match="every image fits the laser-off pattern"):
        poses_by_step(IMAGES[:1], step_deg=1.0, background="img*")


@pytest.mark.parametrize("step", [float("nan"), float("inf")])
def test_a_step_must_be_finite(step: float) -> None:
    with pytest.raises(InputError, match=r"--step-deg (nan|inf)"):
        poses_by_step(IMAGES, step_deg=step)
    with pytest.raises(InputError, match=r"--start-deg (nan|inf)"):
        poses_by_step(IMAGES, step_deg=1.0, start_deg=step)


# -- from a CSV -----------------------------------------------------------------------------------


def test_a_csv_as_a_spreadsheet_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "angles.csv"
    text = "\ufefffile, angle_deg , laser,laser_on\r\nimg10.png,-3,0;1,1\r\n\r\n"
    text += '"img1.png", 1.5e1,2,yes\r\n./img2.png,0,,off\r\n'
    path.write_bytes(text.encode())
    assert brief(poses_from_csv(IMAGES, path)) == [
        ("img1.png", 15.0, (2,)),
        ("img2.png", 0.0, ()),
        ("img10.png", -3.0, (0, 1)),
    ]


def test_a_folder_that_a_csv_names_must_be_the_right_one(tmp_path: Path) -> None:
    images = [tmp_path / "run7" / "img1.png"]
    for name in ("run7/img1.png", "../run7/img1.png", r"run7\img1.png", str(images[0])):
        path = table(tmp_path, "file,angle_deg", f"{name},5")
        assert poses_from_csv(images, path)[0].angle_deg == 5.0
    path = table(tmp_path, "file,angle_deg", "run8/img1.png,5")
    with pytest.raises(InputError, match=r"line 2: no image named 'run8/img1.png'"):
        poses_from_csv(images, path)


@pytest.mark.parametrize("angle", ["1e300", "36001", "-4e4"])
def test_angles_beyond_a_hundred_turns_are_mistakes(tmp_path: Path, angle: str) -> None:
    path = table(tmp_path, "file,angle_deg", f"img1.png,{angle}")
    with pytest.raises(InputError, match="within 36000"):
        poses_from_csv(IMAGES[:1], path)
    with pytest.raises(InputError, match="leaves 36000 degrees"):
        poses_by_step(IMAGES, step_deg=float(angle))


@pytest.mark.parametrize("column", ["t_ns", "laser"])
def test_endless_digits_are_refused(tmp_path: Path, column: str) -> None:
    path = table(tmp_path, f"file,angle_deg,{column}", f"img1.png,0,{'9' * 5000}")
    with pytest.raises(InputError, match=f"line 2: {column} is '9{{40}}'"):
        poses_from_csv(IMAGES[:1], path)


def test_lasers_of_a_frame_are_sorted_and_single(tmp_path: Path) -> None:
    path = table(tmp_path, "file,angle_deg,laser", "img1.png,0, 7 ;0;7")
    assert poses_from_csv(IMAGES[:1], path)[0].lasers_on == (0, 7)


@given(st.permutations(range(3)), st.permutations(range(3)))
def test_the_order_of_rows_and_images_does_not_matter(rows: list[int], place: list[int]) -> None:
    import tempfile

    lines = [f"img{n}.png,{n},{t}" for n, t in ((1, 20), (2, 10), (10, 10))]
    with tempfile.TemporaryDirectory() as folder:
        timed = table(Path(folder), "file,angle_deg,t_ns", *[lines[i] for i in rows])
        assert [p.path.name for p in poses_from_csv(IMAGES, timed)] == [
            "img2.png",
            "img10.png",
            "img1.png",
        ]
        cut = [lines[i].rsplit(",", 1)[0] for i in rows]
        untimed = table(Path(folder), "file,angle_deg", *cut)
        assert [p.path for p in poses_from_csv(IMAGES, untimed)] == IMAGES


def test_equal_names_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    images = [tmp_path / "a" / "img.png", tmp_path / "b" / "img.png"]
    good = table(tmp_path, "file,angle_deg", "b/img.png,2", "./a/img.png,1")
    assert [(p.path, p.angle_deg) for p in poses_from_csv(images, good)] == [
        (images[0], 1.0),
        (images[1], 2.0),
    ]
    with pytest.raises(InputError, match=r"angles\.csv, line 2: 2 images named 'img\.png'"):
        poses_from_csv(images, table(tmp_path, "file,angle_deg", "img.png,2", "a/img.png,1"))


HEAD = "file,angle_deg,t_ns,laser,laser_on"
GOOD = ("img1.png,0,1,0,1", "img2.png,1,2,0,1", "img10.png,2,3,0,1")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            ("file,laser", "img1.png,0"),
            r"line 1: columns are \['file', 'laser'\], expected file, angle",
        ),
        (("file,angle_deg,speed", "a,0,1"), "line 1: columns are .*'speed'"),
        (("file,angle_deg,angle_deg", "a,0,1"), "line 1: columns are .*each once"),
        (("file;angle_deg", "img1.png;0"), "line 1: columns are"),
        ((HEAD, *GOOD[:2]), r"no row for img10\.png"),
        ((HEAD, *GOOD, "img3.png,0,4,0,1"), r"line 5: no image named 'img3\.png'"),
        ((HEAD, *GOOD, ",0,4,0,1"), "line 5: no image named ''"),
        ((HEAD, *GOOD, "img2.png,0,4,0,1"), r"line 5: img2\.png stands already in line 3"),
        ((HEAD, *GOOD[:2], "", "img10.png,nan,4,0,1"), "line 5: angle_deg is 'nan', expected a number"),
        ((HEAD, *GOOD[:2], "img10.png,inf,4,0,1"), "line 4: angle_deg is 'inf'"),
        ((HEAD, *GOOD[:2], "img10.png,,4,0,1"), "line 4: angle_deg is ''"),
        ((HEAD, *GOOD[:2], "img10.png"), "line 4: angle_deg is ''"),
        ((HEAD, *GOOD[:2], "img10.png,12 deg,4,0,1"), "line 4: angle_deg is '12 deg'"),
        (("file,angle_deg", "img1.png,12,5"), "line 2: more cells than columns"),
        ((HEAD, *GOOD[:2], "img10.png,2,-3,0,1"), "line 4: t_ns is '-3', expected whole nanoseconds"),
        ((HEAD, *GOOD[:2], "img10.png,2,1e9,0,1"), "line 4: t_ns is '1e9'"),
        (
            (HEAD, *GOOD[:2], "img10.png,2,9223372036854775808,0,1"),
            "line 4: t_ns is '9223372036854775808'",
        ),
        ((HEAD, *GOOD[:2], "img10.png,2,\u0663,0,1"), "line 4: t_ns is"),
        ((HEAD, *GOOD[:2], "img10.png,2,,0,1"), "line 4: t_ns is empty, but other rows have it"),
        ((HEAD, "img1.png,0,,0,1", *GOOD[1:]), "line 2: t_ns is empty"),
        ((HEAD, *GOOD[:2], "img10.png,2,3,256,1"), "line 4: laser is '256', expected a number from 0"),
        ((HEAD, *GOOD[:2], "img10.png,2,3,0;x,1"), "line 4: laser is '0;x'"),
        ((HEAD, *GOOD[:2], "img10.png,2,3,0;,1"), "line 4: laser is '0;'"),
        ((HEAD, *GOOD[:2], "img10.png,2,3,\u00b2,1"), "line 4: laser is '\u00b2'"),
        ((HEAD, *GOOD[:2], "img10.png,2,3,-1,1"), "line 4: laser is '-1'"),
        ((HEAD, *GOOD[:2], "img10.png,2,3,0,maybe"), "line 4: laser_on is 'maybe', expected 1 or 0"),
        ((HEAD, *[g[:-1] + "0" for g in GOOD]), "every frame is a laser-off frame"),
        ((HEAD,), "has no rows"),
        (("",), r"line 1: columns are \[\]"),
    ],
)
def test_mistakes_in_a_csv_are_named_by_file_and_line(
    tmp_path: Path, lines: tuple[str, ...], message: str
) -> None:
    path = table(tmp_path, *lines)
    with pytest.raises(InputError, match=message) as caught:
        poses_from_csv(IMAGES, path)
    assert str(path) in caught.value.message


def test_many_missing_rows_are_counted(tmp_path: Path) -> None:
    images = [Path(f"{i}.png") for i in range(40)]
    with pytest.raises(InputError, match=r"no row for 1\.png, 2\.png, .*5\.png and 34 more"):
        poses_from_csv(images, table(tmp_path, "file,angle_deg", "0.png,1"))


def test_files_that_are_no_csv(tmp_path: Path) -> None:
    path = tmp_path / "angles.csv"
    with pytest.raises(InputError, match=r"angles\.csv: cannot be read \(No such file"):
        poses_from_csv(IMAGES, path)
    for data in ("file,angle_deg\nK\u00fcche.png,1\n".encode("latin-1"), b"PK\x03\x04\xff\xfe\0\0"):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"angles\.csv"):
            poses_from_csv(IMAGES, path)
    path.write_bytes(b'file,angle_deg\n"' + b"x" * 200_000 + b'",1\n')
    with pytest.raises(InputError, match=r"angles\.csv: is no CSV"):
        poses_from_csv(IMAGES, path)


# -- times ----------------------------------------------------------------------------------------


def test_nominal_times_are_a_second_apart() -> None:
    poses = poses_by_step(IMAGES, step_deg=1.0)
    assert [t for t, _ in with_times(poses, 5)] == [5, 1_000_000_005, 2_000_000_005]


def test_own_times_win() -> None:
    poses = [Pose(p, 0.0, (0,), t_ns=t) for p, t in zip(IMAGES, (7, 9, 9), strict=True)]
    assert [t for t, _ in with_times(poses, 5)] == [7, 9, 9]
