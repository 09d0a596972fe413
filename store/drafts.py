"""A scan while it is written, and the sealing that makes it one for good."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from ..schemas.document import dump_json
from ..schemas.errors import ConflictError
from ..schemas.ids import new_scan_id
from ..schemas.manifests import ScanSummary
from . import layout
from .bytes import STAGING, LocalFolder, fsync_file, fsync_folder, storage_error
from .log_digest import LogFacts, digest_log
from .log_reader import ScanLog


class DraftLock:
    """Held by the process that writes a scan, so that nobody salvages under its hands.

    The kernel lets go of it when the process ends, however it ends.
    """

    def __init__(self, store: LocalFolder, scan: str) -> None:
        folder = store.local(STAGING)
        folder.mkdir(exist_ok=True)
        self._path = folder / f"{scan}.lock"
        self._handle = os.open(self._path, os.O_CREAT | os.O_RDWR, 0o644)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._handle)
            raise ConflictError(
                f"scan {scan} is being written by another process",
                hint="wait until it is done, or stop that process",
            ) from error

    def keep(self) -> None:
        """Let go, and leave the lock's file."""
        os.close(self._handle)

    def release(self) -> None:
        """Let go and remove the lock's file."""
        self._path.unlink(missing_ok=True)
        os.close(self._handle)


class ScanDraft:
    """A new scan's folder and the log in it, not official yet.

    Use as a context manager: a draft that is left by an exception before its log was finished keeps
    its ``.part`` only if :attr:`keep_part` says so (a recording), and vanishes otherwise (an import).
    """

    def __init__(self, store: LocalFolder, *, keep_part: bool = False) -> None:
        self._store = store
        self.scan = new_scan_id()
        self.keep_part = keep_part
        try:
            self._lock = DraftLock(store, self.scan)
            self._folder = store.local(f"{layout.SCANS}/{self.scan}")
            self._folder.mkdir(parents=True)
            fsync_folder(self._folder.parent)
        except OSError as error:
            raise storage_error(error, store.local(layout.SCANS)) from error
        self.part = self._folder / layout.PART
        self._sealed = False

    def examine(self, advance: Callable[[int], None] | None = None) -> LogFacts:
        """Read the finished log back from disk, every CRC checked."""
        return digest_log(ScanLog(self.part), advance)

    def seal(self, facts: LogFacts, log_sha256: str | None = None) -> ScanSummary:
        """Rename the log, write scan.json, and the manifest last; all of it durable.

        ``log_sha256`` is the digest of the whole file, where somebody has read all of it already.
        """
        try:
            fsync_file(self.part)
            summary = summary_of(facts, self.part, scan=self.scan, log_sha256=log_sha256)
            text = dump_json(summary.plain())
            log_path = self._folder / layout.LOG
            self.part.rename(log_path)
            fsync_folder(self._folder)
        except OSError as error:
            raise storage_error(error, self.part) from error
        self._store.put_if_absent(layout.scan_file(self.scan, layout.SUMMARY), text)
        manifest = (
            f"{summary.log_sha256}  {layout.LOG}\n"
            f"{hashlib.sha256(text).hexdigest()}  {layout.SUMMARY}\n"
        )
        self._store.put_if_absent(layout.scan_file(self.scan, layout.MANIFEST), manifest.encode())
        self._sealed = True
        return summary

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self._sealed and not self.keep_part:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._lock.release()


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def summary_of(facts: LogFacts, log: Path, *, scan: str, log_sha256: str | None = None) -> ScanSummary:
    """scan.json of a log with these facts."""
    start = facts.start
    return ScanSummary(
        scan=scan,
        rig=start.rig,
        label=start.label,
        tags=start.tags,
        source=start.source,
        software=start.software,
        started_ns=start.t_ns,
        ended_ns=facts.ended_ns,
        ended=facts.ended,
        cameras=facts.cameras,
        lasers=facts.lasers,
        frames=facts.frames,
        background_frames=facts.background_frames,
        width_px=facts.width_px,
        height_px=facts.height_px,
        encoding=facts.encoding,
        angle_min_rad=facts.angle_min_rad,
        angle_max_rad=facts.angle_max_rad,
        calibration=facts.calibration.calibration_id() if facts.calibration else None,
        content_sha256=facts.content_sha256,
        frames_sha256=facts.frames_sha256,
        log_bytes=log.stat().st_size,
        log_sha256=log_sha256 or file_sha256(log),
        salvaged_from=start.salvaged_from,
        continues=start.continues,
    )
