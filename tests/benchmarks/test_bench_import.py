"""Importing photographs, against decoding each of them once: nothing can check them for less."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.image_sources import find_images
from turnscan.ingest.poses import poses_by_step
from turnscan.store import Archive

pytestmark = pytest.mark.benchmark

FRAMES = 400
ROUNDS = 3
TARGET = 1.5


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(0)
    noise = rng.normal(12, 2, (480, 640))
    x, row = np.arange(640), np.arange(480)[:, None]
    for i in range(FRAMES):
        stripe = 180 * np.exp(-((x - 300 - 0.1 * i - 0.05 * row) ** 2) / 6.5)
        frame = np.clip(np.rint(np.roll(noise, i, axis=1) + stripe), 0, 255).astype(np.uint8)
        assert cv2.imwrite(str(folder / f"img{i}.png"), frame)
    return find_images([folder])[0]


def test_import_of_pngs(photos: list[Path], tmp_path: Path) -> None:
    poses = poses_by_step(photos, step_deg=360 / FRAMES)
    number = itertools.count()

    def decode() -> None:
        for path in photos:
            assert cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), -1) is not None

    def bring_in() -> None:
        archive = Archive.init(tmp_path / f"lab{next(number)}")
        assert import_images(archive, ImportPlan(poses, rig="r")).frames == FRAMES

    best: dict[tuple[str, str], float] = {}
    for again in range(ROUNDS + 1):
        for name, work in (("decode", decode), ("import", bring_in)):
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            taken = {"wall": time.perf_counter() - wall, "CPU": time.process_time() - cpu}
            # The first round warms caches and imports modules.
            for clock, seconds in taken.items() if again else ():
                best[name, clock] = min(best.get((name, clock), np.inf), seconds)
    print()
    for clock in ("wall", "CPU"):
        ratio = best["import", clock] / best["decode", clock]
        print(f"  import {FRAMES} PNGs / decode them once, {clock}: {ratio:.2f}   target {TARGET}")
        assert ratio < 3 * TARGET
