"""The demo's frames as files."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.ingest.room.demo import demo_calibration, demo_scene, write_demo_frames
from turnscan.ingest.room.render import render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.truth import range_errors_mm
from turnscan.schemas.calibration import parse_calibration
from turnscan.schemas.errors import StorageError


def test_demo_files(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    made = write_demo_frames(
        tmp_path / "demo", frames=3, step_deg=120.0, advance=lambda i, n: seen.append((i, n))
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]
    with made.angles.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["file"], float(r["angle_deg"])) for r in rows] == [
        ("frame0000.png", 0.0),
        ("frame0001.png", 120.0),
        ("frame0002.png", 240.0),
    ]
    read_back = parse_calibration(made.calibration.read_bytes(), where="demo")
    assert read_back.sha256() == demo_calibration().sha256()
    a, scene = SimulatedRig(demo_calibration()), demo_scene()
    for i, truth in enumerate(made.truth):
        again = render(scene, a, math.radians(120.0 * i), seed=1, frame=i)
        written = cv2.imread(str(made.frames / f"frame{i:04d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(written, again.image)
        assert np.array_equal(truth.u_px, again.truth[0].u_px)
        error, true = range_errors_mm(scene, a, math.radians(120.0 * i), truth.points_mm)
        assert np.abs(error).max() < 1e-6
        assert true.min() > 300.0


def test_demo_files_where_they_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(StorageError, match="cannot write the demo's frames to "):
        write_demo_frames(tmp_path / "taken", frames=1)
