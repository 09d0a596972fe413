"""Fixity: is every byte of an archive what was written?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from ..schemas.document import dump_json
from ..schemas.errors import TurnscanError
from ..schemas.manifests import DerivationManifest, ScanSummary
from . import layout
from .bytes import LocalFolder
from .catalog import CatalogError
from .derivations import read_batches
from .drafts import file_sha256, summary_of
from .log_digest import digest_log
from .log_reader import ScanLog
from .projection import (
    manifests_of_derivations,
    read_calibration,
    read_event,
    read_manifest,
    read_summary,
)

if TYPE_CHECKING:
    from .archive import Archive

Advance = Callable[[int, int], None]


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it should be: where, what, and the way out."""

    path: str
    what: str
    hint: str


def verify(archive: Archive, advance: Advance | None = None) -> list[Finding]:
    """Read everything and list what is damaged, missing or unknown; an empty list is good news.

    Checked: every digest of every scan manifest, every CRC of every log and that scan.json is true of
    it, calibrations against their ids, events, every derivation's manifest, digest, page checksums,
    columns and number of rows, files that nothing names, and that the catalogue is a true projection.
    """
    store = archive.store
    tasks: list[Callable[[], list[Finding]]] = [
        *(partial(_scan, store, scan) for scan in store.list(layout.SCANS)),
        *(
            partial(_document, store, folder, name)
            for folder in (layout.CALIBRATIONS, layout.EVENTS)
            for name in store.list(folder)
        ),
        *(partial(_derivation, store, path) for path in manifests_of_derivations(store)),
        partial(_references, archive),
        partial(_strays, store),
        partial(_catalog, archive),
    ]
    findings = []
    for i, task in enumerate(tasks):
        findings += task()
        if advance is not None:
            advance(i + 1, len(tasks))
    return findings


def _scan(store: LocalFolder, scan: str) -> list[Finding]:
    manifest_path = layout.scan_file(scan, layout.MANIFEST)
    if store.head(manifest_path) is None:
        if store.head(layout.scan_file(scan, layout.SALVAGED)) is not None:
            return []  # Kept for what it is; the scan that it was salvaged into is checked itself.
        return [
            Finding(
                f"{layout.SCANS}/{scan}",
                "is not sealed: it has no manifest",
                "turnscan repair salvages it, unless it is being recorded",
            )
        ]
    out = []
    restore = "restore it from a copy; what is derived from it can be trusted no more"
    try:
        lines = store.get(manifest_path).decode().splitlines()
        pairs = [line.split("  ", 1) for line in lines]
        listed = {name: sha256 for sha256, name in pairs}
    except (UnicodeDecodeError, ValueError):
        return [Finding(manifest_path, "is no list of digests", restore)]
    for name in (layout.LOG, layout.SUMMARY):
        if name not in listed:
            out.append(Finding(manifest_path, f"does not list {name}", restore))
    for name, sha256 in listed.items():
        path = store.local(layout.scan_file(scan, name))
        if not path.is_file():
            out.append(Finding(layout.scan_file(scan, name), "is missing", restore))
        elif file_sha256(path) != sha256:
            out.append(Finding(layout.scan_file(scan, name), "its SHA-256 differs", restore))
    unknown = set(store.list(f"{layout.SCANS}/{scan}")) - {*listed, layout.MANIFEST, layout.PART}
    for name in sorted(unknown):
        out.append(Finding(layout.scan_file(scan, name), "nothing names this file", "look at it"))
    return out + _log(store, scan, restore)


def _log(store: LocalFolder, scan: str, restore: str) -> list[Finding]:
    path = layout.scan_file(scan, layout.LOG)
    if store.head(path) is None:
        return []
    try:
        facts = digest_log(ScanLog(store.local(path)))
        summary = read_summary(store, scan)
    except TurnscanError as error:
        return [Finding(path, str(error), error.hint or restore)]
    truth: ScanSummary = summary_of(facts, store.local(path), scan=scan)
    # The log of a copied scan names its own id; everything else must be as the summary says.
    if dump_json(truth.plain()) != dump_json(summary.plain()):
        differing = [k for k in ScanSummary.model_fields if getattr(truth, k) != getattr(summary, k)]
        where = layout.scan_file(scan, layout.SUMMARY)
        return [Finding(where, f"is not true of the log: {', '.join(differing)}", restore)]
    return []


def _document(store: LocalFolder, folder: str, name: str) -> list[Finding]:
    path = f"{folder}/{name}"
    if not name.endswith(".json"):
        return [Finding(path, "nothing names this file", "look at it")]
    try:
        if folder == layout.CALIBRATIONS:
            read_calibration(store, name.removesuffix(".json"))
        else:
            read_event(store, name.removesuffix(".json"))
    except TurnscanError as error:
        return [Finding(path, str(error), error.hint or "restore it from a copy")]
    return []


def _derivation(store: LocalFolder, manifest_path: str) -> list[Finding]:
    again = "turnscan repair moves it aside, turnscan process derives it again"
    try:
        manifest = read_manifest(store, manifest_path)
    except TurnscanError as error:
        return [Finding(manifest_path, str(error), again)]
    return [Finding(manifest.path, what, again) for what in table_damage(store, manifest)]


def table_damage(store: LocalFolder, manifest: DerivationManifest) -> list[str]:
    """What is wrong with a derived table; nothing, as a rule."""
    path = store.local(manifest.path)
    if not path.is_file():
        return ["is missing"]
    out = []
    if file_sha256(path) != manifest.sha256:
        out.append("its SHA-256 differs")
    try:
        rows = sum(batch.num_rows for batch in read_batches(store, manifest))
        if rows != manifest.rows:
            out.append(f"holds {rows} rows, its manifest says {manifest.rows}")
    except TurnscanError as error:
        out.append(str(error))
    return out


def stray_tables(store: LocalFolder) -> list[str]:
    """Tables without a manifest: debris of a process that was killed, or files from elsewhere."""
    root = store.local(layout.DERIVED)
    return sorted(
        str(p.relative_to(store.root))
        for p in root.rglob("*")
        if p.is_file()
        and not (p.suffix == ".json" and p.name.startswith("k-"))
        and not (p.suffix == ".parquet" and p.with_suffix(".json").is_file())
    )


def _references(archive: Archive) -> list[Finding]:
    """Calibrations that a scan, a certification or a table names must be there."""
    store = archive.store
    here = set(store.list(layout.CALIBRATIONS))
    named = {s.calibration: f"scan {s.scan}" for s in archive.scans()}
    named |= {e.calibration: f"event {e.id}" for e in archive.certifications()}
    named |= {m.calibration: m.path for m in archive.derivations()}
    hint = "turnscan repair takes it from a log that recorded it; else restore it from a copy"
    return [
        Finding(layout.calibration_file(c), f"is missing, but {who} names it", hint)
        for c, who in sorted((c, who) for c, who in named.items() if c is not None)
        if f"{c}.json" not in here
    ]


def _strays(store: LocalFolder) -> list[Finding]:
    hint = "turnscan repair moves it aside"
    return [Finding(p, "a table without a manifest", hint) for p in stray_tables(store)]


def _catalog(archive: Archive) -> list[Finding]:
    """Compare the catalogue with one that is made from nothing."""
    from .catalog import Catalog
    from .projection import rebuild

    hint = "turnscan repair makes the catalogue again"
    try:
        present = archive.catalog.dump()
    except CatalogError as error:
        return [Finding(layout.CATALOG, str(error), hint)]
    with archive.store.staged(".sqlite") as aside:
        fresh = Catalog(aside)
        try:
            rebuild(archive.store, fresh)
        except TurnscanError:
            return []  # What cannot be projected is listed already, under its own name.
        expected = fresh.dump()
    differing = [name for name, rows in expected.items() if rows != present[name]]
    # Another process may have published between the two looks: what stays is a difference.
    again = archive.catalog.dump() if differing else present
    differing = [name for name in differing if again[name] != expected[name]]
    if differing:
        return [Finding(layout.CATALOG, f"differs from the files: {', '.join(differing)}", hint)]
    return []
