"""How bright and how wide a laser's line is where it is seen, and how it falls on the pixels."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from ...schemas.scene import Emitter, Light
from .compiling import compiled
from .noise import normal
from .rays import Floats
from .trace import COSINE, DEPTH, REACH, SHAPE, SLOPE

#: A line that runs almost along a row is drawn as if it ran at this slope: it fills its row there.
_STEEPEST: Final = 8.0
_REACH_SIGMAS = 5.0


def optics(found: Floats, albedo: Floats, shine: Emitter, light: Light, f_px: float) -> Floats:
    """Peak brightness at the nominal exposure (DN of 8 bit) and width across the line (px): (N, 2).

    A line laser's light thins out with the distance once, not twice: it spreads in one plane. Its
    thickness follows a Gaussian beam; defocus blurs a point into a disc of the diameter
    f A |1/Z - 1/Z_focus| (thin lens), whose standard deviation along an axis is a quarter of that. A
    wider line holds the same light, so it is less bright.
    """
    depth, reach = found[:, DEPTH], found[:, REACH]
    beam = shine.line_sigma_mm * np.hypot(1.0, (reach - shine.waist_at_mm) / shine.rayleigh_mm)
    disc = f_px * light.aperture_mm * np.abs(1.0 / depth - 1.0 / light.focus_mm)
    sigma = np.sqrt(light.stripe_sigma_px**2 + (f_px * beam / depth) ** 2 + (disc / 4.0) ** 2)
    lambert = albedo[found[:, SHAPE].astype(np.int64)] * found[:, COSINE]
    peak = shine.stripe_dn_at_1m * lambert * 1000.0 / reach * (light.stripe_sigma_px / sigma)
    return np.stack([peak, sigma], axis=1)


def along_row(found: Floats, sigma: Floats) -> Floats:
    """Width (N,) of the profile along the row, for lines that cross it at a slant.

    A row is a pixel high, and a slanting line moves sideways in it: a twelfth of the slope squared.
    """
    slope = np.minimum(np.abs(found[:, SLOPE]), _STEEPEST)
    return np.sqrt(sigma**2 * (1.0 + slope**2) + slope**2 / 12.0)


@compiled
def _draw(
    image: npt.NDArray[np.float32],
    horizontal: bool,
    point: Floats,
    colour: npt.NDArray[np.float32],
    contrast: float,
    grain_px: float,
    key: np.uint64,
    table: npt.NDArray[np.float32],
) -> None:
    across = image.shape[0] if horizontal else image.shape[1]
    # Speckle seen through an aperture is gamma distributed (Goodman, "Speckle phenomena in optics");
    # from a normal number by Wilson and Hilferty, PNAS 17 (1931).
    ninth = contrast * contrast / 9.0
    third = contrast / 3.0
    for n in range(len(point)):
        row, u, peak, sigma = int(point[n, 0]), point[n, 1], point[n, 2], point[n, 3]
        reach = int(_REACH_SIGMAS * sigma) + 2
        first, last = max(int(u) - reach, 0), min(int(u) + reach, across - 1)
        scale = 1.0 / (sigma * math.sqrt(2.0))
        whole = peak * sigma * math.sqrt(math.pi / 2.0)
        before = math.erf((first - 0.5 - u) * scale)
        for i in range(first, last + 1):
            after = math.erf((i + 0.5 - u) * scale)
            value = whole * (after - before)
            before = after
            if contrast > 0.0:
                at = i / grain_px
                grain = math.floor(at)
                part = at - grain
                left = normal(key, row * 65536 + int(grain), table)
                right = normal(key, row * 65536 + int(grain) + 1, table)
                mixed = (left * (1.0 - part) + right * part) / math.hypot(1.0 - part, part)
                value *= max(1.0 - ninth + third * mixed, 0.0) ** 3
            for c in range(len(colour)):
                if horizontal:
                    image[i, row, c] += np.float32(value) * colour[c]
                else:
                    image[row, i, c] += np.float32(value) * colour[c]


def draw(
    image: npt.NDArray[np.float32],
    point: Floats,
    colour: npt.NDArray[np.float32],
    *,
    horizontal: bool,
    speckle: tuple[float, float, np.uint64],
    table: npt.NDArray[np.float32],
) -> None:
    """Add to ``image`` (H, W, C) the profile of each point (N, 4): row, u, peak, width along the row.

    Profiles are Gaussians integrated over the pixels of their row. ``speckle`` is contrast, grain (px)
    and key; ``colour`` (C,) the share of each channel.
    """
    contrast, grain, key = speckle
    _draw(image, horizontal, np.ascontiguousarray(point), colour, contrast, grain, key, table)
