"""How the simulated room's inner loops are compiled: once, kept on disk, without holding the GIL."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., object])


def compiled(function: AnyFunction) -> AnyFunction:
    """``function`` as machine code. Division by zero gives inf or nan, as NumPy's does."""
    made: Any = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    out: AnyFunction = made
    return out
