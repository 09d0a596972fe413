"""Steger's ridge against a slow implementation, straight from the formulas of his paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
from synthetic import bound_px, line, stripe_frame

from turnscan.process.extract import extract_stripe
from turnscan.process.extract.steger import derivatives, kernel_px
from turnscan.schemas.tables import Flag


def papers_ridge(frame: np.ndarray, sigma: float, row: int) -> list[tuple[float, float, float]]:
    """(px, py, u at the row) of every ridge point whose pixel lies in ``row``: |px|, |py| <= 1/2.

    Section 3 of Steger 1998: the five derivatives by plain double sums with kernels integrated over the
    pixels, n by a general eigenvalue solver, and formula (19) for t.
    """

    def phi(x: float) -> float:
        return 0.5 * (1.0 + math.erf(x / (sigma * math.sqrt(2.0))))

    def g(x: float) -> float:
        return math.exp(-(x**2) / (2.0 * sigma**2)) / (math.sqrt(2.0 * math.pi) * sigma)

    def g1(x: float) -> float:
        return -x / sigma**2 * g(x)

    reach = math.ceil(6.0 * sigma)
    at = range(-reach, reach + 1)
    smooth = {k: phi(k + 0.5) - phi(k - 0.5) for k in at}
    first = {k: g(k + 0.5) - g(k - 0.5) for k in at}
    second = {k: g1(k + 0.5) - g1(k - 0.5) for k in at}

    def convolved(x: int, y: int, along_x: dict[int, float], along_y: dict[int, float]) -> float:
        # Convolution: the kernel runs against the frame.
        return sum(along_x[i] * along_y[j] * float(frame[y - j, x - i]) for i in at for j in at)

    peak = int(frame[row].argmax())
    found = []
    for x in range(peak - 3, peak + 4):
        rx, ry = convolved(x, row, first, smooth), convolved(x, row, smooth, first)
        rxx, ryy = convolved(x, row, second, smooth), convolved(x, row, smooth, second)
        rxy = convolved(x, row, first, first)
        values, vectors = np.linalg.eigh(np.array([[rxx, rxy], [rxy, ryy]]))
        i = int(np.abs(values).argmax())
        if values[i] >= 0:
            continue
        nx, ny = vectors[:, i]
        t = -(rx * nx + ry * ny) / (rxx * nx**2 + 2.0 * rxy * nx * ny + ryy * ny**2)
        px, py = t * nx, t * ny
        if abs(px) <= 0.5 and abs(py) <= 0.5:
            # The line runs along (-ny, nx) through (x + px, row + py).
            found.append((px, py, x + px + py * ny / nx))
    return found


@pytest.mark.parametrize(
    ("slope", "width", "noise"), [(0.05, 2.0, 0.0), (0.4, 2.0, 2.0), (-0.8, 1.3, 4.0)]
)
def test_ridge_points_are_those_of_the_papers_formulas(
    slope: float, width: float, noise: float
) -> None:
    frame = stripe_frame(line(60, 80.0, slope), width=width, noise=noise, columns=200)
    found = extract_stripe(frame, "steger")
    # The kernel follows the stripe's width in the frame, which the other methods report as well.
    sigma = kernel_px(float(np.median(found["width_px"])))
    assert sigma >= 1.177 * width / math.sqrt(3.0)
    compared = 0
    for row in range(20, 40):
        points = papers_ridge(frame, sigma, row)
        mine = found["u_px"][found["row"] == row]
        assert len(mine) == 1
        if points:
            compared += 1
            # The kernels end at four standard deviations here, and at six there.
            assert min(abs(mine[0] - u) for _, _, u in points) < 2e-4
    assert compared >= 14


def test_kernels_are_a_gaussians_derivatives() -> None:
    for sigma in (1.0, 2.3, 7.0):
        table = derivatives(sigma)
        x = np.arange(table.shape[1]) - table.shape[1] // 2
        assert table.sum(axis=1) == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
        # On 1, x and x^2 / 2 they act like smoothing and derivatives.
        assert (table[1] * x).sum() == pytest.approx(1.0, rel=2e-3)
        assert (table[2] * x**2).sum() / 2.0 == pytest.approx(1.0, rel=2e-3)
        assert (table[0] * x**2).sum() == pytest.approx(sigma**2 + 1.0 / 12.0, rel=2e-3)


def test_the_point_belongs_to_its_own_row() -> None:
    """On a slanted stripe the ridge point lies beside the row; reported is the stripe at the row."""
    truth = line(120, 40.0, 0.7)
    frame = stripe_frame(truth, columns=200, noise=1.0)
    found = extract_stripe(frame, "steger")
    inner = (found["row"] > 10) & (found["row"] < 110)
    error = (found["u_px"] - truth[found["row"]])[inner]
    assert np.abs(error).max() < 0.05
    assert abs(float(error.mean())) < 0.005


def test_smoothing_along_the_stripe_beats_the_single_row_bound_where_it_is_straight() -> None:
    truth = line(800, 60.0)
    frame = stripe_frame(truth, noise=2.0, columns=200)
    found = extract_stripe(frame, "steger")
    inner = (found["flags"] & Flag.EDGE) == 0
    error = (found["u_px"] - truth)[inner]
    assert 0.35 < float(error.std()) / bound_px(180.0, 2.0, 2.0) < 0.75
    assert 0.85 < float((error / found["sigma_u_px"][inner]).std()) < 1.15


def test_the_deviation_admits_steps_and_curves() -> None:
    truth = np.where(np.arange(80) < 40, 60.0, 66.0) + line(80, 0.0)
    found = extract_stripe(stripe_frame(truth, noise=1.0), "steger")
    error = np.abs(found["u_px"] - truth[found["row"]])
    near = (found["row"] > 34) & (found["row"] < 45)
    # A step is rounded off, and the rows beside it say so.
    assert error[near].max() > 0.5
    assert found["sigma_u_px"][near & (error > 0.5)].min() > 0.1
    assert np.median(found["sigma_u_px"][~near]) < 0.02
    bent = 80.0 + 0.5 * 0.02 * (np.arange(80) - 40.0) ** 2
    found = extract_stripe(stripe_frame(bent, noise=1.0), "steger")
    inner = slice(10, 70)
    pull = ((found["u_px"] - bent) / found["sigma_u_px"])[inner]
    assert np.sqrt(np.mean(pull**2)) < 1.4


def test_rows_at_the_frames_ends_are_flagged_and_uncertain() -> None:
    truth = line(60, 60.0, 0.5)
    found = extract_stripe(stripe_frame(truth), "steger")
    reach = 2.0 * kernel_px(float(np.median(found["width_px"])))
    flagged = ((found["flags"] & Flag.EDGE) > 0).tolist()
    assert flagged == [min(r, 59 - r) < reach for r in range(60)]
    error = np.abs(found["u_px"] - truth)
    assert error[0] > 0.1
    assert (error < 3.0 * found["sigma_u_px"])[:4].all()
