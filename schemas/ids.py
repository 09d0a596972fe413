"""Names of scans, events and archives: ULIDs, sortable by time, with a letter prefix for scans."""

from __future__ import annotations

import re

from .errors import DocumentError

_ULID = re.compile(r"^[0-7][0-9A-HJKMNP-TV-Z]{25}$")


def new_ulid(t_ns: int | None = None) -> str:
    """A new ULID (26 characters) of the present time, or of ``t_ns`` (UTC epoch)."""
    from ulid import ULID

    if t_ns is None:
        return str(ULID())
    return str(ULID.from_timestamp(t_ns / 1e9))


def new_scan_id() -> str:
    """A new scan id: ``s-`` and a ULID."""
    return f"s-{new_ulid()}"


def check_scan_id(text: str) -> str:
    """``text`` if it is a whole scan id; DocumentError otherwise."""
    if not (text.startswith("s-") and _ULID.match(text[2:])):
        raise DocumentError(f"{text!r} is not a scan id (s- and 26 characters)")
    return text


def is_ulid(text: str) -> bool:
    """Whether ``text`` is a ULID in canonical upper case."""
    return bool(_ULID.match(text))
