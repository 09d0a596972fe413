"""Gates judge by themselves, a failed part fails the whole, and old documents keep their ids."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from turnscan.schemas.calibration import Calibration, parse_calibration
from turnscan.schemas.document import dump_json
from turnscan.schemas.quality import EstimationInput, Gate, LeftOut, Quality, joined_quality

NUMBERS = st.floats(-1e9, 1e9)


@given(NUMBERS, NUMBERS)
def test_a_gate_is_the_comparison_that_it_names(value: float, limit: float) -> None:
    assert Gate.at_most("a", value, limit).passed == (value <= limit)
    assert Gate.at_least("a", value, limit).passed == (value >= limit)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_could_not_be_computed_never_passes(value: float) -> None:
    for gate in (Gate.at_most("condition", value, 1e6), Gate.at_least("condition", value, -1e6)):
        assert not gate.passed
        assert "could not be computed" in gate.sentence()


def test_nobody_writes_passed_by_hand() -> None:
    with pytest.raises(ValidationError, match="says otherwise"):
        Gate(name="rms", value=0.9, limit=0.5, unit="px", sense="at most", passed=True)


def test_verdicts() -> None:
    good, bad = Gate.at_most("rms", 0.2, 0.5, "px"), Gate.at_least("views", 3, 8)
    assert Quality(part="axis").verdict == "not judged"
    assert Quality(part="axis", gates=(good,)).verdict == "passed"
    failed = Quality(part="axis", gates=(good, bad))
    assert (failed.verdict, failed.failed()) == ("failed", (bad,))
    assert bad.sentence() == "views is 3, limit at least 8"
    whole = Calibration(rig="r1", quality=(Quality(part="intrinsics", gates=(good,)), failed))
    assert whole.verdict == "failed"
    assert whole.failed_gates() == (("axis", bad),)
    assert Calibration(rig="r1").verdict == "not judged"


def test_a_part_that_is_estimated_again_is_judged_again() -> None:
    old = joined_quality(None, Quality(part="axis", notes=("old",)), Quality(part="intrinsics"))
    new = joined_quality(old, Quality(part="axis", notes=("new",)))
    assert [(q.part, q.notes) for q in new] == [("axis", ("new",)), ("intrinsics", ())]
    with pytest.raises(ValidationError, match="the same part stands twice"):
        Calibration(rig="r1", quality=(Quality(part="axis"), Quality(part="axis")))
    with pytest.raises(ValidationError, match="the same gate stands twice"):
        Quality(part="axis", gates=(Gate.at_most("a", 1, 2), Gate.at_most("a", 3, 4)))


def test_documents_that_nobody_judged_keep_their_digest() -> None:
    # The id that this document had before there were gates.
    assert Calibration(rig="r1").calibration_id() == OLD_ID
    assert "quality" not in Calibration(rig="r1").plain()


def test_quality_is_part_of_the_document_and_comes_back() -> None:
    quality = Quality(
        part="plane/0",
        method="ransac",
        gates=(Gate.at_most("rms", 0.2, 0.5, "mm"),),
        left_out=(LeftOut(what="a.png", why="no stripe"),),
        notes=("honest",),
        inputs=(EstimationInput(name="b.png", sha256="a" * 64),),
    )
    judged = Calibration(rig="r1", quality=(quality,))
    assert judged.calibration_id() != OLD_ID
    assert judged.part_ids() == Calibration(rig="r1").part_ids(), "judging moves no point"
    assert parse_calibration(dump_json(judged.plain()), where="x") == judged


OLD_ID = "c-3d96e9c1add9"
