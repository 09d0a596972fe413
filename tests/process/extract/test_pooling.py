"""Pooled rows: less noise on straight stripes, and depth edges where they were."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import bound_px, line, stripe_frame

from turnscan.process.extract import STRIPE_DTYPE, extract_stripe
from turnscan.process.extract.pooling import pooled


def points(u: np.ndarray, sigma: float | np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
    out = np.zeros(len(u), STRIPE_DTYPE)
    out["row"] = np.arange(len(u)) if rows is None else rows
    out["u_px"], out["sigma_u_px"] = u, sigma
    return out


def test_straight_stripes_reach_0_57_of_the_bound() -> None:
    truth = line(1500, 60.0, 0.031)
    frame = stripe_frame(truth, noise=2.0)
    found = extract_stripe(frame, pool_rows=3)
    error = found["u_px"] - truth
    assert len(found) == 1500
    assert 0.54 < float(error.std()) / bound_px(180.0, 2.0, 2.0) < 0.62
    assert 0.9 < float((error / found["sigma_u_px"]).std()) < 1.1


@settings(max_examples=60, deadline=None)
@given(
    sigma=st.lists(st.floats(0.01, 2.0), min_size=3, max_size=3),
    slope=st.floats(-5.0, 5.0),
    offset=st.floats(0.0, 1e3),
)
def test_a_line_stays_a_line_whatever_the_weights(
    sigma: list[float], slope: float, offset: float
) -> None:
    given_ = points(offset + slope * np.arange(3), np.array(sigma))
    found = pooled(given_)
    assert found["u_px"] == pytest.approx(given_["u_px"], abs=1e-9)
    assert found["sigma_u_px"][1] <= sigma[1]
    # Weighted least squares, by NumPy.
    design = np.stack([np.ones(3), np.array([-1.0, 0.0, 1.0])], axis=1) / np.array(sigma)[:, None]
    expected = math.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    assert found["sigma_u_px"][1] == pytest.approx(expected, rel=1e-6)


def test_equal_deviations_give_the_mean() -> None:
    found = pooled(points(np.array([10.0, 10.3, 10.0, 10.1]), 0.2))
    assert found["u_px"] == pytest.approx([10.0, 10.1, (10.3 + 10.0 + 10.1) / 3, 10.1])
    assert found["sigma_u_px"] == pytest.approx([0.2, 0.2 / 3**0.5, 0.2 / 3**0.5, 0.2])


def test_a_depth_edge_is_not_bent() -> None:
    truth = np.where(np.arange(200) < 100, 60.0, 90.0) + line(200, 0.0, 0.013)
    frame = stripe_frame(truth, noise=2.0)
    plain, found = extract_stripe(frame), extract_stripe(frame, pool_rows=3)
    edge = slice(99, 101)
    assert np.array_equal(plain["u_px"][edge], found["u_px"][edge])
    assert np.array_equal(plain["sigma_u_px"][edge], found["sigma_u_px"][edge])
    assert np.abs(found["u_px"] - truth).max() < 0.08


def test_a_kink_is_not_rounded() -> None:
    truth = 60.0 + np.abs(np.arange(200) - 100.0) * 0.2
    frame = stripe_frame(truth, noise=2.0)
    plain, found = extract_stripe(frame), extract_stripe(frame, pool_rows=3)
    assert plain["u_px"][100] == found["u_px"][100]
    assert np.abs(found["u_px"] - truth).max() < 0.08


def test_a_bend_too_small_to_be_seen_moves_the_centre_by_a_third_of_it() -> None:
    found = pooled(points(np.array([10.0, 10.0, 10.08, 10.16]), 0.02))
    assert found["u_px"][1] == pytest.approx(10.0 + 0.08 / 3)
    # 3.5 sqrt(6) sigma = 0.171 is the largest bend that is pooled.
    assert pooled(points(np.array([10.0, 10.0, 10.18]), 0.02))["u_px"][1] == 10.0


def test_gaps_ends_and_unknown_deviations_stay_as_they_are() -> None:
    given_ = points(
        np.array([1.0, 2.0, 3.5, 4.0, 5.5]),
        np.array([1.0, 1.0, 1.0, np.nan, 1.0]),
        np.array([0, 1, 3, 4, 5]),
    )
    found = pooled(given_)
    assert found["u_px"].tolist() == given_["u_px"].tolist()
    for n in range(3):
        assert len(pooled(given_[:n])) == n
    assert found is not given_
