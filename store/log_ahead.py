"""Chunks of a log decompressed by threads ahead of the one that uses their records.

That one does not wait for long: what no thread has begun, it does itself. Two cores are then busy with
one thread beside the caller's, and none of them holds up the others while it waits for its turn.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from ..schemas.errors import DamageError
from .log_records import chunk_records

#: What is done with the records of a chunk where it was decompressed; it may replace some of them.
Prepare = Callable[[list[Any]], None]
Records = tuple[list[Any], DamageError | None]

#: Chunks that wait for each thread: so that it has something to do while the caller is busy elsewhere.
#: Of chunks so large that a few fill the memory, one.
_WAITING: Final = 4
_WAITING_BYTES: Final = 1 << 24


class ChunkJob:
    """The records of one chunk, to be made by a thread or by whoever waits for them."""

    def __init__(
        self,
        pool: ThreadPoolExecutor,
        chunk: tuple[memoryview, Path, int],
        strict: bool,
        prepare: Prepare | None,
    ) -> None:
        self.size = len(chunk[0])
        self._job = (*chunk, strict, prepare)
        self._future: Future[Records] = pool.submit(_all_records, *self._job)
        self._here: Records | None = None

    def done(self) -> bool:
        """Whether nobody need wait."""
        return self._here is not None or self._future.done()

    def take(self) -> bool:
        """Do it here; False if a thread has begun it, or it is done."""
        if not self._future.cancel() or self._here is not None:
            return False
        self._here = _all_records(*self._job)
        return True

    def result(self) -> Records:
        """The records up to the first that is damaged, and what is wrong with it."""
        return self._future.result() if self._here is None else self._here


def waiting_chunks(threads: int) -> int:
    """How many chunks may wait at a time; the bytes of one more are being read."""
    return _WAITING * threads


def in_order(walk: Iterator[tuple[int, Any]], waiting_chunks: int) -> Iterator[tuple[int, Any]]:
    """The (offset, record) of ``walk``, a chunk's records in the place of its job."""
    waiting: deque[tuple[int, Any]] = deque()

    def next_ones() -> Iterator[tuple[int, Any]]:
        offset, record = waiting.popleft()
        if not isinstance(record, ChunkJob):
            yield offset, record
            return
        jobs = [record, *(job for _, job in waiting if isinstance(job, ChunkJob))]
        while not record.done() and any(job.take() for job in jobs):
            pass
        records, fault = record.result()
        for inner in records:
            yield offset, inner
        if fault is not None:
            raise fault

    def too_many() -> bool:
        sizes = [record.size for _, record in waiting if isinstance(record, ChunkJob)]
        return len(sizes) > waiting_chunks or (len(sizes) > 1 and sum(sizes) > _WAITING_BYTES)

    while True:
        try:
            step = next(walk, None)
        except (DamageError, OSError):
            # What stands before the fault comes first, as it does without the threads.
            while waiting:
                yield from next_ones()
            raise
        if step is None:
            break
        waiting.append(step)
        if isinstance(step[1], ChunkJob):
            while too_many():
                yield from next_ones()
    while waiting:
        yield from next_ones()


def _all_records(
    body: memoryview, path: Path, offset: int, strict: bool, prepare: Prepare | None
) -> Records:
    records: list[Any] = []
    fault = None
    try:
        records.extend(chunk_records(body, path, offset, strict=strict))
    except DamageError as error:
        fault = error
    if prepare is not None:
        prepare(records)
    return records, fault
