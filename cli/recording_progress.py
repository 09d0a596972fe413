"""The live line of ``turnscan record``: angle, frames, rate, stripe coverage, drops, time left."""

from __future__ import annotations

import math
import sys
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from .output import LOG, Session

if TYPE_CHECKING:
    from ..ingest.session.order import Progress
    from ..process.live import LiveExtraction


class Shown:
    """A progress bar on stderr while a scan is recorded; nothing where stderr is no terminal."""

    def __init__(self, session: Session, live: list[LiveExtraction]) -> None:
        self._live = live
        self._bar: Any = None
        self._task: Any = None
        self._wanted = not session.quiet and sys.stderr.isatty()

    def __enter__(self) -> Self:
        if self._wanted:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (
                TextColumn("{task.description}"),
                BarColumn(bar_width=20),
                TextColumn("{task.fields[text]}"),
                TimeElapsedColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("connecting", total=None, text="")
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, progress: Progress) -> None:
        """Called by the session a few times a second."""
        text = progress_text(progress, self._live[0] if self._live else None)
        LOG.debug("recording: %s", text)
        if self._bar is not None:
            self._bar.update(
                self._task,
                description="recording",
                completed=progress.done,
                total=progress.total,
                text=text,
            )

    def say_what(self, what: str) -> None:
        """Name what is being done now."""
        if self._bar is not None:
            self._bar.update(self._task, description=what, text="")


def progress_text(progress: Progress, live: LiveExtraction | None) -> str:
    """The facts of one moment as a line."""
    parts = [
        f"{math.degrees(progress.angle_rad):.1f} deg",
        f"{progress.frames} frames",
        f"{progress.frames_per_s:.1f}/s",
    ]
    if live is not None:
        seen = live.look()
        if live.failure is not None:
            parts.append("extraction failed")
        else:
            if seen.coverage is not None:
                parts.append(f"stripe in {100 * seen.coverage:.0f} % of rows")
            behind = progress.frames - seen.frames
            if behind > 2 * max(progress.frames_per_s, 1):
                parts.append(f"extraction {behind} behind")
    parts.append(f"{progress.dropped} dropped")
    if progress.failed_poses:
        parts.append(f"{progress.failed_poses} poses skipped")
    if progress.left_s is not None:
        minutes, seconds = divmod(round(progress.left_s), 60)
        parts.append(f"{minutes}:{seconds:02d} left")
    return ", ".join(parts)
