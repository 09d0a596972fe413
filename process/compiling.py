"""Compile one kernel for given argument types in a process of its own, into the cache on disk."""

from __future__ import annotations

import fcntl
import hashlib
import importlib
import logging
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

LOG = logging.getLogger("turnscan")

#: Set in the process that compiles: what it needs it compiles itself.
_IN_COMPILER: Final = "TURNSCAN_COMPILER"
_RUN: Final = "from turnscan.process.compiling import run; run()"


def in_compiler() -> bool:
    """Whether this process is one that compiles for another."""
    return _IN_COMPILER in os.environ


def compiled_on_disk(
    kernel: Any, types: tuple[Any, ...], folder: Path, say: Callable[[], None]
) -> None:
    """See to it that ``kernel`` is in the cache ``folder`` for arguments of these Numba types.

    Processes that want the same wait for each other. ``say`` is called before a compilation. If the
    other process fails, that is said, and the caller's own compilation remains.
    """
    if in_compiler():
        return
    module, name = kernel.py_func.__module__, kernel.py_func.__name__
    # The processor is part of it: a folder may be seen by several machines.
    what = f"{module} {name} {types} {kernel.targetctx.codegen().magic_tuple()}"
    mark = folder / f"{hashlib.sha256(what.encode()).hexdigest()[:24]}.compiled"
    if mark.exists():
        return
    with mark.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if mark.exists():
            return
        say()
        done = subprocess.run(
            [sys.executable, "-c", _RUN],
            input=pickle.dumps((module, name, types)),
            env={
                **os.environ,
                _IN_COMPILER: "1",
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            },
            capture_output=True,
            check=False,
        )
        if done.returncode == 0:
            mark.touch()
            return
    LOG.warning(
        "%s could not be compiled beforehand, this process does it: %s",
        name,
        done.stderr.decode(errors="replace").strip().splitlines()[-1:],
    )


def run() -> None:
    """Compile what standard input names: what :func:`compiled_on_disk` has its process do."""
    # Ctrl-C is for the one who waits; a half-compiled kernel helps nobody.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    module, name, types = pickle.load(sys.stdin.buffer)  # noqa: S301 (our own, from our own process)
    getattr(importlib.import_module(module), name).compile(types)
