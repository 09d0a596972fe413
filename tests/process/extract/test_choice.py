"""Rows with several stripes: which is chosen, and that hot pixels, ends and steps do not mislead."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import line, stripe_frame

from turnscan.process.extract import extract_stripe
from turnscan.process.extract.choice import choose_peaks
from turnscan.schemas.errors import UsageError
from turnscan.schemas.tables import Flag

ROWS = np.arange(300)
#: The stripe, and a reflection left of it that swings, breaks off and is brighter for a while.
STRIPE = 300.0 + 40.0 * np.sin(ROWS / 60.0)
OTHER = STRIPE - 120.0 + 20.0 * np.sin(ROWS / 15.0)
THERE = ROWS % 100 < 80
BRIGHT = ROWS % 100 < 20


def two_stripes(impulses: float = 0.0, noise: float = 2.0, dtype: str = "u1") -> np.ndarray:
    main = stripe_frame(STRIPE, amplitude=120.0, noise=noise, columns=480, dtype="f8")
    tall = np.where(BRIGHT, 190.0, 70.0) * THERE
    other = stripe_frame(OTHER, amplitude=tall, background=0.0, columns=480, dtype="f8")
    frame = np.clip(np.rint(main + other), 0, 255)
    rng = np.random.default_rng(5)
    struck = rng.random(frame.shape) < impulses
    frame[struck] = rng.integers(0, 2, int(struck.sum())) * 255
    return frame.astype(dtype)


def wrong(frame: np.ndarray, truth: np.ndarray, choice: str, **more: object) -> tuple[int, np.ndarray]:
    """How many rows have another peak than the truth's, and the peaks' second-stripe marks."""
    peak, second = choose_peaks(frame, 0, frame.shape[1], 30.0, choice, **more)  # type: ignore[arg-type]
    assert (peak >= 0).all()
    return int((np.abs(peak - truth) > 2).sum()), second


@pytest.mark.parametrize("dtype", ["u1", "f8"])
def test_first_nearest_and_continuous(dtype: str) -> None:
    frame = two_stripes(dtype=dtype)
    assert wrong(frame, np.where(THERE, OTHER, STRIPE), "first")[0] == 0
    assert wrong(frame, STRIPE, "nearest", expected_px=STRIPE + 25.0)[0] == 0
    assert wrong(frame, np.where(THERE, OTHER, STRIPE), "nearest", expected_px=100.0)[0] == 0
    assert wrong(frame, STRIPE, "continuous")[0] == 0


def test_rows_with_another_stripe_half_as_bright_are_ambiguous() -> None:
    _, second = wrong(two_stripes(noise=0.5), STRIPE, "continuous")
    # 70 DN are more than half of 120; where the other one is chosen, 120 are more than half of 190.
    assert second.tolist() == THERE.tolist()


@pytest.mark.parametrize(
    ("choice", "truth"), [("first", np.where(THERE, OTHER, STRIPE)), ("continuous", STRIPE)]
)
def test_hot_pixels_are_no_stripe(choice: str, truth: np.ndarray) -> None:
    assert wrong(two_stripes(impulses=0.001), truth, choice)[0] == 0
    # With one pixel in a hundred struck, three of five neighbours are in about one row of a thousand.
    assert wrong(two_stripes(impulses=0.01), truth, choice)[0] <= 6


def test_a_bright_start_elsewhere_does_not_lead_the_path_away() -> None:
    main = stripe_frame(STRIPE, amplitude=100.0, noise=2.0, columns=480)
    blob = stripe_frame(np.full(300, 60.0), amplitude=np.where(ROWS < 12, 230.0, 0.0), columns=480)
    frame = np.maximum(main, blob)
    assert wrong(frame, STRIPE, "continuous")[0] == 0


def test_a_depth_edge_is_followed() -> None:
    truth = np.where(ROWS < 150, 200.0, 300.0)
    frame = stripe_frame(truth, noise=2.0, columns=480)
    for choice in ("first", "continuous"):
        assert wrong(frame, truth, choice)[0] == 0


@pytest.mark.parametrize("choice", ["first", "continuous"])
@pytest.mark.parametrize(("width", "slope"), [(0.6, 0.05), (1.0, 1.5), (2.0, 3.0), (15.0, 0.1)])
def test_narrow_steep_and_wide_stripes_are_candidates(choice: str, width: float, slope: float) -> None:
    truth = line(100, 60.0, slope)
    frame = stripe_frame(truth, width=width, noise=2.0, columns=480)
    peak, _ = choose_peaks(frame, 0, 480, 30.0, choice)
    near = np.abs(peak - truth) < 2.0 + width
    assert near[peak >= 0].all()
    assert (peak >= 0).mean() > 0.9


def test_rows_without_a_stripe_have_none() -> None:
    frame = stripe_frame(np.full(300, -500.0), noise=4.0, background=60.0, columns=640)
    for choice, expected in (("first", None), ("nearest", 300.0), ("continuous", None)):
        peak, second = choose_peaks(frame, 0, 640, 30.0, choice, expected)
        assert (peak == -1).all()
        assert not second.any()


def test_nothing_is_expected_where_the_expectation_is_nan() -> None:
    expected = np.where(ROWS < 100, np.nan, STRIPE)
    peak, _ = choose_peaks(two_stripes(), 0, 480, 30.0, "nearest", expected)
    assert (peak[:100] == -1).all()
    assert (np.abs(peak - STRIPE)[100:] < 2).all()


def test_the_search_window_holds() -> None:
    peak, _ = choose_peaks(two_stripes(), 240, 480, 30.0, "first")
    assert (np.abs(peak - STRIPE) <= 2).all()


def test_through_the_public_function() -> None:
    frame = two_stripes()
    for choice, more in (("continuous", {}), ("nearest", {"expected_px": STRIPE})):
        found = extract_stripe(frame, choice=choice, **more)
        assert len(found) == 300
        assert np.abs(found["u_px"] - STRIPE).max() < 0.2
        assert ((found["flags"] & Flag.SECOND) > 0).mean() > 0.7
    turned = extract_stripe(frame.T, choice="nearest", expected_px=STRIPE, orientation="horizontal")
    assert np.abs(turned["u_px"] - STRIPE).max() < 0.2


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (2, 3), (40, 1)])
def test_tiny_frames_do_no_harm(shape: tuple[int, int]) -> None:
    for choice, expected in (("first", None), ("nearest", 0.0), ("continuous", None)):
        peak, _ = choose_peaks(np.zeros(shape, np.uint8), 0, shape[1], 30.0, choice, expected)
        assert (peak == -1).all()


def test_bad_expectations_are_named() -> None:
    frame = np.zeros((4, 9), np.uint8)
    with pytest.raises(UsageError, match="choice is 'guess'"):
        choose_peaks(frame, 0, 9, 30.0, "guess")
    with pytest.raises(UsageError, match=r"shape \(3,\), expected one number or \(4,\)"):
        choose_peaks(frame, 0, 9, 30.0, "nearest", np.zeros(3))
    with pytest.raises(UsageError, match="no number"):
        choose_peaks(frame, 0, 9, 30.0, "nearest", float("nan"))
    with pytest.raises(UsageError, match="needs expected_px"):
        choose_peaks(frame, 0, 9, 30.0, "nearest")
