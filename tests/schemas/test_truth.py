"""Truth is packed and unpacked to the last bit, and damage is noticed."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.schemas.channels import event_topic, topic_of
from turnscan.schemas.errors import DamageError, InputError
from turnscan.schemas.events import StripeTruth
from turnscan.schemas.truth import COLUMNS, packed_truth, unpacked_truth

FACTS: dict[str, Any] = {"t_ns": 5, "frame": 2, "laser": 3, "stripe": "vertical", "angle_rad": 0.25}


def columns(n: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        name: rng.integers(0, 65535, n).astype(kind)
        if kind == "<u2"
        else rng.normal(size=n).astype(kind)
        for name, kind in COLUMNS.items()
    }


@given(st.integers(0, 700), st.integers(0, 100))
def test_there_and_back(n: int, seed: int) -> None:
    given_columns = columns(n, seed)
    event = packed_truth(given_columns, **FACTS)
    assert event.points == n
    back = unpacked_truth(StripeTruth.model_validate_json(event.model_dump_json()))
    assert list(back) == list(COLUMNS)
    for name in COLUMNS:
        assert back[name].tobytes() == given_columns[name].tobytes()


def test_topics() -> None:
    event = packed_truth(columns(1), **FACTS)
    assert event_topic(event) == "/truth/3"
    known = topic_of("/truth/255")
    assert known is not None
    assert known.event is StripeTruth
    assert not known.content, "truth never decides what a derivation is"
    for other in ("/truth", "/truth/", "/truth/x", "/truth/01", "/truth/-1", "/truth/0/1"):
        assert topic_of(other) is None


def test_columns_that_do_not_fit() -> None:
    for bad in (
        {**columns(3), "u_px": np.zeros(2)},
        {k: v for k, v in columns(3).items() if k != "row"},
        {**columns(3), "more": np.zeros(3)},
    ):
        with pytest.raises(InputError, match="truth of frame 2: columns"):
            packed_truth(bad, **FACTS)


def test_damage() -> None:
    event = packed_truth(columns(4), **FACTS)
    short = base64.b64encode(b"12345").decode()
    for text, message in (
        (short, "u_px holds 5 bytes, expected 4 numbers"),
        ("?!", "u_px is not base64"),
    ):
        with pytest.raises(DamageError, match=message):
            unpacked_truth(event.model_copy(update={"u_px": text}))
