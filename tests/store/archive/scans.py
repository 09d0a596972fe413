"""Small scans for the tests of this folder: a straight stripe that wanders from frame to frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis


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
