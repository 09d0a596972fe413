"""Recipes: TOML in, order checked, unknown stages and parameters named."""

from __future__ import annotations

import pytest

from turnscan.schemas.errors import DocumentError, FormatVersionError, NotFoundError
from turnscan.schemas.recipe import BUILT_IN, built_in_recipe, parse_recipe

GOOD = b"""
name = "mine"
[[stages]]
stage = "grey"
mode = "red"
[[stages]]
stage = "extract"
method = "centroid"
base_dn = 12
[[stages]]
stage = "undistort"
[[stages]]
stage = "triangulate"
max_range_mm = 7000
"""


def test_recipe_from_toml() -> None:
    recipe = parse_recipe(GOOD, where="mine.toml")
    assert recipe.name == "mine"
    assert recipe.extract().base_dn == 12.0
    assert [s.stage for s in recipe.frame_stages()] == ["grey", "extract"]
    assert [s.stage for s in recipe.point_stages()] == ["undistort", "triangulate"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'stage = "grey"', b'stage = "sharpen"', "sharpen"),
        (b"base_dn", b"basedn", r"basedn: Extra inputs"),
        (b"base_dn = 12", b"base_dn = -1", "greater than or equal to 0"),
        (b'"centroid"', b'"guess"', "'argmax'"),
        (b'mode = "red"', b'mode = "weights"', "weights go with mode"),
        (b'stage = "triangulate"\nmax_range_mm = 7000', b'stage = "grey"', "stands twice"),
        (b'name = "mine"', b'name = "Mine!"', "name"),
        (b"[[stages]]", b"[[steps]]", r"no \[\[stages\]\]"),
        (b'"red"', b'"red', "not TOML"),
        (b"max_range_mm = 7000", b"max_range_mm = nan", "max_range_mm"),
    ],
)
def test_bad_recipes_name_file_and_value(old: bytes, new: bytes, message: str) -> None:
    assert old in GOOD
    with pytest.raises(DocumentError, match=message) as caught:
        parse_recipe(GOOD.replace(old, new), where="mine.toml")
    assert "mine.toml" in str(caught.value)


def test_stages_out_of_order_are_refused() -> None:
    text = b'name="x"\n' + b"".join(
        b'[[stages]]\nstage="%s"\n' % s for s in (b"triangulate", b"extract")
    )
    with pytest.raises(DocumentError, match="out of order"):
        parse_recipe(text, where="x.toml")


def test_newer_recipe_says_so() -> None:
    with pytest.raises(FormatVersionError, match="version 9"):
        parse_recipe(b"version = 9\n" + GOOD, where="x.toml")


def test_unknown_built_in_lists_what_there_is() -> None:
    with pytest.raises(NotFoundError, match="default, paper"):
        built_in_recipe("defalt")


def test_paper_recipe_is_the_papers_chain() -> None:
    stages = [s.plain() for s in BUILT_IN["paper"].stages]
    assert [s["stage"] for s in stages] == [
        "undistort",
        "grey",
        "denoise",
        "extract",
        "triangulate",
    ]
    assert stages[0]["on"] == "frames"
    assert stages[2]["method"] == "median"
    assert stages[3]["method"] == "varied-boundary"
