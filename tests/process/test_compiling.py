"""The process that compiles and those that load what it compiled give the same bits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCENE = """
import hashlib, sys
import numpy as np
from turnscan.process.extract import extract_stripe, noise_of
rng = np.random.default_rng(3)
x = np.arange(240)
frame = 20 + 180 * np.exp(-0.5 * ((x - 100.3) / 2.0) ** 2) + 2 * rng.standard_normal((120, 240))
frame = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
if sys.argv[1] == "noise":
    print(noise_of(frame).hex())
else:
    print(hashlib.sha256(extract_stripe(frame, sys.argv[1]).tobytes()).hexdigest())
"""


def run(what: str, cache: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SCENE, what],
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen[str]) -> tuple[str, str]:
    out, err = process.communicate()
    assert process.returncode == 0, err
    return out, err


@pytest.mark.parametrize("what", ["noise", pytest.param("fused", marks=pytest.mark.slow)])
def test_first_and_later_processes_agree_to_the_bit(what: str, tmp_path: Path) -> None:
    first = [run(what, tmp_path) for _ in range(2)]
    (one, said), (two, also) = (finished(p) for p in first)
    later, quiet = finished(run(what, tmp_path))
    assert one == two == later
    assert "compiling for this machine" in said + also
    assert quiet == ""
    folder = next((tmp_path / "turnscan" / "kernels").iterdir())
    assert list(folder.glob("*.compiled"))
