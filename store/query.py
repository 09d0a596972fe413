"""SQL over the archive: scans, calibrations, events, references, derivations, stripes, points.

``stripes`` and ``points`` hold the rows of every derivation in the catalogue, of all recipes and
calibrations; the columns recipe_name, recipe, calibration and key tell them apart.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

from ..schemas.errors import UsageError
from .archive import Archive
from .frames import lazy_table

if TYPE_CHECKING:
    import polars as pl

TABLES = ("scans", "calibrations", "events", "references", "derivations", "stripes", "points")
_READING = re.compile(r"^\s*(select|with|show|explain)\b", re.IGNORECASE)
_CATALOG = {
    "scans": "SELECT scan, rig, label, tags, retired, source, started_ns, ended_ns, ended, frames, "
    "background_frames, lasers, width_px, height_px, encoding, angle_min_rad, angle_max_rad, "
    "calibration, content_sha256, frames_sha256, log_bytes FROM scans ORDER BY scan",
    "calibrations": "SELECT calibration, rig, note, sha256, document FROM calibrations ORDER BY 1",
    "events": "SELECT event, kind, t_ns, document FROM events ORDER BY event",
    "references": "SELECT event, t_ns, document FROM events WHERE kind = 'referenced' ORDER BY event",
    "derivations": "SELECT key, kind, scan, recipe, recipe_name, calibration, rows, bytes, sha256, "
    "path, frames, frames_without_stripe, created_ns FROM derivations ORDER BY key",
}
_INTEGERS = {
    *("started_ns", "ended_ns", "frames", "background_frames", "width_px", "height_px"),
    *("log_bytes", "t_ns", "rows", "bytes", "frames_without_stripe", "created_ns"),
}


def run_query(archive: Archive, sql: str) -> pl.DataFrame:
    """The rows that ``sql`` asks for; only the tables that it names are opened.

    Raises
    ------
    UsageError
        It is no reading statement, or polars does not take it.
    DamageError
        A table's file is missing or cut off.
    """
    import polars as pl

    if not _READING.match(sql):
        raise UsageError(
            "only SELECT, WITH, SHOW and EXPLAIN are taken", hint="nothing in an archive is edited"
        )
    context = pl.SQLContext()
    for name in TABLES:
        if re.search(rf"\b{name}\b", sql, re.IGNORECASE):
            context.register(name, _table(archive, name))
    try:
        return context.execute(sql, eager=True)
    except (pl.exceptions.PolarsError, pl.exceptions.SQLInterfaceError) as error:
        raise UsageError(
            f"the query failed: {str(error).splitlines()[0]}",
            hint=f"tables: {', '.join(TABLES)}; columns: SELECT * FROM points LIMIT 1",
        ) from error


def _table(archive: Archive, name: str) -> Any:
    import polars as pl

    if name in ("stripes", "points"):
        made = [m for m in archive.derivations() if m.kind == name]
        return lazy_table(archive.store, name, made)
    rows = archive.catalog.rows(_CATALOG[name])
    columns = re.split(r",\s*", _CATALOG[name][len("SELECT ") :].split(" FROM ")[0])
    kinds = {c: _kind(c) for c in columns}
    for row in rows:
        if "retired" in row:
            row["retired"] = bool(row["retired"])
    frame = pl.DataFrame(rows, schema=kinds, orient="row")
    if name == "references":
        values = [json.loads(r["document"]) for r in rows]
        frame = frame.with_columns(
            pl.Series("scan", [v["scan"] for v in values], dtype=pl.String),
            pl.Series("value", [json.dumps(v["value"]) for v in values], dtype=pl.String),
        ).drop("document")
    return frame.lazy()


def _kind(column: str) -> Any:
    import polars as pl

    if column in _INTEGERS:
        return pl.Int64
    if column.endswith("_rad"):
        return pl.Float64
    return pl.Boolean if column == "retired" else pl.String
