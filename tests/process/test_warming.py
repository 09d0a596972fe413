"""After warming up nothing is left to compile or load when real frames come."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

#: Run in a process of its own: in this one other tests have loaded kernels already.
_PROGRAM = """
import gc, sys
from pathlib import Path
import numpy as np
from numba.core.dispatcher import Dispatcher
from turnscan.process.pipeline import derive
from turnscan.process.warming import warm
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.log_writer import LogWriter

root, encoding, name = sys.argv[1:]
camera = Intrinsics(width_px=64, height_px=48, fx_px=300.0, fy_px=300.0, cx_px=32.0, cy_px=24.0)
laser = LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=150.0)
axis = TurntableAxis(point_mm=(0, 0, 180), direction=(0, -1, 0))
calibration = Calibration(rig="r1", camera=camera, lasers=(laser,), turntable=axis)

def compiled():
    return {
        (d.py_func.__module__, d.py_func.__name__, str(s))
        for d in gc.get_objects() if isinstance(d, Dispatcher) for s in d.signatures
    }

archive = Archive.init(Path(root))
with archive.new_scan() as draft:
    writer = LogWriter(draft.part)
    writer.write_event(ScanStart(
        t_ns=5, scan=draft.scan, rig="r1", source="test", time_source="clock", software="t"))
    writer.write_calibration(calibration, 5)
    for n in range(3):
        writer.write_event(TurntableAngle(t_ns=10 * n + 10, commanded_rad=n / 9, reported_rad=n / 9))
        x, row = np.arange(64), np.arange(48)[:, None]
        image = 12 + 180 * np.exp(-((x - 25 - 0.05 * row) ** 2) / 4.5)
        image += np.random.default_rng(n).normal(0, 2, image.shape)
        image = np.clip(np.rint(image), 0, 255)
        image = (image * 257).astype(np.uint16) if encoding == "mono16" else image.astype(np.uint8)
        image = np.repeat(image[..., None], 3, axis=2) if encoding == "bgr8" else image
        writer.write_image(Exposure(t_ns=10 * n + 14, frame=n, lasers_on=(0,)), image)
    writer.write_event(ScanEnd(t_ns=10**6, ended="complete", frames=3))
    writer.finish()
    archive.seal(draft, draft.examine())
warm(BUILT_IN[name], calibration, 64, 48, encoding)
before = compiled()
(outcome,) = derive(archive, archive.scans(), BUILT_IN[name])
assert outcome.error is None, outcome.error
assert outcome.points > 100, outcome
print(len(before), sorted(compiled() - before))
"""


@pytest.mark.parametrize(
    ("encoding", "recipe"),
    [
        ("mono8", "default"),
        ("mono8", "paper"),
        pytest.param("mono16", "default", marks=pytest.mark.slow),
        pytest.param("bgr8", "default", marks=pytest.mark.slow),
    ],
)
def test_the_first_real_frame_finds_everything_loaded(
    tmp_path: Path, encoding: str, recipe: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(tmp_path / "lab"), encoding, recipe],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    count, later = done.stdout.split(maxsplit=1)
    # Of the default recipe: one for the frame, one for the points.
    assert int(count) >= 2
    assert later.strip() == "[]"
