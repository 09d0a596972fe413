"""Make tests/golden/archive-1: run once for each version of the formats, then never again.

    python tests/golden/make_archive.py NEW_FOLDER

The folder is what an archive written by that version looks like; every later version must read it.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from turnscan.process.pipeline import derive
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.events import Exposure, LaserState, ScanEnd, ScanStart, TurntableAngle
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.log_writer import LogWriter

START_NS = 1_790_000_000_000_000_000


def frames() -> list[np.ndarray]:
    """Three frames of 40 x 64 with a slanted stripe, in whole numbers only: the same everywhere."""
    row, column = np.mgrid[0:40, 0:64]
    out = []
    for i in range(3):
        distance = np.abs(4 * (column - 24 - 6 * i) - row // 2)
        stripe = np.maximum(0, 200 - distance * distance)
        out.append((15 + (row * 7 + column * 13 + i * 5) % 5 + stripe).astype(np.uint8))
    return out


def calibration(distance_mm: float) -> Calibration:
    """A small camera, one laser, a fixed head."""
    return Calibration(
        rig="golden",
        camera=Intrinsics(
            width_px=64,
            height_px=40,
            fx_px=250.0,
            fy_px=251.0,
            cx_px=31.0,
            cy_px=20.5,
            skew=0.001,
            distortion=(-0.2, 0.1, 0.001, -0.001, 0.0),
        ),
        lasers=(LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=distance_mm),),
        turntable=TurntableAxis(point_mm=(0.0, 10.0, 200.0), direction=(0.0, -0.8, -0.6)),
    )


def make(folder: Path) -> Archive:
    """The golden archive in a new folder."""
    archive = Archive.init(folder)
    with archive.new_scan() as draft:
        with LogWriter(draft.part) as writer:
            start = ScanStart(
                t_ns=START_NS,
                scan=draft.scan,
                rig="golden",
                label="golden",
                tags={"kind": "golden"},
                source="test",
                time_source="given",
                software="golden",
            )
            writer.write_event(start)
            writer.write_calibration(calibration(160.0), START_NS)
            writer.write_event(LaserState(t_ns=START_NS, laser=0, on=True))
            for i, frame in enumerate(frames()):
                t_ns = START_NS + i * 1000
                writer.write_event(
                    TurntableAngle(t_ns=t_ns, commanded_rad=0.1 * i, reported_rad=0.1 * i + 0.001)
                )
                writer.write_image(Exposure(t_ns=t_ns, frame=i, lasers_on=(0,)), frame)
            writer.write_event(ScanEnd(t_ns=START_NS + 5000, ended="complete", frames=3))
        archive.seal(draft, draft.examine())
    archive.certify(archive.add_calibration(calibration(161.0)))
    archive.tag("golden", {"kind": "old"})
    for recipe in BUILT_IN.values():
        for outcome in derive(archive, archive.scans(), recipe):
            if outcome.error:
                raise outcome.error
    return archive


if __name__ == "__main__":
    made = make(Path(sys.argv[1]))
    made.catalog.path.unlink()
    shutil.rmtree(made.root / "staging")
