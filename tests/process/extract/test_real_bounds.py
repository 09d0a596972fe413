"""No frame of any kind makes the compiled code read outside of its arrays."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.process.extract import extract_stripe


def grey_frames(folder: Path) -> list[Path]:
    """Every photograph of the test data, boards and clutter included."""
    return sorted(p for p in folder.rglob("*") if p.suffix in (".jpg", ".png"))


@pytest.mark.parametrize("name", ["calibration", "."])
def test_frames_without_a_clean_stripe_give_finite_points_inside(test_data: Path, name: str) -> None:
    """Boards, clutter and clipped glow: moments may run away there, points may not."""
    paths = grey_frames(test_data / "ciclop" / name)[:40]
    assert paths
    for path in paths:
        frame = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert frame is not None
        points = extract_stripe(frame)
        for field in ("u_px", "sigma_u_px", "amplitude_dn", "width_px", "background_dn"):
            assert np.isfinite(points[field]).all(), (path, field)
        assert ((points["u_px"] > -0.5) & (points["u_px"] < frame.shape[1] - 0.5)).all(), path
        assert (np.diff(points["row"].astype(int)) > 0).all(), path


BOUNDS = """
import sys, cv2
from turnscan.process.extract import extract_stripe
for path in sys.argv[1:]:
    frame = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    extract_stripe(frame)
    extract_stripe(frame, orientation="horizontal")
    extract_stripe(frame[::7, ::5].copy())
"""


@pytest.mark.slow
def test_every_real_frame_with_every_index_checked(test_data: Path, tmp_path: Path) -> None:
    """Numba can check each index; the kernels are compiled anew for it."""
    paths = grey_frames(test_data)
    assert len(paths) > 100
    checked = {"NUMBA_BOUNDSCHECK": "1", "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", BOUNDS, *map(str, paths)],
        env={**os.environ, **checked},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
