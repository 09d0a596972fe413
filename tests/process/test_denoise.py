"""The windowed filters against the full-frame ones, the paper's Table 1, and the table's references."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.built_in import room_calibration, room_document
from turnscan.ingest.room.render import render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.process.denoise import denoise, denoise_at_stripe
from turnscan.process.denoise_table import REFERENCES, FilterTable
from turnscan.process.denoise_truth import clean_frame
from turnscan.process.denoise_window import filter_windows
from turnscan.process.extract import METHODS, extract_stripe, noise_of
from turnscan.process.psnr import Distance, peak_dn, ratio_db
from turnscan.schemas.errors import DocumentError, InputError
from turnscan.schemas.recipe import BUILT_IN, Denoise, Extract, Recipe, Triangulate, parse_recipe
from turnscan.schemas.scene import Light, Sensor

FILTERS = [
    (m, s)
    for m in ("gaussian", "median", "gaussian-median", "median-gaussian")
    for s in (3, 5)
    if (m, s) != ("gaussian", 5)
]


def steps_of(step: Denoise) -> list[tuple[str, int]]:
    return [(n, 1 if n == "gaussian" else step.median_size_px // 2) for n in step.method.split("-")]


def stripe(
    shape: tuple[int, int],
    *,
    top: float = 255.0,
    slope: float = 0.1,
    seed: int = 5,
    salt: float = 0.003,
) -> np.ndarray[Any, Any]:
    """A slanted stripe, noise, a few impulses; in whole DN of full scale ``top``."""
    rng = np.random.default_rng(seed)
    height, width = shape
    centre = 0.45 * width + slope * (np.arange(height) - height / 2)[:, None] + 0.3
    frame = 0.05 + 0.7 * np.exp(-0.5 * ((np.arange(width) - centre) / 2.0) ** 2)
    frame = frame + 0.008 * rng.standard_normal(shape)
    frame[rng.random(shape) < salt] = 1.0
    return np.clip(np.rint(frame * top), 0, top).astype(np.uint8 if top < 256 else np.uint16)


@pytest.mark.parametrize(("method", "size"), FILTERS)
@given(
    data=st.data(),
    height=st.integers(1, 14),
    width=st.integers(1, 70),
    wide=st.booleans(),
    turned=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_a_stretch_is_what_the_whole_frame_gives(
    method: Any, size: Any, data: st.DataObject, height: int, width: int, wide: bool, turned: bool
) -> None:
    """Any stretches, also empty, beyond the borders, jumping from row to row; 8 and 16 bit; turned."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    kind = np.uint16 if wide else np.uint8
    frame = rng.integers(0, np.iinfo(kind).max, (height, width), kind, endpoint=True)
    first = rng.integers(-5, width + 5, height)
    last = first + rng.integers(-3, width + 5, height)
    step = Denoise(method=method, median_size_px=size)
    full = denoise(frame.T.copy(), step).T if turned else denoise(frame, step)
    before = frame.copy()
    out = filter_windows(frame, steps_of(step), first, last, transposed=turned)
    assert np.array_equal(frame, before)
    column = np.arange(width)
    inside = (column >= first[:, None]) & (column < last[:, None])
    assert np.array_equal(out, np.where(inside, full, frame))
    own = filter_windows(before, steps_of(step), first, last, in_place=True, transposed=turned)
    assert own is before
    assert np.array_equal(own, out)


@pytest.mark.parametrize("width", [8, 16, 31, 33, 100, 640])
def test_halves_are_rounded_as_the_full_filter_does(width: int) -> None:
    """OpenCV rounds them up in some columns and to even in others."""
    frame = np.zeros((512, width), np.uint8)
    frame[2::4] = 2 * (np.arange(128) % 100)[:, None]
    whole = np.zeros(512, np.int64), np.full(512, width)
    step = Denoise(method="gaussian")
    assert np.array_equal(filter_windows(frame, [("gaussian", 1)], *whole), denoise(frame, step))


@pytest.mark.parametrize("extraction", METHODS)
@pytest.mark.parametrize(("method", "size"), [("median", 3), ("median-gaussian", 3), ("gaussian", 3)])
@pytest.mark.parametrize(
    ("orientation", "top"), [("vertical", 255), ("horizontal", 255), ("vertical", 65535)]
)
def test_extraction_reads_the_same_numbers(
    extraction: Any, method: Any, size: Any, orientation: Any, top: int
) -> None:
    frame = stripe((150, 400), top=top)
    if orientation == "horizontal":
        frame = np.ascontiguousarray(frame.T)
    # Gbase well above the noise of 16 bit.
    settings = Extract(method=extraction, orientation=orientation, base_dn=0.12 * top, max_width_px=12)
    step = Denoise(method=method, median_size_px=size, where="stripe")
    noise = noise_of(frame)
    near, none = denoise_at_stripe(frame, None, step, settings, [(0, None)], noise)
    full = denoise(frame, step)
    assert none is None
    assert not np.array_equal(near, full), "the whole frame was filtered"
    found = [
        extract_stripe(
            f, extraction, orientation=orientation, base_dn=0.12 * top, max_width_px=12, noise=noise
        )
        for f in (near, full)
    ]
    assert len(found[1]) > 140
    assert np.array_equal(*found)


def test_a_laser_off_frame_is_filtered_in_the_same_places() -> None:
    rng = np.random.default_rng(8)
    clutter = cv2.GaussianBlur(rng.integers(0, 160, (150, 400)).astype(np.uint8), (9, 9), 3)
    off = cv2.add(clutter, rng.integers(0, 4, clutter.shape).astype(np.uint8))
    frame = cv2.add(stripe(clutter.shape, salt=0.0), clutter)
    step = Denoise(where="stripe")
    settings = Extract(method="centroid", background="off-frame", max_width_px=12)
    noise = noise_of(frame)
    near, near_off = denoise_at_stripe(frame, off, step, settings, [(0, None)], noise)
    assert near_off is not None
    options = {"base_dn": 30.0, "max_width_px": 12.0, "noise": noise}
    one = extract_stripe(near, "centroid", background=near_off, **options)
    other = extract_stripe(denoise(frame, step), "centroid", background=denoise(off, step), **options)
    assert len(other) == 150
    assert np.array_equal(one, other)


def test_rows_with_a_second_stripe_are_filtered_whole() -> None:
    frame = stripe((60, 400))
    frame[20:40, 300:304] = 230
    near, _ = denoise_at_stripe(
        frame, None, Denoise(where="stripe"), Extract(max_width_px=8), [(0, None)], noise_of(frame)
    )
    assert np.array_equal(near[22:38], denoise(frame, Denoise())[22:38])
    assert np.array_equal(near[:6, 260:], frame[:6, 260:])


def test_windows_of_two_lasers() -> None:
    frame = np.maximum(stripe((60, 400), seed=1), np.roll(stripe((60, 400), seed=2), 120, axis=1))
    near, _ = denoise_at_stripe(
        frame, None, Denoise(where="stripe"), Extract(max_width_px=8), [(0, 240), (240, 400)], 2.0
    )
    full = denoise(frame, Denoise())
    for at in (180, 300):
        assert np.array_equal(near[:, at - 20 : at + 20], full[:, at - 20 : at + 20])


def test_nothing_to_filter() -> None:
    dark = np.full((20, 30), 10, np.uint8)
    near, _ = denoise_at_stripe(dark, None, Denoise(where="stripe"), Extract(), [(0, None)], 0.3)
    assert np.array_equal(near, dark)
    frame = stripe((20, 100))
    same, _ = denoise_at_stripe(frame, None, Denoise(method="none"), Extract(), [(0, None)], 0.3)
    assert same is frame


def test_where_enters_the_key_of_recipes_that_use_it_alone() -> None:
    assert Denoise(where="frame") == Denoise()
    assert Denoise().plain() == {"stage": "denoise", "method": "median", "median_size_px": 3}
    assert all("where" not in str(recipe.plain()) for recipe in BUILT_IN.values())

    def recipe(**more: Any) -> Recipe:
        return Recipe(name="x", stages=(Denoise(**more), Extract(), Triangulate()))

    assert recipe().recipe_id() == recipe(where="frame").recipe_id()
    assert recipe().recipe_id() != recipe(where="stripe").recipe_id()
    text = '[[stages]]\nstage = "denoise"\nwhere = "stripe"\n[[stages]]\nstage = "extract"\n'
    read = parse_recipe(
        f'name = "x"\n{text}[[stages]]\nstage = "triangulate"\n'.encode(), where="x.toml"
    )
    assert read.recipe_id() == recipe(where="stripe").recipe_id()
    with pytest.raises(DocumentError, match="where"):
        parse_recipe(f'name = "x"\n{text}'.replace('"stripe"', '"here"').encode(), where="x.toml")


#: Xiao et al. 2015, Table 1: PSNR (dB), MSE, SNR (dB).
TABLE_1 = {
    "gaussian": (42.2681, 3.8572, 14.7873),
    "median": (44.2890, 2.4220, 16.8238),
    "gaussian-median": (42.2605, 3.8639, 14.7781),
    "median-gaussian": (42.1048, 4.0050, 14.6205),
}


@pytest.mark.parametrize("name", TABLE_1)
def test_psnr_is_the_papers(name: str) -> None:
    psnr, mse, _ = TABLE_1[name]
    sums = Distance(pixels=10_000, squares=mse * 10_000)
    assert sums.psnr_db(peak_dn(np.uint8)) == pytest.approx(psnr, abs=1e-4)


def test_the_papers_snr_has_the_filtered_image_for_its_signal() -> None:
    """What its rows imply for the signal's mean square: less, the more a filter smooths."""
    implied = {n: mse * 10 ** (snr / 10) for n, (_, mse, snr) in TABLE_1.items()}
    assert all(116.0 < v < 117.0 for v in implied.values())
    order = sorted(implied, key=implied.__getitem__, reverse=True)
    assert order == ["median", "gaussian", "gaussian-median", "median-gaussian"]


def test_psnr_by_hand() -> None:
    sums = Distance()
    sums.add(np.array([[3, 0]], np.uint8), np.array([[0, 4]], np.uint8))
    assert sums.mse_dn2 == 12.5
    assert sums.psnr_db(255.0) == 10 * math.log10(255**2 / 12.5)
    assert sums.snr_db() == 10 * math.log10(4.5 / 12.5)
    assert peak_dn(np.uint16) == 65535.0
    assert ratio_db(1.0, 0.0) == math.inf
    assert ratio_db(0.0, 1.0) == -math.inf
    assert math.isnan(Distance().mse_dn2)
    with pytest.raises(InputError, match="its reference"):
        sums.add(np.zeros((2, 2)), np.zeros((2, 3)))


@pytest.mark.parametrize("top", [255.0, 65535.0])
def test_only_a_reference_other_than_the_frame_tells_good_from_bad(top: float) -> None:
    """Against itself doing nothing is best; against truth every filter beats it."""
    table = FilterTable()
    clean = stripe((200, 300), top=top, salt=0.0).astype(float)
    rng = np.random.default_rng(4)
    for _ in range(3):
        noisy = clean + 0.01 * top * rng.standard_normal(clean.shape)
        kind = np.uint8 if top < 256 else np.uint16
        table.add(np.clip(np.rint(noisy), 0, top).astype(kind), {"truth": clean})
    assert (table.frames, table.peak_dn) == (3, top)
    none, *others = table.rows()
    assert none["psnr_vs_unfiltered_db"] == math.inf
    assert none["psnr_vs_truth_db"] == pytest.approx(40.0, abs=0.1)
    for row in others:
        assert row["psnr_vs_truth_db"] > none["psnr_vs_truth_db"]
        assert row["psnr_vs_unfiltered_db"] == ratio_db(top**2, row["mse_vs_unfiltered_dn2"])
        assert row["psnr_vs_temporal_mean_db"] is None
    assert [table.has(r) for r in REFERENCES] == [True, True, False]


def test_a_table_takes_frames_of_one_type() -> None:
    table = FilterTable()
    table.add(stripe((20, 40)), {})
    with pytest.raises(InputError, match="expected uint8"):
        table.add(stripe((20, 40), top=65535), {})
    with pytest.raises(InputError, match="float64"):
        FilterTable().add(np.zeros((4, 4)), {})


def test_real_frames_come_out_as_in_the_paper(test_data: Path) -> None:
    """Dark frames with a bright stripe: the median changes them least, as in the paper."""
    table = FilterTable()
    for number in (1, 81, 161, 241):
        path = test_data / "srv_turntable" / "scan" / f"step_num{number}.jpg"
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        table.add(image, {})
    psnr = {r["filter"]: r["psnr_vs_unfiltered_db"] for r in table.rows()}
    assert psnr["median"] > psnr["gaussian"] > max(psnr["gaussian-median"], psnr["median-gaussian"])
    assert psnr["median"] == pytest.approx(44.3, abs=1.5)
    assert psnr["gaussian"] == pytest.approx(42.3, abs=1.5)


@pytest.mark.parametrize("encoding", ["mono8", "mono16"])
def test_clean_frames_are_those_rendered_without_noise(encoding: Any) -> None:
    """From the noisy frame and its truth, on uneven ambient light, clipped stripes included."""
    calibration = room_calibration()
    light = Light(ambient_dn=20.0, ambient_gradient_dn=(15.0, -8.0), stripe_sigma_px=2.2)
    scene, rig = Scene(room_document().shapes), SimulatedRig(calibration)
    noisy, clean = (
        render(scene, rig, 0.7, seed=3, light=light, sensor=sensor, encoding=encoding)
        for sensor in (
            Sensor(impulse_share=0.003),
            Sensor(noise_dn=0.0, shot_dn_per_dn=0.0),
        )
    )
    truth = noisy.truth[0]
    columns = {n: getattr(truth, n) for n in ("row", "u_px", "amplitude_dn", "width_px")}
    made = clean_frame(noisy.image, [(truth.stripe, columns)])
    scale = 257 if encoding == "mono16" else 1
    assert np.abs(made - clean.image).max() < 0.7 * scale
    assert np.abs(np.mean(made - clean.image)) < 0.05 * scale


def test_a_clean_frame_of_a_horizontal_stripe_and_of_none() -> None:
    frame = np.full((40, 60), 9, np.uint8)
    frame[20] = 230
    columns = {
        "row": np.arange(60),
        "u_px": np.full(60, 20.0),
        "amplitude_dn": np.full(60, 250.0),
        "width_px": np.full(60, 0.5),
    }
    made = clean_frame(frame, [("horizontal", columns)])
    assert np.allclose(made[:17], 9.0)
    assert np.allclose(
        made[20], 9 + 250 * 0.5 * math.sqrt(2 * math.pi) * math.erf(1 / math.sqrt(2)), atol=1
    )
    empty = {n: c[:0] for n, c in columns.items()}
    assert np.allclose(clean_frame(np.full((40, 60), 9, np.uint8), [("vertical", empty)]), 9.0)
