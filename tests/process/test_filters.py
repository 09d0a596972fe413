"""Grey conversion and denoising against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from turnscan.process.denoise import denoise
from turnscan.process.grey import to_grey
from turnscan.process.stages import FrameChain
from turnscan.schemas.errors import InputError
from turnscan.schemas.recipe import Denoise, Extract, Grey, Recipe, Triangulate, Window

RNG = np.random.default_rng(2)
COLOUR = RNG.integers(0, 256, (12, 15, 3)).astype(np.uint8)
GREY = RNG.integers(0, 256, (20, 30)).astype(np.uint8)


def test_channels_are_blue_green_red() -> None:
    for i, mode in enumerate(("blue", "green", "red")):
        assert np.array_equal(to_grey(COLOUR, Grey(mode=mode)), COLOUR[:, :, i])
    assert np.array_equal(to_grey(COLOUR, Grey(mode="max")), COLOUR.max(axis=2))


def test_luma_is_bt601() -> None:
    b, g, r = (COLOUR[:, :, i].astype(float) for i in range(3))
    assert np.abs(to_grey(COLOUR, Grey()) - (0.299 * r + 0.587 * g + 0.114 * b)).max() <= 0.51


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_weights_and_differences_clip(dtype: type) -> None:
    top = np.iinfo(dtype).max
    frame = np.array([[[0, 0, top], [top, top, top], [0, top, 0]]], dtype)
    assert to_grey(frame, Grey(mode="red-minus-others")).tolist() == [[top, 0, 0]]
    weights = Grey(mode="weights", weights=(2.0, -1.0, 0.0))
    assert to_grey(frame, weights).tolist() == [[top, top, 0]]


def test_grey_passes_and_alpha_is_left_out() -> None:
    assert to_grey(GREY, Grey(mode="red")) is GREY
    with_alpha = np.dstack([COLOUR, np.zeros(COLOUR.shape[:2], np.uint8)])
    assert np.array_equal(to_grey(with_alpha, Grey()), to_grey(COLOUR, Grey()))
    with pytest.raises(InputError, match="neither grey nor colour"):
        to_grey(np.zeros((2, 2, 2), np.uint8), Grey())


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gaussian_is_formula_12(dtype: type) -> None:
    frame = GREY.astype(dtype) * (1 if dtype is np.uint8 else 250)
    f = np.pad(frame.astype(float), 1, mode="reflect")
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16
    expected = sum(
        kernel[i, j] * f[i : i + frame.shape[0], j : j + frame.shape[1]]
        for i in range(3)
        for j in range(3)
    )
    assert np.abs(denoise(frame, Denoise(method="gaussian")) - expected).max() <= 0.51


@pytest.mark.parametrize("size", [3, 5])
def test_median_is_the_median(size: int) -> None:
    half = size // 2
    out = denoise(GREY, Denoise(method="median", median_size_px=size))
    for i in range(half, GREY.shape[0] - half):
        for j in range(half, GREY.shape[1] - half):
            window = GREY[i - half : i + half + 1, j - half : j + half + 1]
            assert out[i, j] == np.median(window)


def test_both_orders_are_both_filters() -> None:
    median, gaussian = Denoise(method="median"), Denoise(method="gaussian")
    a = denoise(GREY, Denoise(method="gaussian-median"))
    b = denoise(GREY, Denoise(method="median-gaussian"))
    assert np.array_equal(a, denoise(denoise(GREY, gaussian), median))
    assert np.array_equal(b, denoise(denoise(GREY, median), gaussian))
    assert denoise(GREY, Denoise(method="none")) is GREY


def test_inputs_are_not_altered() -> None:
    before = GREY.copy()
    for method in ("gaussian", "median", "gaussian-median", "median-gaussian"):
        denoise(GREY, Denoise(method=method))
    assert np.array_equal(GREY, before)


def test_colour_without_a_grey_stage_is_refused() -> None:
    recipe = Recipe(name="x", stages=(Extract(), Triangulate()))
    with pytest.raises(InputError, match="no grey stage"):
        FrameChain(recipe, None).extract(COLOUR, (0,))


def test_two_lasers_in_one_frame_need_windows() -> None:
    frame = np.zeros((10, 400), np.uint8)
    frame[:, 100:104] = 200
    frame[:, 300:304] = 250
    plain = FrameChain(Recipe(name="x", stages=(Extract(), Triangulate())), None)
    with pytest.raises(InputError, match="nothing tells their stripes apart"):
        plain.extract(frame, (0, 1))
    windows = (Window(laser=0, from_px=0, to_px=200), Window(laser=1, from_px=200, to_px=400))
    step = Extract(method="centroid", windows=windows)
    found = dict(
        FrameChain(Recipe(name="x", stages=(step, Triangulate())), None).extract(frame, (0, 1))
    )
    assert found[0]["u_px"] == pytest.approx(np.full(10, 101.5))
    assert found[1]["u_px"] == pytest.approx(np.full(10, 301.5))
