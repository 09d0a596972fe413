"""Small scans for the tests of this folder: a straight stripe that wanders from frame to frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.manifests import ScanSummary
from turnscan.store import Archive


def calibration(h: float = 150.0, k1: float = -0.1) -> Calibration:
    return Calibration(
        rig="r1",
        camera=Intrinsics(
            width_px=64,
            height_px=48,
            fx_px=300.0,
            fy_px=300.0,
            cx_px=32.0,
            cy_px=24.0,
            distortion=(k1, 0, 0, 0, 0),
        ),
        lasers=(LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=h),),
        turntable=TurntableAxis(point_mm=(0, 0, 180), direction=(0, -1, 0)),
    )


def write_images(folder: Path, count: int) -> Path:
    rng = np.random.default_rng(8)
    x = np.arange(64)
    for i in range(count):
        centre = 30 + 2 * i + 0.05 * np.arange(48)[:, None]
        frame = 12 + 180 * np.exp(-((x - centre) ** 2) / 2 / 1.5**2) + rng.normal(0, 1, (48, 64))
        cv2.imwrite(str(folder / f"img{i}.png"), np.clip(np.rint(frame), 0, 255).astype(np.uint8))
    return folder


def import_scan(
    archive: Archive, source: Path, *, rig: str = "r1", c: Calibration | None = None, step: float = 10.0
) -> ScanSummary:
    poses = poses_by_step(sorted(source.glob("*.png")), step_deg=step)
    document = calibration() if c is None else c
    return import_images(archive, ImportPlan(poses, rig=rig, label="first", calibration=document))


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)
