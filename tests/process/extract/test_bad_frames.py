"""Frames that are not what they should be: an error, a flagged row or none; never a wrong number."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from turnscan.process.extract import extract_stripe
from turnscan.schemas.errors import InputError, UsageError
from turnscan.schemas.tables import Flag


def stripe(
    place: float = 100.3,
    *,
    rows: int = 120,
    columns: int = 240,
    amplitude: float = 180.0,
    width: float = 2.0,
    noise: float = 2.0,
    seed: int = 0,
) -> npt.NDArray[np.uint8]:
    clean = 20.0 + amplitude * np.exp(-0.5 * ((np.arange(columns) - place) / width) ** 2)
    noisy = clean + noise * np.random.default_rng(seed).standard_normal((rows, columns))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (np.zeros((4, 4, 3), np.uint8), r"shape \(4, 4, 3\), expected \(H, W\)"),
        (np.zeros(4, np.uint8), r"shape \(4,\), expected \(H, W\)"),
        (np.zeros((0, 4), np.uint8), r"shape \(0, 4\)"),
        (np.zeros((4, 0), np.uint8), r"shape \(4, 0\)"),
        (np.zeros((4, 4), np.int32), "int32, expected uint8, uint16 or floating point"),
        (np.zeros((4, 4), bool), "bool, expected uint8"),
        (np.zeros((4, 4), complex), "complex128, expected"),
        ([[1, 2], [3, 4]], "list, expected an array"),
        (np.zeros((70000, 1), np.uint8), "rows and columns go up to 65535"),
    ],
)
def test_what_is_no_frame_is_refused(frame: npt.NDArray[np.generic], message: str) -> None:
    with pytest.raises(InputError, match=message):
        extract_stripe(frame)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_numbers_that_are_none_are_named_with_their_place(value: float, dtype: str) -> None:
    frame = stripe().astype(dtype)
    frame[7, 11] = value
    with pytest.raises(InputError, match="row 7, column 11"):
        extract_stripe(frame)
    with pytest.raises(InputError, match=r"background frame .* row 7, column 11"):
        extract_stripe(stripe().astype(dtype), background=frame)


def test_a_background_of_another_size_or_type_is_refused() -> None:
    frame = stripe()
    for other in (
        frame[:-1],
        frame[:, :-1],
        frame.astype(np.uint16),
        frame.astype(np.float32),
        frame.T,
    ):
        with pytest.raises(InputError, match="the background frame is"):
            extract_stripe(frame, background=other)


@pytest.mark.parametrize("saturation", [-5.0, 0.0, 256.0, 1e9, float("nan")])
def test_a_saturation_level_that_cannot_be_is_refused(saturation: float) -> None:
    with pytest.raises(InputError, match="saturation_dn"):
        extract_stripe(stripe(), saturation_dn=saturation)


@pytest.mark.parametrize(
    ("given_px", "message"),
    [((240, None), "from 240 to 240"), ((50, 50), "from 50"), ((-3, 40), "from -3")],
)
def test_a_window_without_pixels_is_refused(given_px: tuple[int, int | None], message: str) -> None:
    with pytest.raises(InputError, match=message):
        extract_stripe(stripe(), from_px=given_px[0], to_px=given_px[1])


def test_numbers_out_of_their_range_are_refused() -> None:
    for base_dn in (-1.0, float("nan")):
        with pytest.raises(UsageError, match="base_dn"):
            extract_stripe(stripe(), base_dn=base_dn)
    for width in (0.0, -1.0, 401.0, float("nan")):
        with pytest.raises(UsageError, match="max_width_px"):
            extract_stripe(stripe(), max_width_px=width)


@pytest.mark.parametrize(
    "shape", [(1, 1), (1, 3), (3, 1), (2, 2), (1, 640), (640, 1), (5, 7), (2, 64), (3, 63)]
)
@pytest.mark.parametrize("dtype", ["u1", "u2", "f4", "f8"])
def test_tiny_dark_and_full_frames_give_nothing(shape: tuple[int, int], dtype: str) -> None:
    full = {"u1": 255, "u2": 65535}.get(dtype, 1.0)
    for value in (0, full):
        frame = np.full(shape, value, dtype)
        assert len(extract_stripe(frame)) == 0
        assert len(extract_stripe(frame, background=frame, orientation="horizontal")) == 0


@settings(max_examples=150, deadline=None)
@given(
    frame=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=40)),
    horizontal=st.booleans(),
)
def test_whatever_is_given_points_lie_in_the_frame(
    frame: npt.NDArray[np.uint8],
    horizontal: bool,
) -> None:
    found = extract_stripe(frame, orientation="horizontal" if horizontal else "vertical")
    length = frame.shape[0] if horizontal else frame.shape[1]
    for name in found.dtype.names or ():
        assert np.isfinite(found[name].astype(float)).all(), name
    assert ((found["u_px"] >= -0.5) & (found["u_px"] <= length - 0.5)).all()
    assert (found["sigma_u_px"] > 0).all()
    assert (np.diff(found["row"].astype(int)) > 0).all()


def test_one_row_is_enough() -> None:
    frame = stripe(rows=1)
    found = extract_stripe(frame)
    assert len(found) == 1
    assert found["u_px"][0] == pytest.approx(100.3, abs=0.1)


@pytest.mark.parametrize("place", [-1.0, 0.0, 1.0, 3.0, 236.0, 239.0, 240.0])
def test_a_stripe_at_the_border_is_flagged(place: float) -> None:
    found = extract_stripe(stripe(place))
    assert (found["flags"] & Flag.EDGE > 0).all()
    assert (np.abs(found["u_px"] - place) < 6.0 * found["sigma_u_px"]).all()


@pytest.mark.parametrize("place", [98.0, 100.0, 103.0])
def test_a_stripe_cut_by_the_window_is_flagged(place: float) -> None:
    found = extract_stripe(stripe(place), from_px=100)
    assert (found["flags"] & Flag.EDGE > 0).all()
    assert (np.abs(found["u_px"] - place) < 6.0 * found["sigma_u_px"]).all()


@pytest.mark.parametrize("width", [0.3, 0.5, 0.7, 45.0, 80.0])
def test_widths_beyond_the_limits(width: float) -> None:
    """Right to its own deviation, or nothing."""
    found = extract_stripe(stripe(320.4, columns=640, width=width))
    assert (np.abs(found["u_px"] - 320.4) < 6.0 * found["sigma_u_px"]).all()
    assert (found["sigma_u_px"] < 2.0).all()


@pytest.mark.parametrize("amplitude", [300.0, 2000.0, 10000.0])
@pytest.mark.parametrize("width", [2.0, 5.0, 9.0])
def test_clipped_plateaus_are_centred_by_their_flanks(amplitude: float, width: float) -> None:
    found = extract_stripe(stripe(120.3, amplitude=amplitude, width=width))
    assert len(found) >= 114
    assert (found["flags"] & Flag.SATURATED > 0).all()
    assert np.abs(found["u_px"] - 120.3).max() < 0.15


def test_a_glow_beside_a_clipped_stripe_is_in_its_deviation() -> None:
    x = np.arange(240)
    glow = 40.0 * np.exp(-0.5 * ((x - 124.3) / 12.0) ** 2)
    frame = np.clip(stripe(120.3, amplitude=600.0).astype(float) + glow, 0, 255).astype(np.uint8)
    found = extract_stripe(frame)
    assert len(found) > 110
    assert (found["flags"] & Flag.SATURATED > 0).all()
    assert np.abs(found["u_px"] - 120.3).max() < 0.4
    assert (np.abs(found["u_px"] - 120.3) < 6.0 * found["sigma_u_px"]).all()


def test_eight_bits_in_sixteen() -> None:
    """Brightest sample 255 or less: nothing says that 255 is full, unless it is said."""
    frame = stripe()
    a, b = extract_stripe(frame), extract_stripe(frame.astype(np.uint16))
    assert np.array_equal(a["row"], b["row"])
    assert np.abs(a["u_px"] - b["u_px"]).max() < 1e-3
    clipped = stripe(amplitude=600.0)
    c = extract_stripe(clipped.astype(np.uint16), saturation_dn=254.0)
    assert np.abs(extract_stripe(clipped)["u_px"] - c["u_px"]).max() < 1e-3
    assert (c["flags"] & Flag.SATURATED > 0).all()


def test_negative_values_after_background_subtraction() -> None:
    frame = stripe().astype(np.float32)
    lowered = frame - 50.0
    a, b = extract_stripe(frame), extract_stripe(lowered)
    assert np.abs(a["u_px"] - b["u_px"]).max() < 1e-3
    assert b["background_dn"] == pytest.approx(a["background_dn"] - 50.0, abs=0.1)
    brighter = np.full_like(stripe(), 60)
    c = extract_stripe(stripe(), background=brighter)
    assert np.abs(c["u_px"] - 100.3).max() < 0.15
    assert np.median(c["background_dn"]) == pytest.approx(-40.0, abs=1.0)


def test_any_layout_in_memory() -> None:
    frame = stripe()
    expected = extract_stripe(frame)
    wide = np.zeros((240, 480), np.uint8)
    wide[::2, ::2] = frame
    locked = frame.copy()
    locked.flags.writeable = False
    layouts = [
        np.asfortranarray(frame),
        wide[::2, ::2],
        frame[::-1][::-1],
        locked,
        frame.astype(">u2").astype("u1"),
    ]
    for other in layouts:
        assert np.array_equal(extract_stripe(other), expected)
        assert np.array_equal(
            extract_stripe(np.asfortranarray(other.T), orientation="horizontal"), expected
        )


def test_a_large_frame() -> None:
    frame = np.tile(stripe(2000.4, rows=100, columns=4096), (30, 1))
    found = extract_stripe(frame)
    assert len(found) == 3000
    assert np.abs(found["u_px"] - 2000.4).max() < 0.15
