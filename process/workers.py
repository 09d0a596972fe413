"""Run jobs in several processes and give their results in order; stop at once when told to."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext
from typing import Any, Final, TypeVar

from ..schemas.errors import InputError

Result = TypeVar("Result")
_BLAS_THREADS: Final = "OPENBLAS_NUM_THREADS"


def in_processes(
    workers: int, function: Callable[..., Result], jobs: Sequence[tuple[Any, ...]]
) -> Iterator[Result]:
    """``function(*job)`` of every job, in the order of ``jobs``, a process each.

    Each worker has one job in hand and one waiting, so that none stands idle between small ones; an
    interrupt still ends all of them at once.

    Raises
    ------
    InputError
        A worker was killed from outside.
    """
    context = _server()
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare)
    pending: dict[Future[Result], int] = {}
    done: dict[int, Result] = {}
    begun = given = 0
    try:
        while given < len(jobs):
            while begun < len(jobs) and len(pending) < 2 * workers:
                pending[pool.submit(function, *jobs[begun])] = begun
                begun += 1
            finished, _ = wait(pending, return_when=FIRST_COMPLETED)
            for task in finished:
                done[pending.pop(task)] = task.result()
            while given in done:
                yield done.pop(given)
                given += 1
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process was killed",
            hint="run the command again (with fewer --workers if memory was short); what was "
            "published stands, and nothing half-done was",
        ) from error
    except BaseException:
        # Killing a worker harms nothing: what it has not published it has only staged.
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _server() -> ForkServerContext:
    """What workers are forked from: a process that has imported everything once, and has no threads.

    Not this one: polars, pyarrow and OpenCV have threads here that a fork would leave in pieces.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["turnscan.process.loaded", "__main__"])
    before = os.environ.get(_BLAS_THREADS)
    # It starts its threads when it is imported.
    os.environ[_BLAS_THREADS] = "1"
    # Ctrl-C reaches the whole group: until the server can end by it without a traceback, it waits. (The
    # tracker would let it in again.)
    resource_tracker.ensure_running()
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
        if before is None:
            del os.environ[_BLAS_THREADS]
        else:
            os.environ[_BLAS_THREADS] = before
    return context


def _prepare() -> None:
    """In each worker: die quietly of Ctrl-C and with the parent, leave other cores to other workers."""
    import cv2

    # A parent that is killed cannot tell its workers: they would wait for jobs for ever.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        # At once: what is not published is only staged, and there is nobody left to hear of it.
        os._exit(1)
