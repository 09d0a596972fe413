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
from turnscan.process.extract import METHODS, extract_stripe
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
        **{f"extract {m}": lambda m=m: extract_stripe(frame, m) for m in METHODS},
        "extract centroid, horizontal": lambda: extract_stripe(
            frame.T, "centroid", orientation="horizontal"
        ),
        "extract centroid, less background": lambda: extract_stripe(
            frame, "centroid", background=frame
        ),
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
    archive = Archive.init(tmp_path / "lab")
    count = 40
    scan = add_scan(archive, frames(10, width, height) * (count // 10))
    (summary,) = archive.scans()
    best = {"read": float("inf"), "default": float("inf"), "paper": float("inf")}
    for _ in range(3):
        began = time.process_time()
        for frame in archive.log(scan).frames():
            frame.decode()
        best["read"] = min(best["read"], time.process_time() - began)
        for name in ("default", "paper"):
            began = time.process_time()
            (outcome,) = derive(archive, [summary], BUILT_IN[name])
            best[name] = min(best[name], time.process_time() - began)
            assert outcome.error is None, outcome.error
            assert outcome.frames == count
            _forget(archive)
    print(f"\n{width} x {height}; reading the log takes {best['read'] * 1e3 / count:.2f} ms a frame")
    for name in ("default", "paper"):
        show(f"log to STRIPES and POINTS, {name} / reading", best[name] / best["read"])


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
