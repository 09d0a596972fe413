"""Frames hold the light, width and noise that they should, and the same bytes however they are made."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.room.noise import expose, key_of, normal_table
from turnscan.ingest.room.render import Encoding, Rendered, render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.process.extract import extract_stripe
from turnscan.schemas.calibration import LaserPlane
from turnscan.schemas.scene import Emitter, Light, Plane, Sensor

from .rigs import DARK, LENS, QUIET, ROOM, rig, wall, with_planes

CLEAN = Light(ambient_dn=0.0, stripe_sigma_px=2.5)


def dim(dn: float) -> SimulatedRig:
    """The usual rig with a weaker laser."""
    return SimulatedRig(rig().calibration, emitters=[Emitter(laser=0, stripe_dn_at_1m=dn)])


# -- the same bytes -------------------------------------------------------------------------------


def test_equal_arguments_give_equal_frames_whatever_was_made_before() -> None:
    a, scene = rig(distortion=LENS), Scene([ROOM])
    sensor = Sensor(impulse_share=0.01, speckle_contrast=0.3)

    def frame(n: int, angle: float = 0.3, seed: int = 5) -> Rendered:
        return render(scene, a, angle, seed=seed, frame=n, sensor=sensor)

    one = frame(7)
    for other in (frame(8), frame(7, seed=6), frame(7, angle=0.31)):
        assert not np.array_equal(one.image, other.image)
    again = frame(7)
    assert one.image.tobytes() == again.image.tobytes()
    assert one.truth[0].u_px.tobytes() == again.truth[0].u_px.tobytes()
    assert np.array_equal(one.truth[0].u_px, frame(8).truth[0].u_px), "noise is no truth"
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(frame, [7, 8] * 4))
    assert {r.image.tobytes() for r in both[::2]} == {one.image.tobytes()}


def test_speckle_stands_still_with_the_scene() -> None:
    """Averaging frames of one pose takes the noise away and leaves the speckle."""
    scene, a = wall(), dim(300.0)
    sensor = Sensor(noise_dn=3.0, shot_dn_per_dn=0.0, speckle_contrast=0.4)

    def mean(angle: float, first: int) -> np.ndarray:
        made = [render(scene, a, angle, seed=1, frame=first + n, sensor=sensor).image for n in range(8)]
        return np.mean(made, axis=0)

    smooth = render(scene, a, 0.0, seed=1, sensor=QUIET).image.astype(float)
    lit = smooth > 60
    one, two, elsewhere = mean(0.0, 0), mean(0.0, 50), mean(0.001, 0)
    assert np.corrcoef((one / smooth)[lit], (two / smooth)[lit])[0, 1] > 0.97
    assert abs(np.corrcoef((one / smooth)[lit], (elsewhere / smooth)[lit])[0, 1]) < 0.1


def test_speckle_has_its_contrast_and_leaves_the_light_as_it_is() -> None:
    scene, a = wall(), dim(300.0)
    smooth = render(scene, a, 0.0, seed=0, light=CLEAN, sensor=QUIET, encoding="mono16").image
    lit = smooth > 8000
    for contrast in (0.1, 0.35):
        sensor = QUIET.model_copy(update={"speckle_contrast": contrast})
        frames = [
            render(scene, a, 0.0, seed=s, light=CLEAN, sensor=sensor, encoding="mono16").image
            for s in range(6)
        ]
        ratio = np.stack(frames)[:, lit] / smooth[lit].astype(float)
        assert ratio.mean() == pytest.approx(1.0, abs=0.01)
        assert ratio.std() == pytest.approx(contrast, rel=0.05)


# -- noise ----------------------------------------------------------------------------------------


def test_the_normal_numbers_are_normal() -> None:
    """Mean, variance, tails and independence of a million pixels, against their own scatter."""
    n = 1_000_000
    out = np.empty(n, np.uint16)
    flat = np.full(n, 100.0, np.float32)
    expose(flat, key_of(1, 2), normal_table(), 10.0, 0.0, 255.0, 257.0, out)
    z = (out / 257.0 - 100.0) / 10.0
    assert abs(z.mean()) < 5 / math.sqrt(n)
    assert abs(z.var() - 1) < 5 * math.sqrt(2 / n)
    assert abs((z**3).mean()) < 5 * math.sqrt(15 / n)
    assert abs((z**4).mean() - 3) < 0.03
    for lag in (1, 2, 3, 4, 5, 640, 641):
        assert abs((z[lag:] * z[:-lag]).mean()) < 5 / math.sqrt(n)
    again = np.empty(n, np.uint16)
    expose(flat, key_of(1, 3), normal_table(), 10.0, 0.0, 255.0, 257.0, again)
    other = (again / 257.0 - 100.0) / 10.0
    assert abs((z * other).mean()) < 5 / math.sqrt(n)


def dark_part(made: Rendered) -> np.ndarray:
    """Pixels far from any stripe."""
    far = np.ones(made.image.shape, bool)
    for truth in made.truth.values():
        for row, u in zip(truth.row, truth.u_px, strict=True):
            far[row, max(0, int(u) - 20) : int(u) + 21] = False
    return made.image[far].astype(float)


def test_ambient_and_noise_are_what_they_say() -> None:
    light, sensor = Light(ambient_dn=40.0), Sensor(noise_dn=3.0, shot_dn_per_dn=0.1)
    dark = dark_part(render(wall(), rig(), 0.0, seed=1, light=light, sensor=sensor))
    assert dark.mean() == pytest.approx(40.0, abs=0.05)
    # Read noise, shot noise, and rounding to whole values.
    assert dark.std() == pytest.approx(math.sqrt(9.0 + 4.0 + 1 / 12), rel=0.01)


def test_impulses_are_as_frequent_as_they_say() -> None:
    light, sensor = Light(ambient_dn=100.0), Sensor(noise_dn=1.0, impulse_share=0.02)
    dark = dark_part(render(wall(), rig(), 0.0, seed=1, light=light, sensor=sensor))
    struck = (dark == 0) | (dark == 255)
    assert struck.mean() == pytest.approx(0.02, rel=0.1)
    assert (dark[struck] == 255).mean() == pytest.approx(0.5, abs=0.05)
    every = Sensor(impulse_share=1.0)
    image = render(wall(), rig(), 0.0, seed=1, light=light, sensor=every).image
    assert set(np.unique(image).tolist()) == {0, 255}


def test_impulses_strike_whole_pixels_of_a_colour_frame() -> None:
    sensor = Sensor(noise_dn=0.0, shot_dn_per_dn=0.0, impulse_share=0.1)
    image = render(
        wall(),
        rig(),
        0.0,
        seed=1,
        lasers=[],
        light=Light(ambient_dn=90),
        sensor=sensor,
        encoding="bgr8",
    ).image
    assert image.shape == (480, 640, 3)
    assert (image == image[:, :, :1]).all()
    assert ((image == 0) | (image == 255)).all(axis=2).mean() == pytest.approx(0.1, rel=0.1)


def test_ambient_light_falls_off_as_it_says() -> None:
    light = Light(ambient_dn=100.0, ambient_gradient_dn=(64.0, -48.0))
    image = render(wall(), rig(), 0.0, seed=1, lasers=[], light=light, sensor=QUIET).image.astype(float)
    x, y = np.arange(640) / 640 - 0.5, np.arange(480) / 480 - 0.5
    expected = 100.0 + 64.0 * x - 48.0 * y[:, None]
    assert np.abs(image - expected).max() <= 0.5 + 1e-3


# -- the stripe -----------------------------------------------------------------------------------


def test_a_stripe_has_the_light_and_width_that_it_says() -> None:
    made = render(wall(), dim(400.0), 0.0, seed=0, light=CLEAN, sensor=QUIET)
    image = made.image.astype(float)
    sums, truth = image.sum(axis=1), made.truth[0]
    assert sums == pytest.approx(truth.amplitude_dn * 2.5 * math.sqrt(2 * math.pi), rel=0.01)
    centre = (image * np.arange(640)).sum(axis=1) / sums
    assert np.abs(centre - truth.u_px).max() < 0.02
    variance = (image * (np.arange(640) - centre[:, None]) ** 2).sum(axis=1) / sums
    # A pixel collects over its own width: 1/12 on top.
    assert np.sqrt(variance - 1 / 12) == pytest.approx(2.5, rel=0.03)


def test_a_slanting_stripe_is_as_wide_across_itself() -> None:
    """A sheet that leans by 45 degrees: along the row it is sqrt(2) as wide, its peak the same."""
    n = np.array([math.sin(1.2) / math.sqrt(2), math.sin(1.2) / math.sqrt(2), math.cos(1.2)])
    plane = LaserPlane(laser=0, normal=tuple(n.tolist()), distance_mm=300 * math.sin(1.2))
    weak = Emitter(laser=0, stripe_dn_at_1m=400, stripe="vertical", aim=(-0.3, -0.2, 1.0))
    a = SimulatedRig(with_planes(plane), emitters=[weak])
    scene = Scene([Plane(kind="plane", at_mm=(0, 2000, 0), turn_deg=(90, 0, 0))])
    made = render(scene, a, 0.0, seed=0, light=CLEAN, sensor=QUIET, encoding="mono16")
    truth = made.truth[0]
    assert len(truth.row) > 300
    assert np.diff(truth.u_px) == pytest.approx(np.full(len(truth.row) - 1, -1.0), abs=1e-6)
    wide = math.sqrt(2 * 2.5**2 + 1 / 12)
    assert truth.width_px == pytest.approx(np.full(len(truth.row), wide))
    inside = (truth.u_px > 20) & (truth.u_px < 620)
    image = made.image[truth.row[inside]].astype(float)
    centre = (image * np.arange(640)).sum(axis=1) / image.sum(axis=1)
    assert np.abs(centre - truth.u_px[inside]).max() < 0.02
    variance = (image * (np.arange(640) - centre[:, None]) ** 2).sum(axis=1) / image.sum(axis=1)
    assert np.sqrt(variance - 1 / 12) == pytest.approx(wide, rel=0.01)


@settings(max_examples=25, deadline=None)
@given(st.floats(400, 4000), st.floats(0, 12), st.floats(0, 1.5), st.floats(100, 3000))
def test_width_and_brightness_follow_range_focus_and_beam(
    depth: float, aperture: float, line: float, waist: float
) -> None:
    """In closed form at the wall's depth, and no light is lost or won by blurring."""
    shine = Emitter(
        laser=0, stripe_dn_at_1m=100, line_sigma_mm=line, waist_at_mm=waist, rayleigh_mm=500
    )
    light = Light(stripe_sigma_px=1.2, focus_mm=900, aperture_mm=aperture)
    scene = wall(depth)
    a = SimulatedRig(rig().calibration, emitters=[shine])
    truth = render(scene, a, 0.0, seed=0, light=light, sensor=QUIET).truth[0]
    beam = truth.points_mm - np.array([300.0, 0.0, 0.0])
    reach = np.linalg.norm(beam, axis=1)
    sheet = line * np.sqrt(1 + ((reach - waist) / 500) ** 2) * 760 / depth
    disc = 760 * aperture * abs(1 / depth - 1 / 900)
    sigma = np.sqrt(1.2**2 + sheet**2 + (disc / 4) ** 2)
    assert truth.width_px == pytest.approx(sigma)
    sharp = 100 * 0.7 * (depth / reach) * 1000 / reach
    assert truth.amplitude_dn * truth.width_px == pytest.approx(sharp * 1.2)


@pytest.mark.parametrize("method", ["varied-boundary", "centroid"])
def test_extraction_finds_the_wall(method: str) -> None:
    a = SimulatedRig(rig(distortion=LENS).calibration, emitters=[Emitter(laser=0, stripe_dn_at_1m=450)])
    made = render(wall(), a, 0.0, seed=3)
    found = extract_stripe(made.image, method)
    truth = made.truth[0]
    at = dict(zip(truth.row.tolist(), truth.u_px.tolist(), strict=True))
    error = np.array([p["u_px"] - at[int(p["row"])] for p in found])
    assert len(error) == 480
    rms = math.sqrt((error**2).mean())
    print(f"{method}: rms {rms:.4f} px over {len(error)} rows")
    assert rms < 0.05
    assert abs(error.mean()) < 0.01


# -- exposure, several lasers, encodings ----------------------------------------------------------


def test_exposure_scales_the_light_and_saturates() -> None:
    a, light = dim(300.0), Light(ambient_dn=20.0, exposure_us=8000)

    def frame(us: float) -> Rendered:
        return render(
            wall(), a, 0.0, seed=1, light=light, sensor=QUIET, exposure_us=us, encoding="mono16"
        )

    short, usual, long = frame(4000), frame(8000), frame(80_000)
    assert np.abs(short.image * 2.0 - usual.image).max() <= 1.5
    assert long.truth[0].amplitude_dn == pytest.approx(10 * usual.truth[0].amplitude_dn)
    assert long.image.max() == 65535
    assert (long.image == 65535).any(axis=1).all()
    assert render(wall(), a, 0.0, seed=1, light=light, exposure_us=8000).image.tobytes() == (
        render(wall(), a, 0.0, seed=1, light=light).image.tobytes()
    )
    early = Sensor(noise_dn=0, shot_dn_per_dn=0, saturation_dn=180)
    assert render(wall(), a, 0.0, seed=1, light=light, sensor=early, exposure_us=1e5).image.max() == 180


def two_lasers() -> SimulatedRig:
    sin, cos = math.sin(1.2), math.cos(1.2)
    planes = [
        LaserPlane(laser=n, normal=(s * sin, 0.0, cos), distance_mm=300 * sin)
        for n, s in ((0, 1), (1, -1))
    ]
    shines = [
        Emitter(laser=0, stripe_dn_at_1m=200),
        Emitter(laser=1, stripe_dn_at_1m=200, colour_bgr=(0.0, 1.0, 0.5)),
    ]
    return SimulatedRig(with_planes(*planes), emitters=shines)


def test_lasers_shine_one_by_one_and_together() -> None:
    a, scene = two_lasers(), wall()
    shot = {
        lit: render(scene, a, 0.0, seed=0, lasers=lit, light=DARK, sensor=QUIET, encoding="mono16")
        for lit in ((), (0,), (1,), (0, 1))
    }
    assert shot[()].image.max() == 0
    assert shot[()].truth == {}
    for lit, made in shot.items():
        assert tuple(made.truth) == lit
    both = shot[0,].image.astype(int) + shot[1,].image
    assert np.abs(both - shot[0, 1].image).max() <= 1
    assert np.array_equal(shot[0,].truth[0].u_px, shot[0, 1].truth[0].u_px)
    # They mirror one another about the camera's axis.
    assert shot[0,].truth[0].u_px - 318.5 == pytest.approx(318.5 - shot[1,].truth[1].u_px)


def test_colour_frames_hold_each_lasers_colour() -> None:
    a, scene = two_lasers(), wall()
    light = Light(ambient_dn=40, ambient_bgr=(0.5, 0.75, 1.0))
    image = render(scene, a, 0.0, seed=0, light=light, sensor=QUIET, encoding="bgr8").image
    grey = render(scene, a, 0.0, seed=0, light=DARK, sensor=QUIET).image.astype(float)
    assert image[240, 300].tolist() == [20, 30, 40]
    red, green = grey[:, :318], grey[:, 319:]
    assert (
        np.abs(image[:, :318] - (np.array([20, 30, 40]) + red[..., None] * [0.05, 0.1, 1])).max()
        <= 1.01
    )
    assert (
        np.abs(image[:, 319:] - (np.array([20, 30, 40]) + green[..., None] * [0, 1, 0.5])).max() <= 1.01
    )


@pytest.mark.parametrize(
    ("encoding", "shape", "kind"),
    [
        ("mono8", (480, 640), "uint8"),
        ("mono16", (480, 640), "uint16"),
        ("bgr8", (480, 640, 3), "uint8"),
    ],
)
def test_encodings(encoding: Encoding, shape: tuple[int, ...], kind: str) -> None:
    made = render(Scene([ROOM]), rig(), 0.0, seed=1, encoding=encoding)
    assert made.image.shape == shape
    assert made.image.dtype == kind
    assert made.image.flags.c_contiguous


def test_sixteen_bits_are_finer_not_brighter() -> None:
    a = dim(200.0)
    eight = render(wall(), a, 0.0, seed=0, sensor=QUIET)
    sixteen = render(wall(), a, 0.0, seed=0, sensor=QUIET, encoding="mono16")
    assert np.abs(sixteen.image / 257.0 - eight.image).max() <= 0.51
    assert len(np.unique(sixteen.image)) > 5 * len(np.unique(eight.image))
    assert sixteen.truth[0].amplitude_dn == pytest.approx(257 * eight.truth[0].amplitude_dn)
