"""Real files that cameras are tested on: image sequences and bit-exact FFV1 videos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.generic]

SHAPE = (48, 64)


def noise(count: int, encoding: str, *, shape: tuple[int, int] = SHAPE) -> list[Image]:
    """Frames of which no two are equal, using every bit of the format."""
    rng = np.random.default_rng(7)
    dtype = np.uint16 if encoding == "mono16" else np.uint8
    full = (*shape, 3) if encoding == "bgr8" else shape
    return [
        rng.integers(0, np.iinfo(dtype).max, full, dtype=dtype, endpoint=True) for _ in range(count)
    ]


def write_sequence(folder: Path, frames: list[Image], suffix: str = ".png") -> Path:
    """frame0, frame1, ... frame10: names whose alphabetical order is wrong."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"frame{i}{suffix}"), frame)
    return folder


def write_ffv1(path: Path, frames: list[Image]) -> Path:
    """A .mkv that gives back every bit."""
    height, width = frames[0].shape[:2]
    params = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(frames[0].ndim == 3)]
    if frames[0].dtype == np.uint16:
        params += [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U]
    fourcc = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (width, height), params)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path
