"""The demo's room and scanner, and its frames as files: the paper's situation, with known truth."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...schemas.calibration import Calibration, PaperCalibration
from ...schemas.document import dump_json
from ...schemas.errors import StorageError
from .render import Light, Truth, render
from .rig import SimulatedRig
from .scene import Box, Pillar, Scene, Sphere, Walls

FRAMES = 180
STEP_DEG = 2.0


def demo_scene() -> Scene:
    """A room of 8 x 6 x 2.6 m with a pillar, boxes and balls; the scanner stands off its middle."""
    return Scene(
        (
            Walls((-2800.0, -2600.0, -1100.0), (5200.0, 3400.0, 1500.0), albedo=0.85),
            Pillar(350.0, 650.0, 90.0, albedo=0.6),
            Box((1200.0, 900.0, -1100.0), (1900.0, 1500.0, 150.0), albedo=0.7),
            Box((-1900.0, -1500.0, -1100.0), (-1200.0, -700.0, 350.0), albedo=0.5),
            Sphere((-300.0, -1500.0, 50.0), 300.0, albedo=0.9),
            Sphere((2900.0, -900.0, -300.0), 400.0, albedo=0.9),
        )
    )


def demo_calibration() -> Calibration:
    """The paper's camera (section 3.1.2) with a laser at 300 mm, seeing from 0.4 to 7 m."""
    return PaperCalibration(
        rig="demo",
        note="simulated; camera intrinsics of Xiao et al. 2015",
        width_px=640,
        height_px=480,
        f_px=762.0,
        cx_px=296.92665,
        cy_px=271.50956,
        distortion=(-0.20997, 0.1649, 0.0008, -0.00001, 0.0),
        L_mm=300.0,
        D_mm=150.0,
        theta_rad=math.atan2(1.0, 0.4),
        c_mm=40.0,
    ).calibration()


@dataclass(frozen=True)
class DemoFiles:
    """Where the frames and what belongs to them were written, and the truth of each frame."""

    frames: Path
    angles: Path
    calibration: Path
    truth: list[Truth]


def write_demo_frames(
    folder: Path,
    *,
    frames: int = FRAMES,
    step_deg: float = STEP_DEG,
    seed: int = 1,
    light: Light | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> DemoFiles:
    """Render ``frames`` poses into PNG files, with angles.csv and calibration.json beside them."""
    calibration = demo_calibration()
    rig, scene = SimulatedRig(calibration), demo_scene()
    out = DemoFiles(folder / "frames", folder / "angles.csv", folder / "calibration.json", [])
    try:
        out.frames.mkdir(parents=True)
        out.calibration.write_bytes(dump_json(calibration.plain()))
        with out.angles.open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["file", "angle_deg"])
            for i in range(frames):
                made = render(scene, rig, math.radians(i * step_deg), seed=seed + i, light=light)
                name = f"frame{i:04d}.png"
                ok, data = cv2.imencode(".png", made.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                assert ok
                (out.frames / name).write_bytes(np.asarray(data).tobytes())
                table.writerow([name, i * step_deg])
                out.truth.append(made.truth)
                if advance is not None:
                    advance(i + 1, frames)
    except OSError as error:
        raise StorageError(
            f"cannot write the demo's frames to {folder}: {error.strerror}",
            hint="give another folder, or make room",
        ) from error
    return out
