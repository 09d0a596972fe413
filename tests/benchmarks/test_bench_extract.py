"""Extraction against its two limits: the Cramer-Rao bound, and a 3x3 median of the frame.

    pytest -m benchmark -s tests/benchmarks/test_bench_extract.py

TURNSCAN_SEED picks other frames (default 1).
"""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from bench import best_cpu, calibration, frames, show
from stripes import CASES, STEP, empty

from turnscan.process.extract import METHODS, extract_stripe
from turnscan.process.stages import PointChain
from turnscan.process.stripe_columns import StripeColumns
from turnscan.schemas.recipe import BUILT_IN

pytestmark = pytest.mark.benchmark

SEED = int(os.environ.get("TURNSCAN_SEED", "1"))
FRAMES = 20


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    cv2.setNumThreads(1)


@pytest.mark.parametrize("method", METHODS)
def test_accuracy_against_the_bound(method: str) -> None:
    print(
        f"\n{method}: {FRAMES} frames of 640 x 480 each, seed {SEED}; errors as multiples of the bound"
    )
    print(f"  {'case':<20s} {'rmse':>7s} {'phase':>7s} {'sigma':>7s} {'> 1 px':>8s} {'missing':>8s}")
    for name, case in CASES.items():
        errors, pulls, phases, gross, missing = [], [], [], 0, 0
        for i in range(FRAMES):
            frame, u = case.frame(1000 * SEED + i)
            found = extract_stripe(frame, method)
            error = found["u_px"] - u[found["row"]]
            good = np.abs(error) < 1.0
            errors.append((error / case.bound_px(u)[found["row"]])[good])
            pulls.append((error / found["sigma_u_px"])[good])
            phases.append((u[found["row"]] % 1.0)[good])
            gross += int((~good).sum())
            missing += len(u) - len(found)
        error, pull, phase = (np.concatenate(a) for a in (errors, pulls, phases))
        bins = [error[(phase * 8).astype(int) == k].mean() for k in range(8)]
        rmse, bias = float(np.sqrt((error**2).mean())), float(np.abs(bins).max())
        rows = FRAMES * 480
        print(
            f"  {name:<20s} {rmse:7.3f} {bias:7.3f} {float(pull.std()):7.3f} "
            f"{100 * gross / rows:7.3f}% {100 * missing / rows:7.3f}%"
        )
        if method == "fused":
            limit = 1.10 if name == "saturated" else 1.03
            assert rmse <= limit + 3 / np.sqrt(2 * rows), name
            assert 0.9 <= pull.std() <= 1.1, name
            assert gross <= 1e-4 * rows, name
            assert missing <= 1e-3 * rows, name


def test_no_points_on_empty_rows() -> None:
    rows = found = 0
    for name, case in CASES.items():
        for i in range(60):
            found += len(extract_stripe(empty(case, 5000 * SEED + i)))
            rows += 480
        print(f"  {name}: {found} points on {rows} empty rows so far")
    assert found <= 1e-5 * rows + 2


def test_steps_and_salt() -> None:
    """The rows beside a 30 px step, dim stripes and salt: where smoothing along the stripe bends it."""
    print(f"\nrms in px, all rows and the 10 rows about the step, seed {SEED}")
    for method in METHODS:
        words = []
        for name, case in STEP.items():
            errors, beside = [], []
            for i in range(FRAMES):
                frame, u = case.frame(7000 * SEED + i)
                found = extract_stripe(frame, method)
                error = found["u_px"] - u[found["row"]]
                errors.append(error)
                beside.append(error[np.abs(found["row"].astype(int) - 240) <= 5])
            both = [float(np.sqrt((np.concatenate(e) ** 2).mean())) for e in (errors, beside)]
            words.append(f"{name} {both[0]:.3f}" + (f" ({both[1]:.3f})" if case.step_px else ""))
        print(f"  {method:<16s} " + ", ".join(words))


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1280, 1024)])
def test_speed_against_a_median(width: int, height: int) -> None:
    """Each work takes the same eight frames one by one, as a scan does; points come together."""
    shown = frames(8, width, height)
    bright = [np.clip(f.astype(int) * 4 - 40, 0, 255).astype(np.uint8) for f in shown]
    salt = [STEP["0.1 % salt"].frame(SEED + i, width, height)[0] for i in range(8)]
    lying = [np.ascontiguousarray(f.T) for f in shown]
    dark = [f // 10 for f in shown]
    chain = PointChain(BUILT_IN["default"], calibration(width, height))

    def to_scene() -> object:
        """As a scan is derived: points of many frames together, with the deviation of their range."""
        columns = StripeColumns()
        for n, f in enumerate(shown):
            columns.add(extract_stripe(f), frame=n, t_ns=n, angle_rad=0.3, laser=0)
        return [chain.points(part) for part in columns.rest()]

    works = {
        "limit": lambda: [cv2.medianBlur(f, 3) for f in shown],
        "fused": lambda: [extract_stripe(f) for f in shown],
        "fused, one frame again and again": lambda: [extract_stripe(shown[0]) for _ in shown],
        "fused, points undistorted and triangulated": to_scene,
        "fused, all rows saturated": lambda: [extract_stripe(f) for f in bright],
        "fused, 0.1 % salt": lambda: [extract_stripe(f) for f in salt],
        "fused, horizontal": lambda: [extract_stripe(f, orientation="horizontal") for f in lying],
        "fused, less background": lambda: [
            extract_stripe(f, background=d) for f, d in zip(shown, dark, strict=True)
        ],
        **{m: lambda m=m: [extract_stripe(f, m) for f in shown] for m in METHODS if m != "fused"},
    }
    targets = {
        "fused": 1.0,
        "fused, one frame again and again": 1.0,
        "fused, points undistorted and triangulated": 1.15 if width == 640 else 0.9,
        "fused, all rows saturated": 3.0,
        "steger": 60.0,
    }
    took = best_cpu(works, 40)
    print(f"\n{width} x {height}; cv2.medianBlur(frame, 3) takes {took['limit'] * 1e6 / 8:.0f} us")
    for name in list(works)[1:]:
        target = targets.get(name, None if name.startswith("fused") else 15.0)
        show(f"{name} / median", took[name] / took["limit"], target)
