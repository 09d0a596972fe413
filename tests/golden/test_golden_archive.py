"""An archive written by format version 1 opens, verifies, and means the same, in every later version.

Tolerances: keys and digests are exact. Derived values may differ in the last bits of float32 from one
library or processor to another: 1e-5 px and 1e-3 mm, far below any stripe's own deviation. They may
change only together with a raised stage version, which changes the keys, too.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from turnscan.process.pipeline import derive
from turnscan.schemas.manifests import DerivationManifest
from turnscan.schemas.recipe import METHOD_VERSIONS, Recipe
from turnscan.store import Archive
from turnscan.store.verify import verify

from .make_archive import frames, make

OLD = Path(__file__).parent / "archive-1"


@pytest.fixture
def old(tmp_path: Path) -> Archive:
    shutil.copytree(OLD, tmp_path / "lab")
    return Archive.open(tmp_path / "lab")


def test_it_opens_and_verifies(old: Archive) -> None:
    assert verify(old) == []
    row = old.scan_rows()[0]
    assert (row["label"], row["tags"], row["rig"]) == ("golden", {"kind": "old"}, "golden")


def test_its_frames_are_what_was_written(old: Archive) -> None:
    read = [f.decode() for f in old.log(old.scan("golden").scan).frames()]
    assert all(np.array_equal(a, b) for a, b in zip(read, frames(), strict=True))


def test_its_tables_are_still_known_by_their_keys(
    old: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the methods' versions of that time every key is what it was."""
    for method in ("centroid", "varied-boundary"):
        monkeypatch.setitem(METHOD_VERSIONS, method, 1)
    for recipe in recipes(old):
        (outcome,) = derive(old, old.scans(), recipe)
        assert outcome.error is None
        assert outcome.derived == (), "an input of the key changed: raise the stage's version instead"


def test_raised_versions_derive_anew_and_keep_what_was(old: Archive) -> None:
    """The search for the stripe changed, the methods did not: the points are where they were."""
    before = {m.key: points_of(old, m) for m in old.derivations()}
    for recipe in recipes(old):
        (outcome,) = derive(old, old.scans(), recipe)
        assert outcome.error is None
        assert outcome.derived == ("stripes", "points")
    assert {m.key for m in old.derivations()} > set(before)
    after = [m for m in old.derivations() if m.key not in before]
    for one in (m for m in old.derivations() if m.key in before):
        assert points_of(old, one) == before[one.key]
        (two,) = (m for m in after if (m.kind, m.recipe) == (one.kind, one.recipe))
        rows, again = before[one.key], points_of(old, two)
        both = rows.keys() & again.keys()
        assert len(both) >= 0.99 * len(rows)
        assert len(again) <= 1.01 * len(rows)
        for place in both:
            assert np.allclose(rows[place], again[place], rtol=1e-6, atol=1e-3), place


def recipes(archive: Archive) -> list[Recipe]:
    """The recipes that its tables were made with, as their manifests keep them."""
    documents = {m.recipe: m.recipe_document for m in archive.derivations()}
    return [Recipe.model_validate(d) for d in documents.values()]


def points_of(archive: Archive, manifest: DerivationManifest) -> dict[tuple[int, int], list[float]]:
    """(frame, row) -> where the point is, in px or mm."""
    names = ["u_px"] if manifest.kind == "stripes" else ["x_mm", "y_mm", "z_mm"]
    out = {}
    for batch in archive.read(manifest):
        columns = batch.to_pydict()
        for i, place in enumerate(zip(columns["frame"], columns["row"], strict=True)):
            out[place] = [columns[n][i] for n in names]
    return out


def test_a_log_written_now_has_the_same_content_digest(old: Archive, tmp_path: Path) -> None:
    new = make(tmp_path / "new").scan("golden")
    assert new.content_sha256 == old.scan("golden").content_sha256
    assert new.frames_sha256 == old.scan("golden").frames_sha256
