"""Put an archive right without losing anything: salvage, move aside, rebuild. Nothing is deleted but
staging files and locks of processes that are gone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..schemas.errors import ConflictError, TurnscanError
from ..schemas.events import CalibrationSnapshot
from ..schemas.manifests import ScanSummary
from . import layout
from .bytes import STAGING, LocalFolder
from .drafts import DraftLock
from .log_reader import snapshot_calibration
from .projection import manifests_of_derivations, read_manifest
from .salvage import Salvage, salvage_log
from .verify import stray_tables, table_damage

if TYPE_CHECKING:
    from .archive import Archive

#: Where damaged derivations go: never globbed, never read, for the user to look at.
QUARANTINE = "quarantine"


@dataclass(frozen=True)
class Repair:
    """One thing that was done, or would be."""

    path: str
    did: str


def repair(archive: Archive, *, dry_run: bool = False) -> list[Repair]:
    """Salvage unfinished scans, move damaged tables aside, clear dead staging, rebuild the catalogue.

    Sealed scans, calibrations and events are never touched: damage there needs a copy.
    """
    done = _salvage_parts(archive, dry_run=dry_run)
    done += _restore_calibrations(archive, dry_run=dry_run)
    with archive.store.holding(alone=True):
        done += _move_aside(archive.store, dry_run=dry_run)
    done += _clear_staging(archive.store, dry_run=dry_run)
    if not dry_run:
        archive.rebuild_catalog()
    return [*done, Repair(layout.CATALOG, "rebuild" if dry_run else "rebuilt")]


def _salvage_parts(archive: Archive, *, dry_run: bool) -> list[Repair]:
    out = []
    store = archive.store
    for scan in store.list(layout.SCANS):
        folder = f"{layout.SCANS}/{scan}"
        names = store.list(folder)
        if layout.MANIFEST in names or layout.SALVAGED in names:
            continue
        part = layout.PART if layout.PART in names else layout.LOG if layout.LOG in names else None
        try:
            lock = DraftLock(store, scan)
        except ConflictError:
            out.append(Repair(folder, "left alone: it is being written"))
            continue
        try:
            if part is None:
                out.append(Repair(folder, "holds no log" if names else "is empty"))
                continue
            path = f"{folder}/{part}"
            if dry_run:
                out.append(Repair(path, "salvage into a new scan"))
                continue
            out.append(_salvage(archive, path, scan))
        finally:
            lock.release()
    return out


def _salvage(archive: Archive, path: str, scan: str) -> Repair:
    try:
        summary, saved = salvage_scan(archive, path, scan)
    except TurnscanError as error:
        return Repair(path, f"cannot be salvaged: {error}")
    return Repair(path, f"salvaged {saved.frames} frames into {summary.scan}; lost: {_losses(saved)}")


def salvage_scan(archive: Archive, path: str, scan: str) -> tuple[ScanSummary, Salvage]:
    """Make a new scan of all that is whole in the unsealed log ``path`` of ``scan``.

    The caller holds the scan's :class:`DraftLock`.

    Raises
    ------
    TurnscanError
        Nothing can be saved; the file is as it was.
    """
    store = archive.store
    with archive.new_scan() as draft:
        saved = salvage_log(store.local(path), draft.part, scan=draft.scan, salvaged_from=scan)
        summary = archive.seal(draft, draft.examine())
    # The old file is kept as it is; this note keeps a second repair from salvaging it again.
    note = f"salvaged into {summary.scan}; lost: {_losses(saved)}\n"
    store.put_if_absent(layout.scan_file(scan, layout.SALVAGED), note.encode())
    return summary, saved


def _losses(saved: Salvage) -> str:
    return "; ".join(saved.lost) or "nothing but its end"


def _restore_calibrations(archive: Archive, *, dry_run: bool) -> list[Repair]:
    """Calibrations that scans name and that are gone come back from the logs' own snapshots."""
    out = []
    here = set(archive.store.list(layout.CALIBRATIONS))
    for scan in archive.scans():
        if scan.calibration is None or f"{scan.calibration}.json" in here:
            continue
        path = layout.calibration_file(scan.calibration)
        for item in archive.log(scan.scan).items() if not dry_run else ():
            if isinstance(item, CalibrationSnapshot):
                archive.add_calibration(snapshot_calibration(item, where=scan.scan))
        out.append(Repair(path, f"{'restore' if dry_run else 'restored'} from the log of {scan.scan}"))
        here.add(f"{scan.calibration}.json")
    return out


def _move_aside(store: LocalFolder, *, dry_run: bool) -> list[Repair]:
    bad: dict[str, str] = {}
    for path in manifests_of_derivations(store):
        try:
            damage = table_damage(store, read_manifest(store, path))
        except TurnscanError as error:
            damage = [str(error)]
        if damage:
            table = path.removesuffix(".json") + ".parquet"
            for name in (path, table):
                if store.head(name) is not None:
                    bad[name] = damage[0]
    for path in stray_tables(store):
        bad.setdefault(path, "it has no manifest")
    out = []
    for path, why in bad.items():
        out.append(Repair(path, f"{'move' if dry_run else 'moved'} to {QUARANTINE}: {why}"))
        if not dry_run:
            target = store.local(f"{QUARANTINE}/{path}")
            target.parent.mkdir(parents=True, exist_ok=True)
            n = 0
            while target.exists():
                n += 1
                target = target.with_name(f"{target.name}.{n}")
            store.local(path).rename(target)
    return out


def _clear_staging(store: LocalFolder, *, dry_run: bool) -> list[Repair]:
    out = []
    for name in store.list(STAGING):
        if name.endswith(".lock"):
            out += _clear_lock(store, name, dry_run=dry_run)
            continue
        owner = name.split("-", 1)[0]
        if not owner.isdigit() or _alive(int(owner)):
            continue
        out.append(Repair(f"{STAGING}/{name}", "delete" if dry_run else "deleted"))
        if not dry_run:
            store.delete(f"{STAGING}/{name}")
    return out


def _clear_lock(store: LocalFolder, name: str, *, dry_run: bool) -> list[Repair]:
    """A lock that can be taken belongs to nobody."""
    try:
        lock = DraftLock(store, name.removesuffix(".lock"))
    except ConflictError:
        return []
    if dry_run:
        lock.keep()
    else:
        lock.release()
    return [Repair(f"{STAGING}/{name}", "delete" if dry_run else "deleted")]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
