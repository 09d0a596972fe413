"""Kernels that are compiled here and kernels that are loaded are the same machine code."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

from turnscan.process.denoise_window import filter_windows
from turnscan.process.extract import METHODS, extract_stripe, noise_of

#: Names of functions of this package, as the compiler spells them, where code refers to them.
OURS = re.compile(r'@"?(_ZN8turnscan[^"(\s,)]*)')


def frame() -> np.ndarray:
    x, row = np.arange(200), np.arange(90)[:, None]
    image = 20 + 180 * np.exp(-0.5 * ((x - 80.3 - 0.1 * row) / 2.0) ** 2)
    image += np.random.default_rng(3).normal(0, 2, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def kept_kernels() -> Iterator[tuple[str, Any, Any]]:
    """(name, machine code, its module) of each compiled kernel that is kept on disk and not exact."""
    for found in gc.get_objects():
        if not isinstance(found, Dispatcher) or isinstance(found._cache, NullCache):
            continue
        name = f"{found.py_func.__module__}.{found.py_func.__name__}"
        if name.startswith("turnscan.") and found.targetoptions.get("fastmath"):
            for overload in found.overloads.values():
                yield name, overload, overload.library._get_module_for_linking()


def test_every_kept_kernel_is_closed() -> None:
    """None calls, or holds, another function of the package: what it needs is written into it.

    The module that is looked at is the one that the machine code was made from, whether it was
    compiled in this process or loaded with the code.
    """
    image = frame()
    noise_of(image)
    for method in METHODS:
        assert len(extract_stripe(image, method)) > 80
    for choice, near in (("first", None), ("nearest", 90.0), ("continuous", None)):
        assert len(extract_stripe(image, choice=choice, expected_px=near)) > 80
    spans = np.full(len(image), 60), np.full(len(image), 110)
    filter_windows(image, [("gaussian", 1), ("median", 1), ("median", 2)], *spans)
    seen = set()
    for name, overload, module in kept_kernels():
        found = set(OURS.findall(str(module)))
        # Its own name must be among them, else nothing was looked at.
        assert found == {overload.fndesc.llvm_func_name}, (name, found)
        seen.add(name.removeprefix("turnscan.process."))
    # Else there would be nothing to see.
    assert {"extract.fused._brightest", "extract.fused._chosen", "extract.search.find_peaks"} <= seen
    assert len(seen) > 12, seen


SCENE = """
import hashlib, sys
import numpy as np
from turnscan.process.extract import extract_stripe
rng = np.random.default_rng(3)
x, row = np.arange(400), np.arange(240)[:, None]
for case, (amplitude, width, slope, skew) in enumerate(
    ((180, 2.0, 0.1, 0.0), (600, 2.0, 0.2, 0.0), (150, 9.0, 0.0, 0.0), (200, 3.0, 0.3, 0.4))
):
    t = (x - 150.3 - slope * row) / width
    frame = 20 + amplitude * np.exp(-0.5 * t * t / (1 + skew * (t > 0)) ** 2)
    frame += rng.normal(0, 2, frame.shape)
    struck = rng.random(frame.shape) < 0.01 * (case % 2)
    frame = np.where(struck, 255 * rng.integers(0, 2, frame.shape), frame)
    frame = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
    for choice in ("brightest", "first"):
        found = extract_stripe(frame, choice=choice)
        assert len(found) > 200, (case, choice, len(found))
        print(case, choice, hashlib.sha256(found.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_who_compiles_and_who_loads_get_the_same_bytes(tmp_path: Path) -> None:
    def run() -> tuple[str, str]:
        done = subprocess.run(
            [sys.executable, "-c", SCENE],
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    (first, said), (later, quiet) = run(), run()
    assert "compiling for this machine" in said
    assert quiet == ""
    assert first == later
    assert len(first.splitlines()) == 8
