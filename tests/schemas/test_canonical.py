"""Identity: canonical JSON and tagged digests, with literal digests so that a change is loud."""

from __future__ import annotations

import hashlib
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.schemas.canonical import canonical_json, digest
from turnscan.schemas.errors import DocumentError

json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.text(st.characters(exclude_categories=["Cs"]), max_size=6), inner, max_size=4
        )
    ),
    max_leaves=12,
)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({"b": 1, "a": [True, None]}, b'{"a":[true,null],"b":1}'),
        (-0.0, b"0.0"),
        (0.1, b"0.1"),
        (1.0, b"1.0"),
        (1, b"1"),
        ("\u00e9", b'"\xc3\xa9"'),
        ((1, 2), b"[1,2]"),
    ],
)
def test_canonical_form_is_pinned(value: object, expected: bytes) -> None:
    assert canonical_json(value) == expected


def test_digest_is_sha256_over_tag_and_canonical_form() -> None:
    assert digest("t", {"a": 1}) == hashlib.sha256(b'turnscan:t\n{"a":1}').hexdigest()
    pinned = "40032a31df00c59a13a105bfbbb3e911e43263e781547ad7dee181b6a05e053d"
    assert digest("t", {"a": 1}) == pinned


def test_two_tags_never_share_a_digest() -> None:
    assert digest("a", {}) != digest("b", {})


@given(json_values)
def test_canonical_form_reads_back_as_the_same_value(value: object) -> None:
    assert json.loads(canonical_json(value)) == value


@given(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), st.integers()))
def test_order_of_keys_does_not_matter(value: dict[str, int]) -> None:
    assert canonical_json(value) == canonical_json(dict(reversed(list(value.items()))))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_not_a_number_is_refused_with_its_place(bad: float) -> None:
    with pytest.raises(DocumentError, match=r"camera\.fx_px\[1\] is"):
        canonical_json({"camera": {"fx_px": [1.0, bad]}})


@pytest.mark.parametrize("bad", [{1: 2}, {"a": object()}, {"a": b"x"}])
def test_what_json_cannot_hold_is_refused(bad: object) -> None:
    with pytest.raises(DocumentError):
        canonical_json(bad)
