"""Small logs for the tests of this folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from turnscan.schemas.events import Exposure, LaserState, ScanEnd, ScanStart, TurntableAngle
from turnscan.store.log_writer import LogWriter


def images(count: int, shape: tuple[int, ...] = (4, 6), dtype: str = "u1") -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    return [rng.integers(0, np.iinfo(dtype).max, shape).astype(dtype) for _ in range(count)]


def write_log(
    path: Path, frames: list[np.ndarray], *, chunk_bytes: int = 1 << 20, flush: bool = False
) -> Path:
    """A whole log: start, a laser, and for each frame its angle, exposure and image, then the end."""
    with LogWriter(path, chunk_bytes=chunk_bytes) as writer:
        writer.write_event(
            ScanStart(
                t_ns=100, scan="s-x", rig="r", source="test", time_source="clock", software="test"
            )
        )
        writer.write_event(LaserState(t_ns=100, laser=0, on=True))
        for i, image in enumerate(frames):
            t_ns = 1000 + 10 * i
            writer.write_event(TurntableAngle(t_ns=t_ns, commanded_rad=0.01 * i))
            writer.write_image(Exposure(t_ns=t_ns + 1, frame=i, lasers_on=(0,)), image)
            if flush:
                writer.flush()
        writer.write_event(ScanEnd(t_ns=10**6, ended="complete", frames=len(frames)))
    return path
