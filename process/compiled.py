"""Compiled kernels: NumPy-typed functions made into machine code once, and kept on disk.

The cache's folder is named by the content of every kernel's source: Numba itself looks at the file of
the outermost function only, so that a change in a function that it calls would go unseen, and old
machine code would give old numbers.

Each kernel is one closed piece of machine code: what it calls of this package is copied into it, and
only what Python calls is kept. Functions left apart would exist twice, optimised with a caller and by
themselves, and which copy runs would depend on who compiled and who loaded: sums may be taken in any
order, so the first scan after an installation would differ from the second in the last bits.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config as numba_config
from numba.core import event

config: Any = numba_config

LOG = logging.getLogger("turnscan")
Function = TypeVar("Function", bound=Callable[..., Any])

#: Sums may be taken in any order and with fused multiply-add, so that they fill the vector units. NaN
#: and infinity keep their meaning.
_FASTMATH = {"reassoc", "contract", "nsz"}


def kernel(function: Function) -> Function:
    """``function``, which Python calls, compiled on its first call for given argument types and kept.

    It releases the GIL. What it calls of ours must be :func:`part` or :func:`inlined`.
    """
    return _cached(_compiled(function))


def part(function: Function) -> Function:
    """A function that kernels call: compiled once for given types, then copied into each caller."""
    return _compiled(function, forceinline=True, no_cfunc_wrapper=True)


def inlined(function: Function) -> Function:
    """As :func:`part`, copied as source: for what the compiler must see in its place, and for large
    functions with one caller, which are then not compiled by themselves first.
    """
    return _compiled(function, inline="always")


def exact_kernel(function: Function) -> Function:
    """A kernel whose every operation is rounded as written.

    A value then does not depend on its place in an array, which decides between vector unit and
    remainder: a scan in two logs gives the points of the scan in one.
    """
    return _cached(numba.njit(nogil=True, error_model="numpy")(function))


def _cached(compiled: Any) -> Any:
    folder = _cache_folder()
    if folder is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(folder)
        try:
            compiled.enable_caching()
        finally:
            config.CACHE_DIR = before
    _announce()
    return compiled


def _compiled(function: Function, **options: Any) -> Any:
    return numba.njit(nogil=True, error_model="numpy", fastmath=_FASTMATH, **options)(function)


@cache
def _cache_folder() -> Path | None:
    """Where machine code is kept: the user's cache, else a private temporary folder, else nowhere."""
    here = Path(__file__).parent
    content = hashlib.sha256()
    for path in sorted(here.rglob("*.py")):
        content.update(path.read_bytes())
    name = content.hexdigest()[:16]
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    for base in (
        Path(home).expanduser() / "turnscan",
        Path(tempfile.gettempdir()) / f"turnscan-{os.getuid()}",
    ):
        folder = base / "kernels" / name
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            # Code is loaded from here: it must be nobody else's folder.
            if folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK):
                return folder
        except (OSError, RuntimeError):
            continue
    LOG.warning("no folder for compiled kernels is writable: they are compiled anew in each process")
    return None


class _Listener(event.Listener):
    """Says once that compilation has begun, since it takes seconds and looks like a hang."""

    said = False

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        if not self.said:
            self.said = True
            LOG.warning("compiling for this machine; this happens once after installation")

    def on_end(self, event: Any) -> None:
        pass


@cache
def _announce() -> None:
    register: Any = event.register
    register("numba:compile", _Listener())
