"""Processing, against a 3x3 median of the frame, against reading the log, against hashing."""

from __future__ import annotations

import os
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
from turnscan.schemas.tables import POINTS
from turnscan.store import Archive
from turnscan.store.table_file import TableFile

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
    """On one thread (CPU time), and by the wall clock with threads beside it."""
    archive = Archive.init(tmp_path / "lab")
    count = 400
    scan = add_scan(archive, frames(10, width, height) * (count // 10))
    (summary,) = archive.scans()

    def read() -> None:
        for frame in archive.log(scan).frames():
            frame.decode()

    def work(name: str, overlap: bool) -> None:
        (outcome,) = derive(archive, [summary], BUILT_IN[name], overlap=overlap)
        assert outcome.error is None, outcome.error
        assert outcome.frames == count

    works = {
        "read": read,
        "default": lambda: work("default", overlap=False),
        "default, overlapped": lambda: work("default", overlap=True),
        "paper": lambda: work("paper", overlap=False),
        "paper, overlapped": lambda: work("paper", overlap=True),
    }
    best = {name: (float("inf"), float("inf")) for name in works}
    for _ in range(6):
        for name, it in works.items():
            began = time.process_time(), time.perf_counter()
            it()
            now = time.process_time(), time.perf_counter()
            cpu, wall = (n - b for n, b in zip(now, began, strict=True))
            best[name] = min(best[name][0], cpu), min(best[name][1], wall)
            _forget(archive)
    cpu, wall = best["read"]
    print(f"\n{width} x {height}; reading the log takes {cpu * 1e3 / count:.2f} ms a frame")
    target = 1.6 if width == 640 else 1.3
    what = "log to STRIPES and POINTS"
    show(f"{what} / reading, one thread, CPU", best["default"][0] / cpu, target)
    show(f"{what} / reading, one thread, wall clock", best["default"][1] / wall)
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    show(f"{what} / reading, overlapped, wall", best["default, overlapped"][1] / wall, 1.0, load)
    show("the same by the recipe paper, one thread, CPU", best["paper"][0] / cpu)
    ratio = best["paper, overlapped"][1] / best["paper"][1]
    show("recipe paper, wall clock, overlapped / one thread", ratio)


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


def _forget(archive: Archive, kind: str = "") -> None:
    """Remove what was derived (of ``kind``): a table that is gone is derived again."""
    for path in (archive.root / "derived" / kind).rglob("k-*"):
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
    """A recalibration: STRIPES read, POINTS sealed, against the same files read and written alone."""
    archive = Archive.init(tmp_path / "lab")
    add_scan(archive, frames(10, 1280, 1024) * 40)
    (summary,) = archive.scans()
    assert [o.error for o in derive(archive, [summary], BUILT_IN["default"])] == [None]
    (plan,) = archive.plan([summary], BUILT_IN["default"])
    assert plan.stripes is not None
    assert plan.points is not None
    made = list(archive.read(plan.points))
    rows = plan.points.rows
    files = iter(range(1000))

    def recalibrate() -> None:
        (outcome,) = derive(archive, [summary], BUILT_IN["default"], overlap=False)
        assert outcome.derived == ("points",)
        assert outcome.points == rows

    def read_and_write() -> None:
        assert sum(b.num_rows for b in archive.read(plan.stripes)) == rows
        with TableFile(tmp_path / f"{next(files)}.parquet", POINTS) as file:
            for batch in made:
                file.take(batch)
            file.finish({})()

    chain = PointChain(plan.recipe, plan.calibration)
    batches = [columns_of(b) for b in archive.read(plan.stripes)]
    works = {
        "recalibrate": recalibrate,
        "read and write": read_and_write,
        "points": lambda: [chain.points(b) for b in batches],
    }
    took = best_cpu(works, 6, lambda: _forget(archive, "points"))
    speed = rows / took["recalibrate"] / 1e6
    print(f"\n{rows} points: {speed:.1f} M points/s from STRIPES to sealed POINTS, wanted 3")
    print(f"  the geometry and its deviations alone: {took['points'] * 1e9 / rows:.0f} ns a point")
    ratio = took["recalibrate"] / took["read and write"]
    show("recalibrating / reading one file, writing the other", ratio, 2.0)


def test_two_workers_against_one(tmp_path: Path) -> None:
    """Scans of 100 frames, every stage of them; two processes begin anew each time."""
    archive = Archive.init(tmp_path / "lab")
    images = frames(10, 640, 480) * 10
    for _ in range(60):
        add_scan(archive, images)
    scans = archive.scans()
    seconds = {1: float("inf"), 2: float("inf")}
    for turn in range(4):
        workers = 1 + turn % 2
        began = time.perf_counter()
        outcomes = list(derive(archive, scans, BUILT_IN["default"], workers=workers, overlap=False))
        seconds[workers] = min(seconds[workers], time.perf_counter() - began)
        assert all(o.error is None for o in outcomes)
        _forget(archive)
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    ratio = seconds[1] / seconds[2]
    print(f"\n60 scans: one thread / two workers {ratio:.2f}, wanted 1.7 of two free cores; {load}")
