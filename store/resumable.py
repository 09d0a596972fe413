"""Which scan a recording takes up again: a sealed one, or one that was never sealed, salvaged first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..schemas.errors import DamageError, InputError, NotFoundError, StorageError, TurnscanError
from . import layout
from .drafts import DraftLock
from .log_reader import ScanLog
from .repair import salvage_scan

if TYPE_CHECKING:
    from ..schemas.events import ScanStart
    from ..schemas.manifests import ScanSummary
    from .archive import Archive


def scan_to_resume(archive: Archive, word: str) -> list[ScanSummary]:
    """The logs of the scan that ``word`` names, oldest first; a log that was cut off is salvaged.

    ``word`` is what :meth:`Archive.scan` takes, or the id (or a prefix) of an unsealed scan; ``latest``
    counts those, too.

    Raises
    ------
    NotFoundError
        There is no such scan.
    InputError
        It was cut off before its first frame: nothing of it can be taken up.
    ConflictError
        It is being recorded just now.
    """
    unsealed = _unsealed(archive, word)
    if unsealed is None:
        return archive.chain(archive.scan(word).scan)
    known = [s for s in archive.scans() if s.salvaged_from == unsealed]
    if known:
        return archive.chain(known[-1].scan)
    lock = DraftLock(archive.store, unsealed)
    try:
        names = archive.store.list(f"{layout.SCANS}/{unsealed}")
        name = next((n for n in (layout.PART, layout.LOG) if n in names), None)
        summary = _salvaged(archive, unsealed, name)
    finally:
        lock.release()
    return archive.chain(summary.scan)


def _salvaged(archive: Archive, scan: str, name: str | None) -> ScanSummary:
    why: TurnscanError | str = "it holds no log"
    if name is not None:
        try:
            return salvage_scan(archive, layout.scan_file(scan, name), scan)[0]
        except (InputError, DamageError) as error:
            why = error
    # It stays as it is; the note says that nobody need look at it again.
    note = f"salvaged into nothing: {why}\n"
    archive.store.put_if_absent(layout.scan_file(scan, layout.SALVAGED), note.encode())
    raise InputError(
        f"scan {scan} was cut off before its first frame", hint="record it from the beginning"
    )


def begun(archive: Archive, word: str) -> ScanStart | None:
    """The start event of the unsealed scan that ``word`` means, if that much of it was written."""
    unsealed = _unsealed(archive, word)
    if unsealed is None:
        return None
    try:
        return ScanLog(archive.store.local(layout.scan_file(unsealed, layout.PART))).start()
    except (DamageError, StorageError):
        return None


def _unsealed(archive: Archive, word: str) -> str | None:
    """The id of the unsealed scan that ``word`` means, if it means one."""
    store = archive.store
    here = [
        s for s in store.list(layout.SCANS) if store.head(layout.scan_file(s, layout.MANIFEST)) is None
    ]
    if word == "latest":
        sealed = [r["scan"] for r in archive.scan_rows()]
        waiting = [s for s in here if store.head(layout.scan_file(s, layout.SALVAGED)) is None]
        newest = max(waiting, default="")
        return newest if newest > max(sealed, default="") else None
    found = [s for s in here if word and s.startswith((word, f"s-{word.upper()}"))]
    try:
        archive.scan(word)
    except NotFoundError:
        if len(found) > 1:
            raise NotFoundError(
                f"{word!r} fits {len(found)} unsealed scans", hint="give more of the id"
            ) from None
        return found[0] if found else None
    return word if word in found else None
