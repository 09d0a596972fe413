"""Render what the camera sees of the laser line, with the exact truth of every row.

The laser's fan is cast ray by ray; where the picture of the line crosses the middle of an image row,
the fan angle is solved for, so that truth has no sampling error. Shadows are real: a point must be seen
by the laser first (nearest hit) and by the camera second (nothing in between). Rays are 0.03 degrees
apart; what lies between the last one on a surface and the edge behind it, a row at most, stays dark.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .rig import SimulatedRig, forward_project
from .scene import Floats, Ints, Scene

_FAN_RAYS = 3000
_FAN_HALF_RAD = math.radians(40.0)
_REFINEMENTS = 5
#: A row that is not met this well belongs to an edge that the two rays beside it both missed.
_EXACT_PX = 1e-9


@dataclass(frozen=True)
class Light:
    """How bright and how noisy: grey values in DN, lengths in mm, widths in px."""

    ambient_dn: float = 12.0
    #: Stripe amplitude on a white wall, square to the beam, one metre from the laser.
    stripe_dn_at_1m: float = 900.0
    width_px: float = 1.8
    noise_dn: float = 2.0
    shot_dn_per_dn: float = 0.02
    #: Share of pixels hit by impulse noise.
    impulses: float = 0.0


@dataclass(frozen=True)
class Truth:
    """Stripe points by row: sub-pixel place in the (distorted) frame, and the scene point behind it.

    Rows may hold several points, behind one another as seen along the line; all are listed.
    """

    row: Ints
    u_px: Floats
    amplitude_dn: Floats
    points_mm: Floats
    range_mm: Floats


@dataclass(frozen=True)
class Rendered:
    """A frame (H, W) uint8 and its truth."""

    image: npt.NDArray[np.uint8]
    truth: Truth


def render(
    scene: Scene, rig: SimulatedRig, angle_rad: float, *, seed: int, light: Light | None = None
) -> Rendered:
    """The frame at ``angle_rad``; equal arguments give equal frames."""
    lamp = light or Light()
    truth = _truth(scene, rig, angle_rad, lamp)
    camera = rig.camera
    shape = (camera.height_px, camera.width_px)
    clean = np.full(shape, lamp.ambient_dn, np.float64)
    _draw(clean, truth, lamp.width_px)
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(lamp.noise_dn**2 + lamp.shot_dn_per_dn * clean)
    noisy = clean + sigma * rng.standard_normal(shape)
    if lamp.impulses:
        struck = rng.random(shape) < lamp.impulses
        noisy[struck] = rng.integers(0, 2, int(struck.sum())) * 255.0
    return Rendered(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), truth)


def _truth(scene: Scene, rig: SimulatedRig, angle_rad: float, lamp: Light) -> Truth:
    pose = rig.pose(angle_rad)
    emitter = pose.to_scene(rig.emitter_mm()[None])[0]

    def shine(fan: Floats) -> tuple[Floats, Ints, Floats, Floats]:
        """Points, surfaces, and image positions of the light at fan angles (N,)."""
        hits = scene.cast(emitter, rig.fan(fan) @ pose.scene_from_camera.T)
        # Rays that end nowhere have points at infinity.
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = pose.to_camera(hits.points_mm)
            u, v = forward_project(seen, rig.camera)
        ahead = np.isfinite(hits.distance_mm) & (seen[:, 2] > 1.0)
        return hits.points_mm, np.where(ahead, hits.surface, -1), u, v

    fan = np.linspace(-_FAN_HALF_RAD, _FAN_HALF_RAD, _FAN_RAYS)
    _, surface, _, v = shine(fan)
    left, right, row = _crossings(surface, v, rig.camera.height_px)
    # Regula falsi; an end that stays has its error halved, so that it cannot stay for long (Illinois).
    old, new, v_old, v_new = fan[left], fan[right], v[left] - row, v[right] - row
    for _ in range(_REFINEMENTS):
        step = np.divide(v_new, v_new - v_old, out=np.zeros_like(new), where=v_new != v_old)
        middle = new - step * (new - old)
        points, found, u, v_now = shine(middle)
        v_middle = v_now - row
        crossed = v_middle * v_new < 0
        old, v_old = np.where(crossed, new, old), np.where(crossed, v_new, v_old / 2)
        new, v_new = middle, v_middle
    width = rig.camera.width_px
    good = (found == surface[left]) & (np.abs(v_new) < _EXACT_PX) & (u > -0.5) & (u < width - 0.5)
    points, found, u, row = points[good], found[good], u[good], row[good]
    away = points - pose.camera_mm
    distance = np.sqrt((away**2).sum(axis=1))
    first = scene.cast(pose.camera_mm, away / distance[:, None]).distance_mm
    clear = first > distance * (1 - 1e-9) - 1e-6
    points, found, u, row, distance = (a[clear] for a in (points, found, u, row, distance))
    beam = emitter - points
    reach = np.sqrt((beam**2).sum(axis=1))
    bright = scene.reflectance(points, found, beam / reach[:, None])
    # A line laser's light thins out with the distance once, not twice: it spreads in one plane.
    amplitude = lamp.stripe_dn_at_1m * bright * 1000.0 / reach
    order = np.lexsort((u, row))
    return Truth(row[order], u[order], amplitude[order], points[order], distance[order])


def _crossings(surface: Ints, v: Floats, height: int) -> tuple[Ints, Ints, Ints]:
    """Neighbouring fan rays on one surface with the middle of an image row between them."""
    joined = (surface[:-1] == surface[1:]) & (surface[:-1] >= 0)
    low, high = np.minimum(v[:-1], v[1:]), np.maximum(v[:-1], v[1:])
    # Half open: a ray that meets the middle of a row exactly belongs to one of its two neighbours.
    with np.errstate(invalid="ignore"):
        first = np.floor(np.where(joined, low, 0.0)).astype(np.int64) + 1
        last = np.floor(np.where(joined, high, -1.0)).astype(np.int64)
    first, last = np.maximum(first, 0), np.minimum(last, height - 1)
    count = np.where(joined, np.maximum(last - first + 1, 0), 0)
    left = np.repeat(np.arange(len(count)), count)
    row = first[left] + np.arange(len(left)) - np.repeat(np.cumsum(count) - count, count)
    return left, left + 1, row


def _draw(image: Floats, truth: Truth, width_px: float) -> None:
    """Add each point's Gaussian profile, integrated over the pixels of its row."""
    half = math.ceil(5 * width_px) + 1
    column = np.rint(truth.u_px).astype(np.int64)[:, None] + np.arange(-half, half + 1)
    scale = 1.0 / (width_px * math.sqrt(2.0))
    edges = np.concatenate([column - 0.5, column[:, -1:] + 0.5], axis=1)
    steps = np.diff(_erf((edges - truth.u_px[:, None]) * scale), axis=1)
    light = truth.amplitude_dn[:, None] * width_px * math.sqrt(math.pi / 2.0) * steps
    inside = (column >= 0) & (column < image.shape[1])
    row = np.broadcast_to(truth.row[:, None], column.shape)
    np.add.at(image, (row[inside], column[inside]), light[inside])


def _erf(x: Floats) -> Floats:
    """The error function, by interpolation in a table of exact values (error below 1e-9)."""
    return np.interp(x, _ERF_AT, _ERF)


_ERF_AT = np.linspace(-6.0, 6.0, 120_001)
_ERF = np.array([math.erf(a) for a in _ERF_AT])
