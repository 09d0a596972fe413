r"""Canonical JSON and tagged SHA-256: the identity of everything in an archive.

The canonical form is UTF-8 JSON with sorted keys, no white space, no NaN or infinity, floats in
Python's shortest round-trip form with ``-0.0`` written as ``0.0``. A digest is taken over
``turnscan:<tag>\\n`` followed by that form, so that a calibration part and a recipe with the same
fields never share an id.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from .errors import DocumentError


def _plain(value: Any, where: str) -> Any:
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise DocumentError(
                f"{where or 'value'} is {value}, which has no canonical form",
                hint="replace it by a finite number",
            )
        return 0.0 if value == 0.0 else float(value)
    if isinstance(value, Mapping):
        out = {}
        for key, item in value.items():
            if not isinstance(key, str):
                raise DocumentError(f"{where or 'value'} has the key {key!r}; keys must be text")
            out[key] = _plain(item, f"{where}.{key}" if where else key)
        return out
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise DocumentError(f"{where or 'value'} is a {type(value).__name__}, which JSON cannot hold")


def canonical_json(value: Any) -> bytes:
    """Canonical UTF-8 bytes of a JSON value.

    Raises
    ------
    DocumentError
        For NaN, infinity, keys that are not text, and types that JSON does not have.
    """
    plain = _plain(value, "")
    return json.dumps(
        plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    ).encode()


def digest(tag: str, value: Any) -> str:
    """SHA-256 (64 hex digits) of ``value`` in canonical form, under ``tag``."""
    sha = hashlib.sha256(f"turnscan:{tag}\n".encode())
    sha.update(canonical_json(value))
    return sha.hexdigest()
