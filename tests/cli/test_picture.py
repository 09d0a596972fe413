"""The picture of a cloud: its size, what is on it, and what it does with odd clouds."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.cli.picture import draw_cloud
from turnscan.schemas.errors import InputError, StorageError


def cylinder(n: int = 5000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    turn = rng.uniform(0, 2 * np.pi, n)
    return 50 * np.cos(turn), 50 * np.sin(turn), rng.uniform(0, 120, n)


def drawn(path: Path, *xyz: np.ndarray, **options: int) -> np.ndarray:
    draw_cloud(*xyz, path, title="a cylinder", **options)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def coloured(image: np.ndarray) -> np.ndarray:
    """Pixels of points: neither white paper nor grey ink, above the legend."""
    part = image[60:-70].astype(int)
    return np.ptp(part, axis=2) > 40


def test_size_and_content(tmp_path: Path) -> None:
    image = drawn(tmp_path / "a.png", *cylinder())
    assert image.shape == (720, 1400, 3)
    assert image.dtype == np.uint8
    points = coloured(image)
    split = int(1400 * 0.56)
    assert points[:, :split].sum() > 5000
    # The plan of a cylinder's shell is a ring: points around, none in the middle.
    plan = points[:, split:]
    rows, columns = np.nonzero(plan)
    middle = (int(rows.mean()), int(columns.mean()))
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=6)
    assert not plan[middle[0] - 60 : middle[0] + 60, middle[1] - 60 : middle[1] + 60].any()
    # Title, and the legend's bar from the lowest colour to the highest.
    assert (image[:50, :400].min(axis=2) < 120).any()
    bar = image[690, 40:260].astype(int)
    assert np.abs(bar[3] - bar[-3]).sum() > 200


def test_height_is_colour_and_y_is_up_in_the_plan(tmp_path: Path) -> None:
    n = 400
    spread = np.linspace(-40, 40, n)
    # A low bar at y = -30 and a high one at y = 30: dark below, bright above.
    x, y = np.tile(spread, 2), np.repeat([-30.0, 30.0], n)
    image = drawn(tmp_path / "a.png", x, y, np.repeat([0.0, 90.0], n))
    plan = image[60:-70, int(1400 * 0.56) :]
    half = len(plan) // 2
    upper, lower = (p[coloured_of(p)].mean() for p in (plan[:half], plan[half:]))
    assert upper > lower + 20


def coloured_of(part: np.ndarray) -> np.ndarray:
    return np.ptp(part.astype(int), axis=2) > 40


def test_other_sizes(tmp_path: Path) -> None:
    assert drawn(tmp_path / "a.png", *cylinder(), width_px=700, height_px=400).shape == (400, 700, 3)


def test_equal_clouds_give_equal_bytes(tmp_path: Path) -> None:
    x, y, z = cylinder()
    for name in ("a", "b"):
        draw_cloud(x, y, z, tmp_path / name, title="t")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    draw_cloud(x.astype(np.float32), y, z + 5, tmp_path / "c", title="t")
    assert (tmp_path / "a").read_bytes() != (tmp_path / "c").read_bytes()


def test_points_that_are_no_numbers_or_far_away_change_little(tmp_path: Path) -> None:
    x, y, z = cylinder()
    plain = drawn(tmp_path / "a.png", x, y, z)
    far = drawn(tmp_path / "b.png", np.r_[x, np.nan, 1e6], np.r_[y, 0, 0], np.r_[z, 0, 50])
    # One point a kilometre off would else shrink all others to a dot.
    assert coloured(far).sum() > 0.9 * coloured(plain).sum()


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_to_draw(tmp_path: Path, n: int) -> None:
    nothing = np.full(n, np.nan)
    with pytest.raises(InputError, match=r"a\.png: there are no points to draw"):
        draw_cloud(nothing, nothing, nothing, tmp_path / "a.png", title="t")
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize("n", [1, 2, 3, 20])
def test_few_points_are_drawn(tmp_path: Path, n: int) -> None:
    some = np.arange(n) * 10.0
    image = drawn(tmp_path / "a.png", some + 500, some, some - 3)
    assert coloured(image).sum() >= n


def test_points_on_one_spot_and_on_a_plane(tmp_path: Path) -> None:
    same = np.full(100, 7.0)
    assert coloured(drawn(tmp_path / "a.png", same, same, same)).any()
    x, y, _ = cylinder()
    assert coloured(drawn(tmp_path / "b.png", x, y, np.zeros(len(x)))).any()


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"cannot write .*no/a\.png"):
        draw_cloud(*cylinder(), tmp_path / "no" / "a.png", title="t")
    with pytest.raises(StorageError, match="cannot write"):
        draw_cloud(*cylinder(), tmp_path, title="t")
