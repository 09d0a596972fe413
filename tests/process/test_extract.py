"""Extraction: against closed forms, a direct implementation of the paper, and the Cramer-Rao bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.process.extract import METHODS, STRIPE_DTYPE, extract_stripe
from turnscan.process.extract.search import noise_dn
from turnscan.schemas.errors import InputError, UsageError
from turnscan.schemas.recipe import METHOD_VERSIONS
from turnscan.schemas.tables import STRIPES, Flag


def gaussian_frame(
    centre: np.ndarray,
    *,
    amplitude: float = 150.0,
    width: float = 2.5,
    background: float = 10.0,
    noise: float = 0.0,
    columns: int = 160,
    seed: int = 0,
    dtype: str = "u1",
) -> np.ndarray:
    """Rows with a Gaussian stripe, integrated over the pixels, rounded and clipped to the type."""
    edges = np.arange(columns + 1) - 0.5
    erf = np.vectorize(math.erf)
    steps = np.diff(erf((edges - centre[:, None]) / (width * math.sqrt(2))), axis=1)
    clean = background + amplitude * width * math.sqrt(math.pi / 2) * steps
    noisy = clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)
    return np.clip(np.rint(noisy), 0, np.iinfo(dtype).max).astype(dtype)


def centres(n: int, columns: int = 160, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(45, columns - 45, n)


def papers_algorithm(row: np.ndarray, g_base: float) -> float:
    """Section 3.2.2, step by step, for one row; nan where it gives nothing."""
    best = None
    worst = None
    for i in range(len(row) - 1):
        if row[i] > g_base or row[i + 1] > g_base:
            gradient = float(row[i + 1]) - float(row[i])
            if best is None or gradient > best[0]:
                best = (gradient, i)
            if worst is None or gradient < worst[0]:
                worst = (gradient, i + 1)
    if best is None or worst is None:
        return math.nan
    x = [i for i in range(best[1], worst[1] + 1) if row[i] > g_base]
    if len(x) < 3:
        return math.nan
    design = np.stack([np.ones(len(x)), np.array(x, float), np.array(x, float) ** 2], axis=1)
    # Householder's method, as in the paper: numpy's QR.
    q, r = np.linalg.qr(design)
    a = np.linalg.solve(r, q.T @ np.log(row[x].astype(float)))
    return float(-a[1] / (2 * a[2]))


def test_columns_are_those_of_the_table() -> None:
    names = [c.name for c in STRIPES.columns]
    assert set(STRIPE_DTYPE.names or ()) == set(names) - {"frame", "t_ns", "laser", "angle_rad"}


def test_every_method_has_a_version() -> None:
    assert set(METHODS) == set(METHOD_VERSIONS)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_clean_rows_give_their_centre(method: str, dtype: str) -> None:
    truth = centres(200)
    scale = 1.0 if dtype == "u1" else 250.0
    frame = gaussian_frame(truth, amplitude=200 * scale, background=10 * scale, dtype=dtype)
    found = extract_stripe(frame, method, base_dn=30 * scale)
    assert found["row"].tolist() == list(range(200))
    tolerance = {"argmax": 0.56, "centroid": 0.04, "varied-boundary": 0.2}[method]
    assert np.abs(found["u_px"] - truth).max() < tolerance
    assert found["amplitude_dn"] == pytest.approx(np.full(200, 200 * scale), rel=0.06)
    assert found["background_dn"] == pytest.approx(np.full(200, 10 * scale), abs=scale)
    if method != "varied-boundary":
        assert found["width_px"] == pytest.approx(np.full(200, 2.5), rel=0.1)
    assert not found["flags"].any()


@pytest.mark.parametrize("method", METHODS)
def test_horizontal_is_vertical_transposed(method: str) -> None:
    frame = gaussian_frame(centres(60), noise=2.0)
    a = extract_stripe(frame, method)
    b = extract_stripe(np.ascontiguousarray(frame.T), method, orientation="horizontal")
    assert np.array_equal(a["row"], b["row"])
    assert np.allclose(a["u_px"], b["u_px"], equal_nan=True)


def test_varied_boundary_is_the_papers_algorithm() -> None:
    frame = gaussian_frame(centres(300), noise=2.0, background=0.0, amplitude=180.0)
    found = extract_stripe(frame, "varied-boundary", base_dn=30.0)
    rows = {int(p["row"]): p["u_px"] for p in found}
    direct = {i: papers_algorithm(row, 30.0 + np.median(row)) for i, row in enumerate(frame)}
    assert len(rows) > 290
    for row, u in rows.items():
        assert u == pytest.approx(direct[row], abs=1e-9)


@pytest.mark.parametrize(
    ("method", "low", "high"), [("centroid", 1.0, 1.45), ("varied-boundary", 1.25, 1.5)]
)
def test_noise_is_a_known_multiple_of_the_cramer_rao_bound(
    method: str, low: float, high: float
) -> None:
    """sigma_u = 1.062 sqrt(w) sqrt(s^2 + 1/12) / A is the bound for a Gaussian stripe."""
    truth = centres(6000)
    amplitude, width, noise = 150.0, 2.5, 2.0
    frame = gaussian_frame(truth, amplitude=amplitude, width=width, noise=noise, background=0.0)
    # A background of zero is clipped there; lift the frame so that noise stays Gaussian.
    frame = gaussian_frame(truth, amplitude=amplitude, width=width, noise=noise, background=12.0)
    found = extract_stripe(frame, method)
    error = found["u_px"] - truth[found["row"]]
    bound = 1.062 * math.sqrt(width) * math.sqrt(noise**2 + 1 / 12) / amplitude
    rmse = float(np.sqrt(np.mean(error**2)))
    assert low < rmse / bound < high
    assert len(found) == 6000


def test_the_centroids_own_deviation_is_honest() -> None:
    truth = centres(6000)
    for noise, width in ((0.0, 2.5), (1.0, 1.5), (1.0, 2.5), (4.0, 2.5), (2.0, 5.0)):
        frame = gaussian_frame(truth, noise=noise, width=width, background=20.0)
        found = extract_stripe(frame, "centroid")
        error = found["u_px"] - truth[found["row"]]
        ratio = float(np.std(error) / np.sqrt(np.mean(found["sigma_u_px"] ** 2)))
        assert 0.7 < ratio < 1.15, (noise, width)


@settings(max_examples=40, deadline=None)
@given(shift=st.integers(-30, 30), method=st.sampled_from(METHODS))
def test_whole_pixel_shifts_shift_the_centre(shift: int, method: str) -> None:
    frame = gaussian_frame(np.linspace(75, 85, 30), noise=2.0, background=15.0)
    moved = np.roll(frame, shift, axis=1)
    a, b = extract_stripe(frame, method), extract_stripe(moved, method)
    assert np.array_equal(a["row"], b["row"])
    assert np.allclose(a["u_px"] + shift, b["u_px"], atol=1e-9)


def test_rows_without_a_stripe_give_no_point() -> None:
    frame = gaussian_frame(centres(100), noise=3.0, background=20.0)
    frame[40:60] = gaussian_frame(np.full(20, -500.0), noise=3.0, background=20.0, seed=9)
    for method in METHODS:
        assert not set(extract_stripe(frame, method)["row"]) & set(range(40, 60))
    empty = gaussian_frame(np.full(400, -500.0), noise=4.0, background=60.0)
    assert len(extract_stripe(empty, "centroid")) == 0
    assert len(extract_stripe(np.zeros((5, 50), np.uint8), "centroid")) == 0


def test_clipped_stripes_are_centred_by_their_flanks_and_flagged() -> None:
    truth = centres(300)
    frame = gaussian_frame(truth, amplitude=900.0, width=4.0, noise=2.0)
    found = extract_stripe(frame, "centroid")
    assert (found["flags"] & Flag.SATURATED).all()
    assert np.abs(found["u_px"] - truth[found["row"]]).max() < 0.25
    paper = extract_stripe(frame, "varied-boundary")
    assert np.abs(paper["u_px"] - truth[paper["row"]]).max() < 5.0


def test_a_second_stripe_is_flagged_and_the_brighter_one_taken() -> None:
    truth = np.full(50, 60.3)
    frame = gaussian_frame(truth, columns=300, amplitude=180.0, background=5.0)
    other = gaussian_frame(np.full(50, 220.0), columns=300, amplitude=120.0, background=5.0)
    both = np.maximum(frame, other)
    found = extract_stripe(both, "centroid")
    assert found["u_px"] == pytest.approx(truth, abs=0.05)
    assert (found["flags"] & Flag.SECOND).all()
    assert not (extract_stripe(frame, "centroid")["flags"] & Flag.SECOND).any()
    right = extract_stripe(both, "centroid", from_px=150)
    assert right["u_px"] == pytest.approx(np.full(50, 220.0), abs=0.05)


def test_a_stripe_at_the_border_is_flagged() -> None:
    found = extract_stripe(gaussian_frame(np.array([1.0, 158.5, 80.0])), "centroid")
    assert [bool(f & Flag.EDGE) for f in found["flags"]] == [True, True, False]


def test_a_weak_stripe_is_flagged() -> None:
    frame = gaussian_frame(centres(200), amplitude=60.0, noise=12.0, background=60.0)
    found = extract_stripe(frame, "centroid", base_dn=20.0)
    assert (found["flags"] & Flag.WEAK).mean() > 0.9


def test_the_background_frame_takes_away_what_does_not_move() -> None:
    truth = centres(80)
    stripe = gaussian_frame(truth, amplitude=90.0, background=0.0).astype(int)
    scene = np.random.default_rng(4).integers(0, 140, stripe.shape)
    on, off = (scene + stripe).astype(np.uint8), scene.astype(np.uint8)
    found = extract_stripe(on, "centroid", background=off, noise=1.0)
    assert np.abs(found["u_px"] - truth[found["row"]]).max() < 0.1
    assert len(found) == 80


def test_noise_is_found_beside_the_stripe() -> None:
    for sigma in (1.0, 3.0, 8.0):
        frame = gaussian_frame(centres(400), noise=sigma, background=60.0)
        assert noise_dn(frame) == pytest.approx(math.hypot(sigma, 12**-0.5), rel=0.12)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (np.zeros((4, 4, 3), np.uint8), r"shape \(4, 4, 3\), expected \(H, W\)"),
        (np.zeros((0, 4), np.uint8), "shape"),
        (np.zeros((4, 4)), "float64, expected uint8 or uint16"),
    ],
)
def test_frames_that_are_none_are_refused(frame: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        extract_stripe(frame)


def test_bad_arguments_are_named() -> None:
    frame = np.zeros((4, 9), np.uint8)
    with pytest.raises(UsageError, match="no extraction method 'guess'; there are: argmax"):
        extract_stripe(frame, "guess")
    with pytest.raises(UsageError, match="orientation is 'slanted'"):
        extract_stripe(frame, orientation="slanted")
    with pytest.raises(InputError, match="window from 9 to 9 px holds nothing of a frame of 9 px"):
        extract_stripe(frame, from_px=9)
    with pytest.raises(InputError, match="background frame is"):
        extract_stripe(frame, background=np.zeros((4, 8), np.uint8))


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (3, 1), (2, 200)])
@pytest.mark.parametrize("method", METHODS)
def test_tiny_frames_do_no_harm(shape: tuple[int, int], method: str) -> None:
    for value in (0, 255):
        extract_stripe(np.full(shape, value, np.uint8), method)


def test_noise_of_sixteen_bits_is_no_stripe() -> None:
    frame = np.random.default_rng(3).normal(2000, 150, (300, 200)).astype(np.uint16)
    assert len(extract_stripe(frame, "centroid")) <= 3
