"""Noise that depends on its place and a key alone: equal keys give equal noise, in any order.

Random bits come from a counter, hashed (SplitMix64: Steele, Lea and Flood, "Fast splittable
pseudorandom number generators", OOPSLA 2014); 16 of them choose one of 65,536 quantiles of the normal
distribution, so a value lies within 4.3 standard deviations and the variance is exactly 1.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import numpy.typing as npt

from .compiling import compiled

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S16, _S11 = (np.uint64(n) for n in (30, 27, 31, 16, 11))
_LOW16 = np.uint64(0xFFFF)
_UNIT = 2.0**-53
_QUANTILES = 1 << 16


@cache
def normal_table() -> npt.NDArray[np.float32]:
    """The quantiles (65536,) of the normal distribution, scaled to variance 1."""
    from scipy.special import ndtri

    table = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    return (table / table.std()).astype(np.float32)


def key_of(*parts: float) -> np.uint64:
    """One key from a seed and what else the noise depends on."""
    key = 0
    for part in parts:
        bits = np.float64(part).view(np.uint64) if isinstance(part, float) else int(part) & (2**64 - 1)
        key = int(_hashed(np.uint64(key), np.uint64(bits)))
    return np.uint64(key)


@compiled
def _hashed(key: np.uint64, counter: np.uint64) -> np.uint64:
    z = key + (counter + np.uint64(1)) * _STEP
    z = (z ^ (z >> _S30)) * _MIX1
    z = (z ^ (z >> _S27)) * _MIX2
    return z ^ (z >> _S31)


@compiled
def normal(key: np.uint64, counter: int, table: npt.NDArray[np.float32]) -> float:
    """The normal number that belongs to a counter."""
    return table[_hashed(key, np.uint64(counter)) & _LOW16]


@compiled
def expose(
    light: npt.NDArray[np.float32],
    key: np.uint64,
    table: npt.NDArray[np.float32],
    noise_dn: float,
    shot_dn_per_dn: float,
    limit_dn: float,
    scale: float,
    out: npt.NDArray[np.uint16],
) -> None:
    """Grey values (N,) of light (N,): read and shot noise, saturation at ``limit_dn``, rounding.

    Light, noise and limit are in DN of an 8-bit frame; ``scale`` is what one of them is in ``out``.
    """
    read, shot = np.float32(noise_dn * noise_dn), np.float32(shot_dn_per_dn)
    limit, factor, half = np.float32(limit_dn), np.float32(scale), np.float32(0.5)
    zero = np.float32(0.0)
    for block in range((len(light) + 3) // 4):
        bits = _hashed(key, np.uint64(block))
        for i in range(4 * block, min(4 * block + 4, len(light))):
            value = light[i]
            value += np.sqrt(read + shot * value) * table[bits & _LOW16]
            bits >>= _S16
            out[i] = np.uint16(min(max(value, zero), limit) * factor + half)


@compiled
def strike(
    out: npt.NDArray[np.uint16], channels: int, share: float, key: np.uint64, white: int
) -> None:
    """Impulse noise on pixels (N * channels,): each is struck with a probability, black or white.

    The gaps between struck pixels are geometric, so only those are drawn.
    """
    at, counter = -1, 0
    log_missed = math.log1p(-share) if share < 1.0 else -math.inf
    while True:
        bits = _hashed(key, np.uint64(counter))
        counter += 1
        uniform = (float(bits >> _S11) + 0.5) * _UNIT
        gap = math.log(uniform) / log_missed if share < 1.0 else 0.0
        if gap > len(out):
            return
        at += 1 + int(gap)
        if (at + 1) * channels > len(out):
            return
        value = white if bits & np.uint64(1) else 0
        for c in range(channels):
            out[at * channels + c] = value
