"""What the benchmarks share: CPU time of interleaved rounds, frames, and an archive of them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.store import Archive
from turnscan.store.log_writer import LogWriter

Work = Callable[[], object]


def best_cpu(works: Mapping[str, Work], rounds: int, between: Work = lambda: None) -> dict[str, float]:
    """Least CPU seconds (user and system) of each of ``works``, after one turn to warm up.

    The rounds are interleaved, so that whatever else the machine does falls on all of them alike.
    ``between`` is called before each work and not counted.
    """
    best = dict.fromkeys(works, float("inf"))
    for turn in range(rounds + 1):
        for name, work in works.items():
            between()
            began = time.process_time()
            work()
            took = time.process_time() - began
            if turn:
                best[name] = min(best[name], took)
    return best


def show(what: str, ratio: float, target: float | None = None, note: str = "") -> None:
    """Print one figure; fail when it is three times its target or more."""
    wanted = "no target" if target is None else f"target {target:g}"
    print(f"  {what:<58s} {ratio:8.2f}   {wanted}{'   ' + note if note else ''}")
    assert target is None or ratio < 3 * target


def frames(count: int, width: int, height: int) -> list[np.ndarray]:
    """A Gaussian stripe across all rows, elsewhere in each frame, under noise of 2 DN."""
    rng = np.random.default_rng(7)
    x = np.arange(width)
    out = []
    for i in range(count):
        centre = width * (0.4 + 0.2 * i / count) + 0.03 * np.arange(height)[:, None]
        frame = 12 + 180 * np.exp(-((x - centre) ** 2) / 2 / 2.5**2)
        noisy = frame + rng.normal(0, 2, (height, width))
        out.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return out


def calibration(width: int, height: int) -> Calibration:
    return Calibration(
        rig="r1",
        camera=Intrinsics(
            width_px=width,
            height_px=height,
            fx_px=1.2 * width,
            fy_px=1.2 * width,
            cx_px=width / 2,
            cy_px=height / 2,
            distortion=(-0.1, 0.02, 0.001, 0.0, 0.0),
        ),
        lasers=(LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=150.0),),
        turntable=TurntableAxis(point_mm=(0, 0, 180), direction=(0, -1, 0)),
    )


def write_log(path: Path, images: list[np.ndarray], *, scan: str = "s-x") -> None:
    """A whole log as a recorder writes it: start, calibration, an angle for each frame, end; synced."""
    height, width = images[0].shape
    with LogWriter(path) as writer:
        writer.write_event(
            ScanStart(t_ns=0, scan=scan, rig="r1", source="test", time_source="given", software="test")
        )
        writer.write_calibration(calibration(width, height), 0)
        for i, image in enumerate(images):
            t_ns = 1_000_000 * (i + 1)
            writer.write_event(TurntableAngle(t_ns=t_ns, commanded_rad=0.01 * i))
            writer.write_image(Exposure(t_ns=t_ns, frame=i, lasers_on=(0,)), image)
        writer.write_event(ScanEnd(t_ns=t_ns, ended="complete", frames=len(images)))


def add_scan(archive: Archive, images: list[np.ndarray]) -> str:
    """Seal a scan of ``images`` and return its id."""
    with archive.new_scan() as draft:
        write_log(draft.part, images, scan=draft.scan)
        return archive.seal(draft, draft.examine()).scan


def write_raw(path: Path, pieces: list[np.ndarray]) -> None:
    """The least that keeps the same bytes: write them to a new file, and fsync it."""
    with path.open("xb", buffering=0) as file:
        for piece in pieces:
            file.write(piece.data.cast("B"))
        os.fsync(file.fileno())
