"""Render the frame that the camera takes of the laser lines, with the exact truth of every row."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ...schemas.scene import Light, Sensor
from .noise import expose, key_of, normal_table, strike
from .rays import Floats, Ints
from .rig import Fan, Pose, SimulatedRig, Stripe
from .scene import Scene
from .stripe import along_row, draw, optics
from .trace import RANGE, ROW, SHAPE, U, X, Z, trace

Encoding = Literal["mono8", "mono16", "bgr8"]
Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

#: What one grey value of an 8-bit frame is in a frame of each encoding; both end at their white.
SCALES: Final = {"mono8": 1, "bgr8": 1, "mono16": 257}
#: What is drawn for: noise, impulses and speckle of one frame have keys of their own.
_NOISE, _IMPULSES, SPECKLE = range(3)


@dataclass(frozen=True)
class Truth:
    """One laser's stripe points, by row: sub-pixel place in the (distorted) frame, and what is there.

    For a horizontal stripe ``row`` is a column and ``u_px`` runs down. Rows may hold several points,
    behind one another as seen along the line; all are listed. ``points_mm`` (N, 3) are in scene space;
    ``surface`` counts the shapes of the scene; ``amplitude_dn`` (peak) is in the frame's grey values,
    before saturation; ``width_px`` is the standard deviation of the profile along the row.
    """

    laser: int
    stripe: Stripe
    row: Ints
    u_px: Floats
    amplitude_dn: Floats
    width_px: Floats
    points_mm: Floats
    range_mm: Floats
    surface: Ints


@dataclass(frozen=True)
class Rendered:
    """A frame, (H, W) uint8 or uint16 or (H, W, 3) uint8, and the truth of each lit laser."""

    image: Image
    truth: dict[int, Truth]


def render(
    scene: Scene,
    rig: SimulatedRig,
    angle_rad: float,
    *,
    seed: int,
    frame: int = 0,
    lasers: Iterable[int] | None = None,
    exposure_us: float | None = None,
    light: Light | None = None,
    sensor: Sensor | None = None,
    encoding: Encoding = "mono8",
) -> Rendered:
    """The frame at ``angle_rad`` with ``lasers`` lit (None: all); equal arguments give equal bytes.

    Noise depends on seed and frame number, speckle on seed and angle: it stands still with the scene.
    ``exposure_us`` (None: the nominal one) scales all light.
    """
    lamp, chip = light or Light(), sensor or Sensor()
    pose = rig.pose(angle_rad)
    gain = 1.0 if exposure_us is None else exposure_us / lamp.exposure_us
    picture = ambient(rig.camera, lamp, gain, encoding)
    truth: dict[int, Truth] = {}
    for laser in sorted(rig.fans if lasers is None else set(lasers)):
        fan = rig.fan(laser)
        found, peak, sigma = lit_points(scene, rig, fan, pose, lamp)
        truth[laser] = as_truth(fan, found, peak * gain * SCALES[encoding], along_row(found, sigma))
        points = np.column_stack([found[:, ROW], found[:, U], peak * gain, along_row(found, sigma)])
        add_stripe(picture, fan, points, chip, key_of(seed, SPECKLE, laser, float(angle_rad)))
    return Rendered(develop(picture, chip, encoding, seed=seed, frame=frame), truth)


def lit_points(
    scene: Scene, rig: SimulatedRig, fan: Fan, pose: Pose, light: Light
) -> tuple[Floats, Floats, Floats]:
    """What :func:`~.trace.trace` lists, with peak (DN of 8 bit, nominal exposure) and width (px)."""
    found = trace(scene, rig, fan, pose)
    f_px = (rig.camera.fx_px + rig.camera.fy_px) / 2
    made = optics(found, scene.albedo, fan.shine, light, f_px)
    return found, made[:, 0], made[:, 1]


def as_truth(fan: Fan, found: Floats, amplitude_dn: Floats, width_px: Floats) -> Truth:
    """The truth of one laser from what was traced."""
    return Truth(
        laser=fan.laser,
        stripe=fan.stripe,
        row=found[:, ROW].astype(np.int64),
        u_px=found[:, U].copy(),
        amplitude_dn=amplitude_dn,
        width_px=width_px,
        points_mm=found[:, X : Z + 1].copy(),
        range_mm=found[:, RANGE].copy(),
        surface=found[:, SHAPE].astype(np.int64),
    )


def ambient(
    camera: Intrinsics, light: Light, gain: float, encoding: Encoding
) -> npt.NDArray[np.float32]:
    """Ambient light (H, W, C) over the frame, DN of 8 bit."""
    height, width = camera.height_px, camera.width_px
    share = np.array(light.ambient_bgr if encoding == "bgr8" else (1.0,), np.float32)
    if light.ambient_gradient_dn == (0.0, 0.0):
        out = np.empty((height, width, len(share)), np.float32)
        out[:] = np.float32(light.ambient_dn * gain) * share
        return out
    x, y = (np.arange(n) / n - 0.5 for n in (width, height))
    by_x, by_y = light.ambient_gradient_dn
    plane = np.maximum(light.ambient_dn + by_x * x + (by_y * y)[:, None], 0.0) * gain
    return plane.astype(np.float32)[:, :, None] * share


def add_stripe(
    picture: npt.NDArray[np.float32], fan: Fan, points: Floats, sensor: Sensor, key: np.uint64
) -> None:
    """Draw points (N, 4) of row, u, peak and width into the light (H, W, C), speckle included."""
    share = fan.shine.colour_bgr if picture.shape[2] == 3 else (1.0,)
    draw(
        picture,
        points,
        np.array(share, np.float32),
        horizontal=fan.stripe == "horizontal",
        speckle=(sensor.speckle_contrast, sensor.speckle_grain_px, key),
        table=normal_table(),
    )


def develop(
    picture: npt.NDArray[np.float32], sensor: Sensor, encoding: Encoding, *, seed: int, frame: int
) -> Image:
    """The frame that the sensor makes of light (H, W, C): noise, impulses, saturation, whole values."""
    scale = SCALES[encoding]
    out = np.empty(picture.size, np.uint16)
    expose(
        picture.reshape(-1),
        key_of(seed, _NOISE, frame),
        normal_table(),
        sensor.noise_dn,
        sensor.shot_dn_per_dn,
        sensor.saturation_dn,
        float(scale),
        out,
    )
    channels = picture.shape[2]
    if sensor.impulse_share > 0.0:
        key = key_of(seed, _IMPULSES, frame)
        strike(out, channels, sensor.impulse_share, key, round(255 * scale))
    shape = picture.shape if channels == 3 else picture.shape[:2]
    return out.reshape(shape) if encoding == "mono16" else out.astype(np.uint8).reshape(shape)
