"""Errors keep their message and hint when they travel between processes."""

from __future__ import annotations

import pickle

import pytest

from turnscan.schemas import errors

KINDS = [
    k for k in vars(errors).values() if isinstance(k, type) and issubclass(k, errors.TurnscanError)
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_errors_pickle_with_their_hint(kind: type[errors.TurnscanError]) -> None:
    error = pickle.loads(pickle.dumps(kind("what is wrong", hint="the way out")))
    assert type(error) is kind
    assert str(error) == "what is wrong"
    assert error.hint == "the way out"


def test_slugs_are_unique_and_exit_codes_are_one_or_two() -> None:
    slugs = [k.slug for k in KINDS]
    assert len(set(slugs)) == len(slugs)
    assert {k.exit_code for k in KINDS} == {1, 2}
