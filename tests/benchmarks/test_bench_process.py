"""Processing, against a 3x3 median of the frame, against reading the log, against hashing."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from bench import add_scan, best_cpu, calibration, frames, show

from turnscan.process.batches import columns_of
from turnscan.process.denoise import denoise
from turnscan.process.extract import extract_stripe
from turnscan.process.pipeline import derive
from turnscan.process.stages import PointChain
from turnscan.process.undistort import FrameUndistorter
from turnscan.schemas.recipe import BUILT_IN, Denoise
from turnscan.store import Archive

pytestmark = pytest.mark.benchmark

SIZES = [(640, 480), (1280, 1024)]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    cv2.setNumThreads(1)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_stages_against_a_median(width: int, height: int) -> None:
    (frame,) = frames(1, width, height)
    undistort = FrameUndistorter(calibration(width, height).intrinsics_or_fail())
    works = {
        "limit": lambda: cv2.medianBlur(frame, 3),
        "undistort frame": lambda: undistort(frame),
        "denoise median": lambda: denoise(frame, Denoise(method="median")),
        "denoise gaussian-median": lambda: denoise(frame, Denoise(method="gaussian-median")),
        f"triangulate {height} points": _triangulation(width, height, frame),
    }
    took = best_cpu(works, 15)
    print(f"\n{width} x {height}; cv2.medianBlur(frame, 3) takes {took['limit'] * 1e3:.2f} ms")
    for name in list(works)[1:]:
        show(f"{name} / median", took[name] / took["limit"])


def _triangulation(width: int, height: int, frame: np.ndarray):
    chain = PointChain(BUILT_IN["default"], calibration(width, height))
    found = extract_stripe(frame, "centroid")
    n = len(found)
    assert n > 0.9 * height
    stripes = {name: found[name] for name in found.dtype.names}
    stripes |= {"frame": np.zeros(n, np.uint32), "laser": np.zeros(n, np.uint8)}
    stripes |= {"angle_rad": np.full(n, 0.3, np.float32)}
    return lambda: chain.points(stripes)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_whole_chain_against_reading(tmp_path: Path, width: int, height: int) -> None:
    """CPU time on all threads, and the wall clock, which has the second core to decompress ahead."""
    archive = Archive.init(tmp_path / "lab")
    count = 400
    scan = add_scan(archive, frames(10, width, height) * (count // 10))
    (summary,) = archive.scans()
    best = {name: (float("inf"), float("inf")) for name in ("read", "default", "paper")}

    def took(name: str, began: tuple[float, float]) -> None:
        now = time.process_time(), time.perf_counter()
        cpu, wall = (n - b for n, b in zip(now, began, strict=True))
        best[name] = min(best[name][0], cpu), min(best[name][1], wall)

    for _ in range(3):
        began = time.process_time(), time.perf_counter()
        for frame in archive.log(scan).frames():
            frame.decode()
        took("read", began)
        for name in ("default", "paper"):
            began = time.process_time(), time.perf_counter()
            (outcome,) = derive(archive, [summary], BUILT_IN[name])
            took(name, began)
            assert outcome.error is None, outcome.error
            assert outcome.frames == count
            _forget(archive)
    cpu, wall = best["read"]
    print(f"\n{width} x {height}; reading the log takes {cpu * 1e3 / count:.2f} ms a frame")
    target = 1.6 if width == 640 else 1.3
    for name in ("default", "paper"):
        wanted = target if name == "default" else None
        show(f"log to STRIPES and POINTS, {name} / reading, CPU", best[name][0] / cpu, wanted)
        show(f"log to STRIPES and POINTS, {name} / reading, wall clock", best[name][1] / wall)


def test_real_frames_against_a_median(test_data: Path) -> None:
    """Stripes that are no Gaussian, or clipped nearly everywhere."""
    for name, pattern in {"srv_turntable": "scan/*.jpg", "etna": "*.png"}.items():
        found = sorted((test_data / name).glob(pattern))
        shown = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in found[:8]]
        works = {
            "limit": lambda shown=shown: [cv2.medianBlur(f, 3) for f in shown],
            "fused": lambda shown=shown: [extract_stripe(f) for f in shown],
        }
        took = best_cpu(works, 5)
        show(f"fused / median on real frames, {name}", took["fused"] / took["limit"])


def _forget(archive: Archive) -> None:
    """Remove what was derived: a table that is gone is derived again."""
    for path in (archive.root / "derived").rglob("k-*"):
        path.unlink()
    archive.rebuild_catalog()


def test_second_process_against_hashing_the_manifests(tmp_path: Path) -> None:
    archive = Archive.init(tmp_path / "lab")
    images = frames(1, 64, 48)
    scans = 100
    for _ in range(scans):
        add_scan(archive, images)
    summaries = archive.scans()
    outcomes = list(derive(archive, summaries, BUILT_IN["default"]))
    assert all(len(o.derived) == 2 for o in outcomes)
    manifests = sorted((archive.root / "derived").rglob("k-*.json"))
    assert len(manifests) == 2 * scans

    def plan() -> None:
        assert not any(o.derived for o in derive(archive, archive.scans(), BUILT_IN["default"]))

    def look() -> None:
        for path in manifests:
            path.stat()
            path.read_bytes()

    took = best_cpu({"plan": plan, "look": look}, 10)
    print(f"\nsecond process of {scans} scans: {took['plan'] * 1e3:.1f} ms CPU, nothing to do")
    show("planning / stat and read of the manifests", took["plan"] / took["look"])


def test_points_from_sealed_stripes(tmp_path: Path) -> None:
    archive = Archive.init(tmp_path / "lab")
    add_scan(archive, frames(10, 640, 480) * 10)
    (summary,) = archive.scans()
    assert [o.error for o in derive(archive, [summary], BUILT_IN["default"])] == [None]
    (plan,) = archive.plan([summary], BUILT_IN["default"])
    chain = PointChain(plan.recipe, plan.calibration)
    batches = [columns_of(b) for b in archive.read(plan.stripes)]
    rows = sum(len(b["row"]) for b in batches)
    took = best_cpu(
        {
            "read": lambda: sum(b.num_rows for b in archive.read(plan.stripes)),
            "points": lambda: [chain.points(b) for b in batches],
        },
        10,
    )
    print(f"\n{rows} stripe points; reading STRIPES takes {took['read'] * 1e9 / rows:.0f} ns a point")
    show("triangulate with deviations / reading STRIPES", took["points"] / took["read"])
