"""Extraction beside a recording: a process of its own that follows the growing log.

It only reads what is on the disk already, runs at a lower priority, and is told by a pipe when the log
is whole and when it is sealed. If it fails, recording goes on, and ``process`` derives it all later.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ..schemas.errors import InputError, TurnscanError

if TYPE_CHECKING:
    from .pipeline import LiveStart, Outcome
    from .striping import Tally

_TELL_EVERY_S: Final = 0.1
_NICE: Final = 10
_STOP_S: Final = 5.0


@dataclass(frozen=True)
class LiveProgress:
    """How far extraction is: frames done, and how much of the last one's rows showed the stripe."""

    frames: int = 0
    coverage: float | None = None


class LiveExtraction:
    """The process, as the recorder sees it: begin, ready, finish, sealed, outcome; or stop at any time.

    No method raises because the process failed: :attr:`failure` says so, and the recording stands.
    """

    def __init__(self, root: Path, start: LiveStart) -> None:
        self._root = root
        self._start = start
        self._pipe: Connection | None = None
        self._process: Any = None
        self._ready = False
        self.progress = LiveProgress()
        self.outcome: Outcome | None = None
        self.failure: TurnscanError | None = None

    def begin(self, part: Path) -> None:
        """Start following ``part``, which must exist."""
        # Spawned, not forked: threads of the recorder would be left in pieces.
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_follow, args=(self._root, part, self._start, theirs), daemon=True
        )
        self._process.start()
        theirs.close()

    def ready(self) -> None:
        """Wait until it could extract at once: on a new machine its code is compiled first."""
        while self._pipe is not None and not self._ready:
            self._receive(None)

    def look(self) -> LiveProgress:
        """The newest progress, without waiting."""
        while self._pipe is not None and self._receive(0.0) is not None:
            pass
        return self.progress

    def finish(self) -> tuple[Any, str] | None:
        """Say that the log is whole; its facts and SHA-256 once all was read, None after a failure."""
        self._tell("finished")
        while self._pipe is not None:
            message = self._receive(None)
            if message is not None and message[0] == "facts":
                return message[1], message[2]
        return None

    def sealed(self) -> Outcome | None:
        """Say that the scan is sealed; wait until its tables are published."""
        self._tell("sealed")
        while self._pipe is not None and self.outcome is None:
            self._receive(None)
        self.stop()
        return self.outcome

    def stop(self) -> None:
        """End the process; what it has not published is gone."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        if self._process is not None:
            self._process.join(_STOP_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
            self._process = None

    def _tell(self, word: str) -> None:
        if self._pipe is not None:
            with contextlib.suppress(
                OSError
            ):  # What it died of stands in the pipe, or comes as an end.
                self._pipe.send(word)

    def _receive(self, wait_s: float | None) -> tuple[Any, ...] | None:
        assert self._pipe is not None
        try:
            if wait_s is not None and not self._pipe.poll(wait_s):
                return None
            message: tuple[Any, ...] = self._pipe.recv()
        except (EOFError, OSError):
            message = ("failed", InputError("the extraction process ended unexpectedly"))
        if message[0] == "ready":
            self._ready = True
        elif message[0] == "progress":
            self.progress = message[1]
        elif message[0] == "done":
            self.outcome = message[1]
        elif message[0] == "failed":
            self.failure = message[1]
            self.stop()
        return message


def _follow(root: Path, part: Path, start: LiveStart, pipe: Connection) -> None:
    """What runs in the process."""
    # Ctrl-C reaches the whole group: the recorder says when it is time to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    import cv2

    from .pipeline import derive_growing
    from .warming import warm

    cv2.setNumThreads(1)
    told_at = 0.0

    def heard(word: str, wait_s: float | None) -> bool:
        try:
            return (wait_s is None or pipe.poll(wait_s)) and pipe.recv() == word
        except (EOFError, OSError) as error:
            raise InputError("the recorder ended before its log did") from error

    def advance(tally: Tally) -> None:
        nonlocal told_at
        if time.monotonic() - told_at >= _TELL_EVERY_S:
            told_at = time.monotonic()
            coverage = tally.rows_with_stripe / tally.rows if tally.rows else None
            pipe.send(("progress", LiveProgress(tally.frames, coverage)))

    def seal(facts: Any, log_sha256: str) -> None:
        pipe.send(("facts", facts, log_sha256))
        if not heard("sealed", None):
            raise InputError("the recorder did not seal its log")

    try:
        warm(start.recipe, start.calibration, start.width_px, start.height_px, start.encoding)
        pipe.send(("ready",))
        # Somebody waited until here; from now on recording goes first.
        os.nice(_NICE)
        whole = partial(heard, "finished")
        outcome = derive_growing(root, part, start, finished=whole, seal=seal, advance=advance)
        pipe.send(("done", outcome))
    except TurnscanError as error:
        with contextlib.suppress(OSError):
            pipe.send(("failed", error))
    except BrokenPipeError:
        return
