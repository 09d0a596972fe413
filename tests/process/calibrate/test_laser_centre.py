"""The paper's section 3.1.1: exact on exact triangles, its sigma against repeats, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.process.calibrate.laser_centre import Reading, centre_behind_face, gain_at
from turnscan.schemas.errors import CalibrationError


def find(*pairs: tuple[float, float], distance: float = 1.0, length: float = 0.5):
    readings = [Reading(a, s) for a, s in pairs]
    return centre_behind_face(readings, sigma_distance_mm=distance, sigma_length_mm=length)


@given(
    behind=st.floats(-40, 120),
    near=st.floats(100, 900),
    ratio=st.floats(1.3, 12),
    opening=st.floats(0.1, 2.0),
)
def test_similar_triangles_are_solved_exactly(
    behind: float, near: float, ratio: float, opening: float
) -> None:
    far = ratio * (near + behind) - behind
    found = find((near, opening * (near + behind)), (far, opening * (far + behind)))
    assert found.behind_mm == pytest.approx(behind, abs=1e-6 * far)
    assert found.ratio == pytest.approx(ratio, rel=1e-9)


def test_two_readings_follow_the_closed_form() -> None:
    a, b, s, t = 500.0, 2000.0, 230.0, 865.0
    found = find((a, s), (b, t))
    r = t / s
    assert found.behind_mm == pytest.approx((s * b - t * a) / (t - s))
    variance = ((b - a) / (s * (r - 1) ** 2)) ** 2 * (r**2 + 1) * 0.25 + (r**2 + 1) / (r - 1) ** 2
    assert found.sigma_mm == pytest.approx(np.sqrt(variance))
    assert np.isnan(found.reduced_chi2)


@pytest.mark.parametrize("places", [(500.0, 2000.0), (400.0, 900.0, 1600.0, 2500.0)])
def test_sigma_is_what_repeats_scatter(places: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    off = []
    for _ in range(600):
        pairs = [(a + rng.normal(0, 1.0), 0.43 * (a + 31.0) + rng.normal(0, 0.5)) for a in places]
        found = find(*pairs)
        off.append((found.behind_mm - 31.0) / found.sigma_mm)
    assert 0.9 < np.std(off) < 1.1
    assert abs(np.mean(off)) < 0.15


def test_the_larger_t_over_s_the_better() -> None:
    gains = [gain_at(r) for r in (1.5, 2.0, 3.0, 5.0, 10.0, 1000.0)]
    assert gains == sorted(gains, reverse=True)
    assert gains[-1] == pytest.approx(1.0, abs=2e-3)
    sigma = [find((500.0, 215.0), (b, 0.43 * b)).sigma_mm for b in (800.0, 1500.0, 4000.0)]
    assert sigma == sorted(sigma, reverse=True)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (((500.0, 230.0),), "1 reading given"),
        (((500.0, 230.0), (500.0, 231.0)), "all readings are from 500 mm"),
        (((500.0, 230.0), (2000.0, 200.0)), "not longer farther away"),
        (((500.0, 230.0), (-2000.0, 800.0)), "positive"),
        (((500.0, 10.0), (510.0, 300.0)), "before the front face, more"),
        (((400.0, 185.0), (900.0, 400.0), (1600.0, 760.0), (2500.0, 1088.0)), "contradict"),
    ],
)
def test_impossible_readings_are_refused(pairs: tuple[tuple[float, float], ...], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        find(*pairs)
