"""The one narrow way to the bytes of an archive, with the local folder behind it.

Paths are relative, with ``/``. Publishing is atomic and durable: stage aside, fsync, link into place
(which never replaces anything), fsync the folders. Object storage could stand here one day.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from ..schemas.errors import DamageError, StorageError

STAGING = "staging"


class ByteStore(Protocol):
    """What the archive needs of a place that keeps bytes."""

    def put_if_absent(self, path: str, source: bytes | Path) -> bool:
        """Publish ``source`` (bytes, or a staged file, which is consumed); False if it was there."""

    def get(self, path: str) -> bytes:
        """All bytes of ``path``."""

    def get_range(self, path: str, start: int, size: int) -> bytes:
        """``size`` bytes of ``path`` from ``start``."""

    def list(self, folder: str) -> list[str]:
        """Names in ``folder``, sorted; empty if there is no such folder."""

    def head(self, path: str) -> int | None:
        """Size of ``path`` in bytes, or None if it does not exist."""

    def delete(self, path: str) -> None:
        """Remove ``path``; nothing happens if it does not exist."""


def storage_error(error: OSError, path: Path | str) -> StorageError:
    """The error of a file system that refused, with the way out that fits."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return StorageError(
            f"{path}: the disk is full ({error.strerror})",
            hint="free some space and run the command again; nothing half-written was published",
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return StorageError(f"{path}: {error.strerror}", hint="check the permissions of the archive")
    return StorageError(f"{path}: {error.strerror}")


def fsync_folder(folder: Path) -> None:
    """Make the names in ``folder`` durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def fsync_file(path: Path) -> None:
    """Make the bytes of ``path`` durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK}


def _link(source: Path, target: Path) -> bool:
    """Give ``source`` the name ``target`` unless that is taken; whether it was free."""
    try:
        os.link(source, target)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # exFAT and some network mounts have no hard links. A rename replaces what another process
        # put there since the look, but only with the same key's bytes.
        if target.exists():
            return False
        source.rename(target)
    return True


class LocalFolder:
    """A ByteStore in a folder of the local file system."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def local(self, path: str) -> Path:
        """Where ``path`` lies on this machine, for libraries that open files themselves."""
        return self.root / path

    @contextmanager
    def staged(self, suffix: str = "") -> Iterator[Path]:
        """A path of its own in staging/, removed again unless it was published."""
        folder = self.root / STAGING
        path = folder / f"{os.getpid()}-{uuid.uuid4().hex}{suffix}"
        try:
            folder.mkdir(exist_ok=True)
            yield path
        except OSError as error:
            raise storage_error(error, path) from error
        finally:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)

    @contextmanager
    def holding(self, *, alone: bool) -> Iterator[None]:
        """Between the two steps of a publication (table, then manifest) nobody may tidy up.

        Publishers hold the lock together, whoever moves debris holds it ``alone``. The kernel lets go
        of it when a process ends, however it ends.
        """
        folder = self.root / STAGING
        try:
            folder.mkdir(exist_ok=True)
            # The folder itself is the lock: a file of its own would only be one more thing to explain.
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise storage_error(error, folder) from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
            yield
        finally:
            os.close(handle)

    def put_if_absent(self, path: str, source: bytes | Path) -> bool:
        """See :class:`ByteStore`."""
        if isinstance(source, bytes):
            with self.staged() as aside:
                aside.write_bytes(source)
                return self.put_if_absent(path, aside)
        target = self.root / path
        try:
            fsync_file(source)
            self._make_folder(target.parent)
            ours = _link(source, target)
            source.unlink(missing_ok=True)
            fsync_folder(target.parent)
        except OSError as error:
            raise storage_error(error, target) from error
        return ours

    def _make_folder(self, folder: Path) -> None:
        missing = []
        at = folder
        while not at.is_dir():
            missing.append(at)
            at = at.parent
        folder.mkdir(parents=True, exist_ok=True)
        for made in missing:
            fsync_folder(made.parent)

    def get(self, path: str) -> bytes:
        """See :class:`ByteStore`."""
        target = self.root / path
        try:
            return target.read_bytes()
        except FileNotFoundError as error:
            raise DamageError(
                f"{target}: the file is missing", hint="turnscan verify lists what is damaged"
            ) from error
        except OSError as error:
            raise storage_error(error, target) from error

    def get_range(self, path: str, start: int, size: int) -> bytes:
        """See :class:`ByteStore`."""
        target = self.root / path
        try:
            with target.open("rb") as file:
                file.seek(start)
                return file.read(size)
        except OSError as error:
            raise storage_error(error, target) from error

    def list(self, folder: str) -> list[str]:
        """See :class:`ByteStore`."""
        try:
            return sorted(os.listdir(self.root / folder))
        except FileNotFoundError:
            return []
        except OSError as error:
            raise storage_error(error, self.root / folder) from error

    def head(self, path: str) -> int | None:
        """See :class:`ByteStore`."""
        try:
            return (self.root / path).stat().st_size
        except OSError:
            return None

    def delete(self, path: str) -> None:
        """See :class:`ByteStore`."""
        try:
            (self.root / path).unlink(missing_ok=True)
        except OSError as error:
            raise storage_error(error, self.root / path) from error
