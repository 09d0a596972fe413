"""Names of scans, events and archives: ULIDs, sortable by time, with a letter prefix for scans."""

from __future__ import annotations


def new_ulid(t_ns: int | None = None) -> str:
    """A new ULID (26 characters) of the present time, or of ``t_ns`` (UTC epoch)."""
    from ulid import ULID

    if t_ns is None:
        return str(ULID())
    return str(ULID.from_timestamp(t_ns / 1e9))


def new_scan_id() -> str:
    """A new scan id: ``s-`` and a ULID."""
    return f"s-{new_ulid()}"
