"""Is there room for a scan? Asked before it begins, and a little kept back to end it well."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path
from typing import Final

from ...schemas.errors import StorageError

_PIXEL_BYTES: Final = {"mono8": 1, "mono16": 2, "bgr8": 3}
#: Sensor noise compresses to 0.42 of its size; with the tables and some to spare:
_OF_RAW: Final = 0.6
_BESIDE_BYTES: Final = 16 << 20
_KEPT_BACK_BYTES: Final = 4 << 20


def needed_bytes(frames: int, width_px: int, height_px: int, encoding: str) -> int:
    """Estimate of what a scan takes on the disk: log and tables."""
    raw = frames * width_px * height_px * _PIXEL_BYTES[encoding]
    return int(raw * _OF_RAW) + _BESIDE_BYTES


def check_room(folder: Path, needed: int) -> int:
    """Free bytes on the disk of ``folder``.

    Raises
    ------
    StorageError
        They are fewer than ``needed``.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise StorageError(
            f"{folder}: the scan needs about {size_text(needed)}, {size_text(free)} are free",
            hint=f"free {size_text(needed - free)}, take fewer frames, or use another disk",
        )
    return free


def size_text(size: float) -> str:
    """A size as people say it."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{max(size, 0) / 1e6:.0f} MB"


class KeptBack:
    """Room held by a file while a scan is recorded, so that a full disk still takes the log's end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            handle = os.open(path, os.O_CREAT | os.O_WRONLY, 0o644)
            try:
                os.posix_fallocate(handle, 0, _KEPT_BACK_BYTES)
            finally:
                os.close(handle)
        except OSError:
            self.give_back()

    def give_back(self) -> None:
        """Free the room. May be called more than once."""
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
