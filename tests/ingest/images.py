"""Small image files for the tests of this folder."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.image_sources import find_images
from turnscan.ingest.poses import Pose, poses_by_step
from turnscan.schemas.manifests import ScanSummary
from turnscan.store import Archive
from turnscan.store.log_reader import LogFrame

Pixels = npt.NDArray[np.generic]

SHAPE = (48, 64)


def pixels(seed: int = 0, *, channels: int = 1, dtype: str = "uint8") -> Pixels:
    """Noise, so that no two images are equal and every byte of a file matters."""
    rng = np.random.default_rng(seed)
    shape = SHAPE if channels == 1 else (*SHAPE, channels)
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def encoded(image: Pixels, suffix: str, *params: int) -> bytes:
    ok, data = cv2.imencode(suffix, image, list(params))
    assert ok
    return bytes(data)


def write_images(folder: Path, count: int, suffix: str = ".png", *, first_seed: int = 0) -> list[Path]:
    """img0, img1, ... in natural order."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for i in range(count):
        out.append(folder / f"img{i}{suffix}")
        out[-1].write_bytes(encoded(pixels(first_seed + i), suffix))
    return out


def oriented(jpeg: bytes, orientation: int) -> bytes:
    """The JPEG with an Exif segment that says how it should be turned."""
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    tiff = b"MM\0*" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def run_import(
    archive: Archive, source: Path | list[Pose], **plan: object
) -> tuple[ScanSummary, list[object]]:
    """Import a folder (a degree a frame) or poses; the scan, and all items of its log."""
    poses = source
    if isinstance(source, Path):
        poses = poses_by_step(find_images([source])[0], step_deg=1.0)
    summary = import_images(archive, ImportPlan(poses, **{"rig": "r1", **plan}))
    return summary, list(archive.log(summary.scan).items())


def frames(items: list[object]) -> list[LogFrame]:
    return [i for i in items if isinstance(i, LogFrame)]
