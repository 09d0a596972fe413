"""Boards, calibration, scan, truth: the stated uncertainty is the true one, in five seeded runs.

tests/benchmarks/test_bench_chain.py does the same a hundred times. The criterion: rendered_chain.py.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from rendered_chain import Run, run

SEEDS = range(5)
#: Of so many of them everything is adjusted together as well, which takes three times as long.
REFINED = 2


@cache
def runs() -> tuple[Run, ...]:
    return tuple(run(seed, refined=seed < REFINED) for seed in SEEDS)


def test_the_truth_is_recovered_within_the_stated_two_sigma() -> None:
    recovered = [r.recovered() for r in runs()]
    each = {"intrinsics", "plane/0", "axis", "ranges"}
    assert set(recovered[0]) == each | {f"refined {what}" for what in each}
    assert all(len(r.ranges) == 4 for r in runs())
    for what in recovered[0]:
        assert sum(not found.get(what, True) for found in recovered) <= 1, what
    # Five runs are few, but an error of four stated sigmas is none of chance.
    assert all(abs(j.sigmas) < 4.0 for r in runs() for j in (*r.ranges, *r.refined))
    shares = [s for r in runs() for s in (*r.parts.values(), *r.refined_parts.values())]
    assert max(shares) < 0.9999


def test_the_stated_sigma_is_not_larger_than_it_need_be() -> None:
    """An estimate can be within its sigmas because they are absurd: these are useful ones."""
    for each in ([j for r in runs() for j in r.ranges], [j for r in runs() for j in r.refined]):
        assert 0.3 < np.sqrt(np.mean([j.sigmas**2 for j in each])) < 1.7
    for r in runs():
        assert all(j.sigma_mm < 6e-6 * j.range_mm**2 / 4.0 + 0.5 for j in r.ranges)


def test_what_camera_and_plane_have_in_common_counts() -> None:
    """As if they were independent, the sigma is many times too large: most of both errors cancels."""
    for r in runs():
        for together, apart in zip(r.ranges, r.apart, strict=True):
            assert apart.mean_error_mm == together.mean_error_mm
            assert apart.sigma_mm > 1.5 * together.sigma_mm
    assert (
        np.median(
            [a.sigma_mm / t.sigma_mm for r in runs() for a, t in zip(r.apart, r.ranges, strict=True)]
        )
        > 3.0
    )
