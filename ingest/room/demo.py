"""The demo's room and scanner, and its frames as files: the paper's situation, with known truth."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...schemas.calibration import Calibration
from ...schemas.document import dump_json
from ...schemas.errors import StorageError
from ...schemas.scene import Light, Sensor
from .built_in import room_calibration, room_document
from .render import Truth, render
from .rig import SimulatedRig
from .scene import Scene

FRAMES = 180
STEP_DEG = 2.0


def demo_scene() -> Scene:
    """The demo's room, ready for rays."""
    return Scene(room_document().shapes)


def demo_calibration() -> Calibration:
    """The demo's scanner: the paper's."""
    return room_calibration()


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
    sensor: Sensor | None = None,
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
                angle = math.radians(i * step_deg)
                made = render(scene, rig, angle, seed=seed, frame=i, light=light, sensor=sensor)
                name = f"frame{i:04d}.png"
                ok, data = cv2.imencode(".png", made.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                assert ok
                (out.frames / name).write_bytes(np.asarray(data).tobytes())
                table.writerow([name, i * step_deg])
                out.truth.append(made.truth[0])
                if advance is not None:
                    advance(i + 1, frames)
    except OSError as error:
        raise StorageError(
            f"cannot write the demo's frames to {folder}: {error.strerror}",
            hint="give another folder, or make room",
        ) from error
    return out
