"""SQL over the archive: scans, calibrations, events, references, derivations, stripes, points.

``stripes`` and ``points`` hold the rows of every derivation in the catalogue, of all recipes and
calibrations; the columns recipe_name, recipe, calibration and key tell them apart.
"""

from __future__ import annotations

import json
import re
from itertools import chain
from typing import TYPE_CHECKING, Any

from ..schemas.errors import UsageError
from ..schemas.manifests import DerivationManifest
from ..schemas.tables import TABLES as TABLE_SPECS
from .archive import Archive
from .derivations import damaged_table
from .drafts import file_sha256
from .frames import lazy_table

if TYPE_CHECKING:
    import polars as pl

TABLES = ("scans", "calibrations", "events", "references", "derivations", "stripes", "points")
_TABULAR = ("stripes", "points")
_READING = re.compile(r"[\s(]*(select|with|show|explain)\b", re.IGNORECASE)
#: What does not name a table: literals and comments.
_ASIDE = re.compile(r"'(?:[^']|'')*'|--[^\n]*|/\*.*?\*/", re.DOTALL)
_CATALOG = {
    "scans": "SELECT scan, rig, label, tags, retired, source, started_ns, ended_ns, ended, frames, "
    "background_frames, lasers, width_px, height_px, encoding, angle_min_rad, angle_max_rad, "
    "calibration, content_sha256, frames_sha256, log_bytes, continues FROM scans ORDER BY scan",
    "calibrations": "SELECT calibration, rig, note, verdict, sha256, document "
    "FROM calibrations ORDER BY calibration",
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
        A table's file is missing, cut off, or cannot be read. Page checksums are not compared
        here (polars never does): ``turnscan verify`` does that.
    """
    import polars as pl

    text = _ASIDE.sub(lambda m: "''" if m.group().startswith("'") else " ", sql)
    if not _READING.match(text):
        raise UsageError(
            "only SELECT, WITH, SHOW and EXPLAIN are taken", hint="nothing in an archive is edited"
        )
    showing = text.split(None, 1)[0].lower() == "show"
    named = [n for n in TABLES if re.search(rf"\b{n}\b", text, re.IGNORECASE)]
    everything = archive.derivations() if set(named) & set(_TABULAR) else []
    made = {n: [m for m in everything if m.kind == n and n in named] for n in _TABULAR}
    context = pl.SQLContext()
    for name in TABLES if showing else named:
        context.register(name, _table(archive, name, made))
    # Failures in the midst of reading; others are found in the SQL or the columns, before that.
    midway = (pl.exceptions.ComputeError, pl.exceptions.PanicException, OSError)
    try:
        return context.execute(sql, eager=True)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        for manifest in chain.from_iterable(made.values()):
            _refuse_damage(archive, manifest, whole=isinstance(error, midway))
        if isinstance(error, pl.exceptions.PanicException):
            raise
        raise UsageError(
            f"the query failed: {str(error).splitlines()[0]}",
            hint=f"tables: {', '.join(TABLES)}; columns: SELECT * FROM points LIMIT 1",
        ) from error


def _refuse_damage(archive: Archive, manifest: DerivationManifest, *, whole: bool) -> None:
    """Raise a DamageError if the columns of a table, or (``whole``) its bytes, are not as written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = archive.store.local(manifest.path)
    try:
        if whole and file_sha256(path) != manifest.sha256:
            raise damaged_table(path, "its SHA-256 is not the one in its manifest")
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise damaged_table(path, str(error)) from error
    if not schema.equals(TABLE_SPECS[manifest.kind].arrow_schema()):
        raise damaged_table(path, "its columns are not those of the table")


def _table(archive: Archive, name: str, made: dict[str, list[DerivationManifest]]) -> Any:
    import polars as pl

    if name in _TABULAR:
        return _wide_integers(lazy_table(archive.store, name, made[name]))
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


def _wide_integers(frame: pl.LazyFrame) -> pl.LazyFrame:
    """``frame`` with 64-bit integers: in those of the files ``row - 500`` would wrap around."""
    import polars as pl
    import polars.selectors as cs

    return frame.with_columns(cs.integer().cast(pl.Int64))
