"""Synthetic stripes with exact truth, and the Cramer-Rao bound of their centres."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def stripe_frame(
    centre: np.ndarray,
    *,
    amplitude: float | np.ndarray = 180.0,
    width: float = 2.0,
    background: float = 20.0,
    noise: float = 0.0,
    columns: int = 160,
    seed: int = 0,
    impulses: float = 0.0,
    dtype: Any = "u1",
) -> np.ndarray:
    """(H, columns): a Gaussian stripe in each row, sampled at the pixels' centres, with noise.

    Integer frames are rounded and clipped; ``impulses`` is the share of pixels that are black or white.
    """
    rng = np.random.default_rng(seed)
    at = np.arange(columns)[None, :] - centre[:, None]
    tall = np.broadcast_to(np.asarray(amplitude, float), centre.shape)[:, None]
    frame = background + tall * np.exp(-0.5 * (at / width) ** 2)
    frame = frame + noise * rng.standard_normal(frame.shape)
    kind = np.dtype(dtype)
    if kind.kind == "f":
        return frame.astype(kind)
    full = np.iinfo(kind).max
    frame = np.clip(np.rint(frame), 0, full).astype(kind)
    struck = rng.random(frame.shape) < impulses
    frame[struck] = rng.integers(0, 2, int(struck.sum())) * full
    return frame


def line(rows: int, start: float = 60.0, slope: float = 0.053) -> np.ndarray:
    """Centres of a straight stripe that is nowhere twice at the same place in a pixel."""
    return start + slope * np.arange(rows)


def bound_px(amplitude: float, width: float, noise: float) -> float:
    """Cramer-Rao bound of one row: sigma_u = 1.062 sqrt(w) sqrt(s^2 + 1/12) / A."""
    return 1.062 * math.sqrt(width) * math.sqrt(noise**2 + 1.0 / 12.0) / amplitude
