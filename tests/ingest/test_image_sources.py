"""Which files are imported, and in what order."""

from __future__ import annotations

import os
import random
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from turnscan.ingest.image_sources import find_images, natural_key
from turnscan.schemas.errors import InputError


def names(paths: list[Path]) -> list[str]:
    return [p.name for p in paths]


def touch(folder: Path, *files: str) -> Path:
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


# -- order ----------------------------------------------------------------------------------------


def test_numbers_count_as_numbers() -> None:
    given_order = ["img10.png", "img2.png", "IMG1.png", "a.png", "img2b.png", "img02.png", "7.png"]
    expected = ["7.png", "a.png", "IMG1.png", "img02.png", "img2.png", "img2b.png", "img10.png"]
    assert names(sorted(map(Path, given_order), key=natural_key)) == expected


def test_a_name_that_begins_as_another_one_comes_after_it() -> None:
    assert names(sorted([Path("a.png2.png"), Path("a.png")], key=natural_key)) == [
        "a.png",
        "a.png2.png",
    ]


@given(st.lists(st.integers(0, 10**12), unique=True), st.text("abc _-", max_size=4))
def test_frame_numbers_sort_as_integers(numbers: list[int], stem: str) -> None:
    paths = [Path(f"{stem}{n}.png") for n in numbers]
    assert names(sorted(paths, key=natural_key)) == [f"{stem}{n}.png" for n in sorted(numbers)]


FILE_NAME = st.text(
    st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1
).filter(lambda n: n not in (".", ".."))


@given(st.lists(FILE_NAME, max_size=8), st.randoms())
@example(["\u00b2", "2", "a\u00b2"], random.Random(0))
@example(["A.png", "a.png", "a.png1", "\u0663.png"], random.Random(0))
def test_any_names_have_one_order(given_names: list[str], mix: random.Random) -> None:
    paths = [Path(n) for n in given_names]
    mixed = list(paths)
    mix.shuffle(mixed)
    assert names(sorted(paths, key=natural_key)) == names(sorted(mixed, key=natural_key))


def test_the_order_of_the_sources_does_not_matter(tmp_path: Path) -> None:
    touch(tmp_path, "b/img2.png", "a/img10.png", "a/img1.png")
    expected, _ = find_images([tmp_path / "a", tmp_path / "b"])
    assert names(expected) == ["img1.png", "img2.png", "img10.png"]
    assert find_images([tmp_path / "b" / "img2.png", str(tmp_path / "a" / "*.png")])[0] == expected


# -- what is taken --------------------------------------------------------------------------------


def test_a_folder_gives_its_images_and_says_what_it_skipped(tmp_path: Path) -> None:
    good = ["a.jpg", "b.JPEG", "c.png", "d.bmp", "e.tif", "f.TIFF"]
    bad = [".a.png", "._b.jpg", "notes.txt", "angles.csv", "g.gif", "png"]
    touch(tmp_path, *good, *bad, "below/h.png")
    (tmp_path / "folder.png").mkdir()
    images, skipped = find_images([tmp_path])
    assert names(images) == good
    assert names(skipped) == sorted(bad)


def test_globs_reach_into_folders(tmp_path: Path) -> None:
    touch(tmp_path, "run1/a.png", "run2/b.png", "run2/deep/c.png", "run2/notes.txt")
    assert names(find_images([f"{tmp_path}/run?/*.png"])[0]) == ["a.png", "b.png"]
    images, skipped = find_images([f"{tmp_path}/**/*"])
    assert names(images) == ["a.png", "b.png", "c.png"]
    assert names(skipped) == ["notes.txt"]


def test_a_file_with_brackets_in_its_name_is_no_pattern(tmp_path: Path) -> None:
    touch(tmp_path, "img[1].png", "img1.png")
    assert names(find_images([tmp_path / "img[1].png"])[0]) == ["img[1].png"]


def test_a_file_that_is_named_twice_is_taken_once(tmp_path: Path) -> None:
    touch(tmp_path, "a.png")
    assert len(find_images([tmp_path, tmp_path / "a.png", f"{tmp_path}/*"])[0]) == 1


def test_links_are_followed_and_broken_ones_left_out(tmp_path: Path) -> None:
    touch(tmp_path, "real/a.png")
    links = tmp_path / "links"
    links.mkdir()
    (links / "l.png").symlink_to(tmp_path / "real" / "a.png")
    (links / "gone.png").symlink_to(tmp_path / "nothing")
    (links / "round.png").symlink_to(links / "round.png")
    assert names(find_images([links])[0]) == ["l.png"]
    with pytest.raises(InputError, match=r"gone\.png: no such file"):
        find_images([links / "gone.png"])


def test_a_device_or_pipe_is_no_image(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    touch(tmp_path, "a.png")
    assert names(find_images([tmp_path])[0]) == ["a.png"]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nothing", "nothing: no such file or folder, and no file fits"),
        ("*.png", r"\*\.png: no such file"),
        ("notes.txt", r"notes\.txt is no image that can be imported"),
        (".hidden.png", r"\.hidden\.png is no image"),
        ("", "no image in "),
        ("n" * 300, "nnn: cannot be read"),
    ],
)
def test_what_cannot_be_imported_is_said(tmp_path: Path, source: str, message: str) -> None:
    touch(tmp_path, "notes.txt", ".hidden.png")
    with pytest.raises(InputError, match=message):
        find_images([f"{tmp_path}/{source}"])


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that another user can reach: pytest's own are closed to all but one."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def test_a_closed_folder_is_an_error(open_folder: Path) -> None:
    closed = touch(open_folder / "closed", "a.png")
    closed.chmod(0)
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        for source in (closed, closed / "a.png"):
            with pytest.raises(InputError, match=r"cannot be read \(Permission denied\)"):
                find_images([source])
    finally:
        if root:
            os.seteuid(0)
        closed.chmod(stat.S_IRWXU)
