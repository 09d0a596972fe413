"""Follow a log while another process writes it: items as whole chunks arrive, facts at the end."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from ..schemas.events import LogEvent
from .log_digest import LogDigest, LogFacts, digested_items
from .log_reader import LogFrame, ScanLog

#: Between two looks at a file that has not grown.
_LOOK_EVERY_S: Final = 0.01


class GrowingLog:
    """A log that is being written. It is read once, every CRC checked, as it will be when sealed.

    Parameters
    ----------
    path
        The ``.part``; it must exist.
    finished
        Called with seconds to wait; True as soon as the writer has said that the file is whole. What
        it raises (the writer is gone) ends the reading.
    """

    def __init__(self, path: Path, finished: Callable[[float], bool]) -> None:
        self.path = path
        self._finished = finished
        self._whole = False
        self._bytes = hashlib.sha256()
        self._digest = LogDigest(str(path))

    def items(self) -> Iterator[LogEvent | LogFrame]:
        """Every event and frame in time order; ends when the log has been finished."""
        return digested_items(ScanLog(self.path, growth=self), self._digest)

    def facts(self) -> LogFacts:
        """Facts and digests of the log, once all items were taken."""
        return self._digest.facts()

    def log_sha256(self) -> str:
        """SHA-256 of the whole file, once all items were taken."""
        return self._bytes.hexdigest()

    def wait_for(self, size: int | None) -> int:
        """See :class:`.log_walk.Growth`."""
        while True:
            # Asked before the look, so that nothing written before the word is missed.
            self._whole = self._whole or self._finished(0.0)
            now = self.path.stat().st_size
            if self._whole or (size is not None and now >= size):
                return now
            self._whole = self._finished(_LOOK_EVERY_S)

    def take(self, data: bytes | memoryview) -> None:
        """See :class:`.log_walk.Growth`."""
        self._bytes.update(data)
