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
from turnscan.schemas.recipe import BUILT_IN
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


def test_its_tables_are_still_known_by_their_keys(old: Archive) -> None:
    for recipe in BUILT_IN.values():
        (outcome,) = derive(old, old.scans(), recipe)
        assert outcome.error is None
        assert outcome.derived == (), "an input of the key changed: raise the stage's version instead"


def test_deriving_again_gives_the_same_values(old: Archive) -> None:
    before = {m.key: [b.to_pydict() for b in old.read(m)] for m in old.derivations()}
    shutil.rmtree(old.root / "derived")
    for recipe in BUILT_IN.values():
        list(derive(old, old.scans(), recipe))
    after = {m.key: [b.to_pydict() for b in old.read(m)] for m in old.derivations()}
    assert before.keys() == after.keys()
    for key, batches in before.items():
        for one, two in zip(batches, after[key], strict=True):
            for name, values in one.items():
                tolerance = 1e-3 if name.endswith("_mm") else 1e-5
                assert np.allclose(values, two[name], rtol=1e-6, atol=tolerance, equal_nan=True), name


def test_a_log_written_now_has_the_same_content_digest(old: Archive, tmp_path: Path) -> None:
    new = make(tmp_path / "new").scan("golden")
    assert new.content_sha256 == old.scan("golden").content_sha256
    assert new.frames_sha256 == old.scan("golden").frames_sha256
