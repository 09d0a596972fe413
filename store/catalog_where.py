"""``where``: SQL that a user writes over the scans, run so that it can only read."""

from __future__ import annotations

import sqlite3
from typing import Any

from ..schemas.errors import UsageError

_ALLOWED = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION}


def select_scans(c: sqlite3.Connection, *, where: str | None, retired: bool) -> list[dict[str, Any]]:
    """Rows of the table scans, oldest first, that ``where`` selects.

    ``where`` may use every column of the table and ``tags ->> 'name'``.

    Raises
    ------
    UsageError
        SQLite does not take ``where``.
    """
    hide = "" if retired else "retired = 0"
    text = " AND ".join(f"({part})" for part in (hide, where) if part) or "1"

    def judge(action: int, *_: Any) -> int:
        return sqlite3.SQLITE_OK if action in _ALLOWED else sqlite3.SQLITE_DENY

    c.set_authorizer(judge)
    try:
        return [dict(r) for r in c.execute(f"SELECT * FROM scans WHERE {text} ORDER BY scan")]
    except (sqlite3.Error, sqlite3.Warning) as error:
        columns = "scan rig label tags started_ns frames angle_min_rad angle_max_rad calibration"
        raise UsageError(
            f"--where {where!r}: {error}", hint=f"it is SQL over the scans, such as: {columns}"
        ) from error
    finally:
        c.set_authorizer(None)
