"""From the archive's files to the catalogue's rows, all at once or just what is new."""

from __future__ import annotations

import json
import sqlite3
from typing import Any

from ..schemas.archive_events import AnyArchiveEvent, parse_archive_event
from ..schemas.calibration import Calibration, parse_calibration
from ..schemas.canonical import canonical_json
from ..schemas.document import Model, check_version, parse_json, validate
from ..schemas.errors import DamageError
from ..schemas.manifests import DerivationManifest, ScanSummary
from . import layout
from .bytes import LocalFolder
from .catalog import Catalog, Row, put, remove
from .fold import scan_states


def read_summary(store: LocalFolder, scan: str) -> ScanSummary:
    """scan.json of ``scan``, checked against the name of its folder."""
    path = layout.scan_file(scan, layout.SUMMARY)
    where = str(store.local(path))
    value = parse_json(store.get(path), where=where)
    check_version(value, name="turnscan.scan", version=1, where=where)
    summary = validate(ScanSummary, value, where=where)
    if summary.scan != scan:
        raise DamageError(f"{where}: says scan {summary.scan}, its folder says {scan}")
    return summary


def read_calibration(store: LocalFolder, calibration: str) -> Calibration:
    """A calibration document, checked against its content id."""
    path = layout.calibration_file(calibration)
    where = str(store.local(path))
    document = parse_calibration(store.get(path), where=where)
    if document.calibration_id() != calibration:
        raise DamageError(
            f"{where}: its content is {document.calibration_id()}: the file was changed",
            hint="restore it from a copy; calibrations are never edited, add a new one instead",
        )
    return document


def read_event(store: LocalFolder, event: str) -> AnyArchiveEvent:
    """An archive event, checked against the name of its file."""
    path = layout.event_file(event)
    where = str(store.local(path))
    parsed = parse_archive_event(store.get(path), where=where)
    if parsed.id != event:
        raise DamageError(f"{where}: says event {parsed.id}")
    return parsed.check_sealed(where=where)


def read_manifest(store: LocalFolder, path: str) -> DerivationManifest:
    """A derivation's manifest, checked against where it lies."""
    where = str(store.local(path))
    value = parse_json(store.get(path), where=where)
    check_version(value, name="turnscan.derivation", version=1, where=where)
    manifest = validate(DerivationManifest, value, where=where)
    if manifest.path != path.removesuffix(".json") + ".parquet":
        raise DamageError(f"{where}: says its table is {manifest.path}")
    return manifest.check_sealed(where=where)


def sealed_scans(store: LocalFolder) -> list[str]:
    """Scans whose manifest is there."""
    return [
        s
        for s in store.list(layout.SCANS)
        if store.head(layout.scan_file(s, layout.MANIFEST)) is not None
    ]


def manifests_of_derivations(store: LocalFolder) -> list[str]:
    """Paths of every derivation manifest in the archive."""
    root = store.local(layout.DERIVED)
    return sorted(str(p.relative_to(store.root)) for p in root.rglob("k-*.json"))


_SCAN_COLUMNS = (
    *("scan", "rig", "label", "tags", "source", "started_ns", "ended_ns", "ended", "frames"),
    *("background_frames", "cameras", "lasers", "width_px", "height_px", "encoding"),
    *("angle_min_rad", "angle_max_rad", "calibration", "content_sha256", "frames_sha256", "log_bytes"),
    "continues",
)
_DERIVATION_COLUMNS = (
    *("key", "kind", "scan", "recipe", "calibration", "rows", "bytes", "sha256", "path", "frames"),
    *("frames_without_stripe", "created_ns"),
)


def scan_row(summary: ScanSummary) -> Row:
    """The catalogue's row of a scan; label, tags and retired follow from :func:`refold`."""
    row: Row = {name: getattr(summary, name) for name in _SCAN_COLUMNS}
    return row | {"retired": 0, "document": _text(summary)}


def event_row(event: AnyArchiveEvent) -> Row:
    """The catalogue's row of an archive event."""
    return {
        "event": event.id,
        "kind": event.kind,
        "t_ns": event.t_ns,
        "document": _text(event),
    }


def derivation_row(manifest: DerivationManifest) -> Row:
    """The catalogue's row of a derivation."""
    row: Row = {name: getattr(manifest, name) for name in _DERIVATION_COLUMNS}
    name = manifest.recipe_document.get("name", "")
    return row | {"recipe_name": name, "document": _text(manifest)}


def _text(document: Model) -> str:
    """One text for equal documents, whether they were just made or read back."""
    return canonical_json(document.plain()).decode()


def put_calibration(c: sqlite3.Connection, document: Calibration) -> None:
    """The rows of a calibration and its parts."""
    name = document.calibration_id()
    row = {
        "calibration": name,
        "rig": document.rig,
        "note": document.note,
        "verdict": document.verdict,
        "sha256": document.sha256(),
        "document": _text(document),
    }
    put(c, "calibrations", row)
    for role, part in document.part_ids().items():
        put(c, "calibration_parts", {"calibration": name, "role": role, "part": part})


def refold(c: sqlite3.Connection, scan: str | None = None) -> None:
    """Set label, tags and retired of every scan, or of one, from its summary and the events.

    With one scan, nothing is looked at but that scan: an archive of thousands grows no slower.
    """
    if (
        scan is not None
        and not c.execute("SELECT 1 FROM events WHERE instr(document, ?) LIMIT 1", (scan,)).fetchone()
    ):
        return  # Its row was written from its summary, and no event says anything else.
    events = [
        parse_archive_event(r["document"].encode(), where=f"event {r['event']}")
        for r in c.execute("SELECT event, document FROM events")
    ]
    recorded: dict[str, tuple[str, dict[str, str]]] = {}
    for r in c.execute("SELECT scan, document FROM scans WHERE ? IN ('', scan)", (scan or "",)):
        value: dict[str, Any] = parse_json(r["document"], where=r["scan"])
        recorded[r["scan"]] = (value.get("label", ""), value.get("tags", {}))
    for name, state in scan_states(events, recorded).items():
        tags = json.dumps(state.tags, sort_keys=True, ensure_ascii=False)
        c.execute(
            "UPDATE scans SET label = ?, tags = ?, retired = ? WHERE scan = ?",
            (state.label, tags, int(state.retired), name),
        )


def rebuild(store: LocalFolder, catalog: Catalog) -> None:
    """Make the whole catalogue again from the files, aside, and put it in the old one's place."""
    with store.staged(".sqlite") as aside, catalog.replacing(aside) as c:
        for scan in sealed_scans(store):
            put(c, "scans", scan_row(read_summary(store, scan)))
        for name in _documents(store, layout.CALIBRATIONS):
            put_calibration(c, read_calibration(store, name))
        for name in _documents(store, layout.EVENTS):
            put(c, "events", event_row(read_event(store, name)))
        for path in manifests_of_derivations(store):
            put(c, "derivations", derivation_row(read_manifest(store, path)))
        refold(c)


def _documents(store: LocalFolder, folder: str) -> list[str]:
    return [n.removesuffix(".json") for n in store.list(folder) if n.endswith(".json")]


def synchronise(store: LocalFolder, catalog: Catalog) -> None:
    """Bring the catalogue up to what lies in the folders, touching it only if something differs."""
    known = catalog.ask(
        lambda c: {
            table: {r[0] for r in c.execute(f"SELECT {column} FROM {table}")}
            for table, column in _KEYS.items()
        }
    )
    here = {
        # The manifest of a scan that is already known need not be looked for again.
        "scans": {
            s
            for s in store.list(layout.SCANS)
            if s in known["scans"] or store.head(layout.scan_file(s, layout.MANIFEST)) is not None
        },
        "calibrations": set(_documents(store, layout.CALIBRATIONS)),
        "events": set(_documents(store, layout.EVENTS)),
    }
    if here == known:
        return

    def enter(c: sqlite3.Connection) -> None:
        for table, column in _KEYS.items():
            remove(c, table, column, known[table] - here[table])
        remove(c, "calibration_parts", "calibration", known["calibrations"] - here["calibrations"])
        for scan in sorted(here["scans"] - known["scans"]):
            put(c, "scans", scan_row(read_summary(store, scan)))
        for name in sorted(here["calibrations"] - known["calibrations"]):
            put_calibration(c, read_calibration(store, name))
        for name in sorted(here["events"] - known["events"]):
            put(c, "events", event_row(read_event(store, name)))
        refold(c)

    catalog.enter(enter)


_KEYS = {"scans": "scan", "calibrations": "calibration", "events": "event"}
