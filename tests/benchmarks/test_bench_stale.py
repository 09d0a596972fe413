"""A thousand small scans after a recalibration: planning, two workers against one; comparing."""

from __future__ import annotations

import math
import os
import time
from multiprocessing import forkserver
from pathlib import Path

import numpy as np
import pytest
from bench import add_scan, best_cpu, calibration, frames, show

from turnscan.process.compare import Shifts, sum_shifts
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive

pytestmark = pytest.mark.benchmark

SCANS = 1000
RECIPE = BUILT_IN["paper"]


def archive_of(folder: Path, count: int) -> Archive:
    archive = Archive.init(folder / "lab")
    images = frames(1, 64, 48)
    for _ in range(count):
        add_scan(archive, images)
    return archive


def recalibrate(archive: Archive, k1: float) -> None:
    """Certify another lens: the recipe undistorts frames, so that all has to be derived again."""
    c = calibration(64, 48)
    camera = c.intrinsics_or_fail().model_copy(update={"distortion": (k1, 0.0, 0.0, 0.0, 0.0)})
    archive.certify(archive.add_calibration(c.model_copy(update={"camera": camera})))


def test_planning_a_thousand_scans(tmp_path: Path) -> None:
    archive = archive_of(tmp_path, 1000)
    recalibrate(archive, -0.2)

    def plan() -> None:
        plans = list(archive.plan(archive.scans(), RECIPE))
        assert len(plans) == 1000
        assert not any(isinstance(p, Exception) or p.done for p in plans)

    def look() -> None:
        # The least that anybody must do: find and parse what is known of each scan.
        assert len(archive.scans()) == 1000

    took = best_cpu({"plan": plan, "look": look}, 5)
    print(f"\nplanning 1,000 stale scans: {took['plan']:.2f} s CPU, wanted below 1 s")
    show("planning 1,000 scans / reading their summaries", took["plan"] / took["look"])
    show("planning 1,000 scans / 1 s", took["plan"], 1.0)


def test_two_workers_against_one(tmp_path: Path) -> None:
    archive = archive_of(tmp_path, SCANS)
    scans = archive.scans()
    seconds, cpu = {1: math.inf, 2: math.inf}, {1: math.inf, 2: math.inf}
    for turn in range(4):
        workers = 1 + turn % 2
        recalibrate(archive, -0.2 - 0.01 * turn)
        began, used = time.perf_counter(), _cpu_of_all()
        outcomes = list(derive(archive, scans, RECIPE, workers=workers))
        seconds[workers] = min(seconds[workers], time.perf_counter() - began)
        cpu[workers] = min(cpu[workers], _cpu_of_all() - used)
        assert all(len(o.derived) == 2 for o in outcomes)
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    print(f"\n{SCANS} scans: {seconds[1]:.1f} s by one worker, {seconds[2]:.1f} s by two; {load}")
    print(f"  one worker / two workers: {seconds[1] / seconds[2]:.2f}, wanted 1.8 of two free cores")
    # Other work on the machine falls on wall time; what two workers cost more than one does not hide.
    show("CPU time of two workers / of one", cpu[2] / cpu[1], 1.3, "two interpreters start")


def _cpu_of_all() -> float:
    """CPU seconds of this process, of the one that workers are forked from, and of ended workers."""
    server: int | None = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    used = 0.0
    if server is not None:
        # Fields 14 to 17: its own time and its ended children's, in user and in system mode.
        ticks = Path(f"/proc/{server}/stat").read_text().rpartition(") ")[2].split()[11:15]
        used = sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
    t = os.times()
    return used + t.user + t.system


def test_comparing_against_reading() -> None:
    rng = np.random.default_rng(4)
    n, size = 2_000_000, 262_144
    at = np.arange(n)
    base = {"frame": (at // 1000).astype(np.uint32), "row": (at % 1000).astype(np.uint16)}
    base |= {"laser": np.zeros(n, np.uint8)}
    names = ("x_mm", "y_mm", "z_mm", "range_mm")
    first = base | {m: rng.uniform(500, 5000, n).astype(np.float32) for m in names}
    second = base | {m: first[m] + np.float32(0.5) for m in names}

    def batches(columns: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
        return [{m: v[i : i + size] for m, v in columns.items()} for i in range(0, n, size)]

    one, two = batches(first), batches(second)

    def compare() -> None:
        shifts = Shifts()
        sum_shifts(iter(one), iter(two), shifts)
        assert shifts.statistics().matched == n

    def touch() -> None:
        assert all(np.isfinite(c[m].sum()) for c in (*one, *two) for m in names)

    took = best_cpu({"compare": compare, "touch": touch}, 3)
    print(f"\ncomparing 2 M points: {n / took['compare'] / 1e6:.1f} M points/s")
    show("comparing / summing the columns once", took["compare"] / took["touch"])
