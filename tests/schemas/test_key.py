"""Keys: what moves them and what does not."""

from __future__ import annotations

import pytest

from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.key import points_key, stage_key, stripes_key
from turnscan.schemas.recipe import (
    BUILT_IN,
    METHOD_VERSIONS,
    Denoise,
    Extract,
    Grey,
    Recipe,
    Triangulate,
    Undistort,
)

CONTENT = "ab" * 32
DEFAULT = Recipe(name="d", stages=(Grey(), Denoise(), Extract(), Undistort(), Triangulate()))
PAPER = Recipe(name="p", stages=(Undistort(on="frames"), Grey(), Denoise(), Extract(), Triangulate()))


def calibration(*, h: float = 120.0, k1: float = 0.1, second_h: float | None = None) -> Calibration:
    planes = [LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=h)]
    if second_h is not None:
        planes.append(LaserPlane(laser=1, normal=(-0.6, 0.0, 0.8), distance_mm=second_h))
    return Calibration(
        rig="r",
        camera=Intrinsics(
            width_px=64,
            height_px=48,
            fx_px=60,
            fy_px=60,
            cx_px=32,
            cy_px=24,
            distortion=(k1, 0, 0, 0, 0),
        ),
        lasers=tuple(planes),
        turntable=TurntableAxis(point_mm=(0, 0, 400), direction=(0, -1, 0)),
    )


def keys(recipe: Recipe, c: Calibration, content: str = CONTENT) -> tuple[str, str]:
    stripes, _ = stripes_key(recipe, content_sha256=content, calibration=c, lasers=[0])
    points, _ = points_key(recipe, stripes=stripes, calibration=c, lasers=[0])
    return stripes, points


def test_keys_are_pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """What made these keys is unchanged; a method's raised version, and that alone, makes others."""
    newer = keys(DEFAULT, calibration())
    monkeypatch.setitem(METHOD_VERSIONS, "varied-boundary", 1)
    stripes, points = keys(DEFAULT, calibration())
    assert stripes == "61a4d7d49d7248a8419ae210876319f3838ea268db00efa8d95274c39260431b"
    assert points == "7e514cf6a06758aea8728040789266f3a4de498dbfc87235ffff8e06d914810a"
    assert not {stripes, points} & set(newer)


def test_a_moved_laser_plane_moves_points_alone() -> None:
    for recipe in (DEFAULT, PAPER):
        a, b = keys(recipe, calibration()), keys(recipe, calibration(h=121.0))
        assert a[0] == b[0]
        assert a[1] != b[1]


def test_a_new_lens_moves_stripes_only_when_frames_are_undistorted() -> None:
    a, b = keys(DEFAULT, calibration()), keys(DEFAULT, calibration(k1=0.2))
    assert a[0] == b[0]
    assert a[1] != b[1]
    a, b = keys(PAPER, calibration()), keys(PAPER, calibration(k1=0.2))
    assert a[0] != b[0]
    assert a[1] != b[1]


def test_the_plane_of_a_laser_that_the_scan_lacks_moves_nothing() -> None:
    assert keys(DEFAULT, calibration(second_h=5.0)) == keys(DEFAULT, calibration(second_h=6.0))


def test_content_and_parameters_move_everything() -> None:
    base = keys(DEFAULT, calibration())
    other = keys(DEFAULT, calibration(), content="cd" * 32)
    assert base[0] != other[0]
    assert base[1] != other[1]
    changed = Recipe(
        name="d",
        stages=(Grey(), Denoise(), Extract(base_dn=31.0), Undistort(), Triangulate()),
    )
    assert keys(changed, calibration())[0] != base[0]


def test_the_name_of_a_recipe_moves_nothing() -> None:
    renamed = DEFAULT.model_copy(update={"name": "other", "note": "x"})
    assert renamed.recipe_id() == DEFAULT.recipe_id()
    assert keys(renamed, calibration()) == keys(DEFAULT, calibration())


def test_a_raised_stage_version_moves_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = keys(DEFAULT, calibration())
    monkeypatch.setitem(
        __import__("turnscan.schemas.recipe", fromlist=["x"]).STAGE_VERSIONS, "triangulate", 99
    )
    after = keys(DEFAULT, calibration())
    assert before[0] == after[0]
    assert before[1] != after[1]


def test_order_of_parts_does_not_matter() -> None:
    a = stage_key(Triangulate(), input_sha256=None, parts={"a": "1", "b": "2"}, upstream=["x"])
    b = stage_key(Triangulate(), input_sha256=None, parts={"b": "2", "a": "1"}, upstream=["x"])
    assert a == b


def test_a_missing_part_is_named() -> None:
    bare = Calibration(rig="r")
    stripes, _ = stripes_key(DEFAULT, content_sha256=CONTENT, calibration=None, lasers=[0])
    with pytest.raises(CalibrationError, match="has no intrinsics, which the stage undistort"):
        points_key(DEFAULT, stripes=stripes, calibration=bare, lasers=[0])
    with pytest.raises(CalibrationError, match=r"calibration \(none\) has no intrinsics"):
        stripes_key(PAPER, content_sha256=CONTENT, calibration=None, lasers=[0])


def test_recipe_ids_of_the_built_ins_differ() -> None:
    ids = {r.recipe_id() for r in BUILT_IN.values()}
    assert len(ids) == len(BUILT_IN)
