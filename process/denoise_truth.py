"""The frame that a simulated camera would have taken without noise, from the truth in the log."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Columns = Mapping[str, npt.NDArray[Any]]

#: Profiles are drawn this many standard deviations far.
_REACH = 6.0
#: Samples farther off the plane than this many standard deviations are no ambient light.
_GATE = 4.0
_ROUNDS = 4


def clean_frame(frame: npt.NDArray[Any], stripes: Iterable[tuple[str, Columns]]) -> Floats:
    """The noise-free grey frame (H, W), DN, not rounded.

    ``stripes`` are ("vertical" or "horizontal", columns) of each lit laser, with ``row``, ``u_px``,
    ``amplitude_dn`` and ``width_px`` among the columns. Each point is a Gaussian integrated over the
    pixels of its row. The log does not hold the ambient light: it is the plane that fits ``frame``
    beside the stripes. What is brighter than the frame's brightest pixel was clipped. Speckle counts
    as noise.
    """
    light = np.zeros(frame.shape, np.float64)
    for stripe, columns in stripes:
        _draw(light.T if stripe == "horizontal" else light, columns)
    return np.clip(light + _ambient(frame - light, light), 0.0, float(frame.max()))


def _draw(light: Floats, columns: Columns) -> None:
    from scipy.special import erf

    row, u = columns["row"].astype(np.int64), columns["u_px"].astype(np.float64)
    height, width = columns["amplitude_dn"].astype(np.float64), columns["width_px"].astype(np.float64)
    if not len(row):
        return
    half = math.ceil(_REACH * float(width.max())) + 1
    column = np.rint(u).astype(np.int64)[:, None] + np.arange(-half, half + 1)
    edges = np.concatenate([column - 0.5, column[:, -1:] + 0.5], axis=1)
    steps = np.diff(erf((edges - u[:, None]) / (width[:, None] * math.sqrt(2.0))), axis=1)
    value = (height * width)[:, None] * math.sqrt(math.pi / 2.0) * steps
    inside = (column >= 0) & (column < light.shape[1])
    rows = np.broadcast_to(row[:, None], column.shape)
    np.add.at(light, (rows[inside], column[inside]), value[inside])


def _ambient(rest: Floats, light: Floats) -> Floats:
    """The plane (H, W) that fits ``rest`` where no stripe shines, impulses left out."""
    y, x = np.mgrid[-1.0 : 1.0 : rest.shape[0] * 1j, -1.0 : 1.0 : rest.shape[1] * 1j]
    design = np.stack([np.ones_like(x), x, y], axis=-1)
    use = light < 1e-3
    if use.sum() < 16:
        use = np.ones_like(use)
    plane = np.full(rest.shape, np.median(rest[use]))
    for _ in range(_ROUNDS):
        off = np.abs(rest - plane)
        # At least one DN: quiet frames have a median distance of 0.
        gate = max(_GATE * 1.4826 * float(np.median(off[use])), 1.0)
        near = use & (off <= gate)
        found, *_ = np.linalg.lstsq(design[near], rest[near], rcond=None)
        plane = design @ found
    return np.asarray(plane, np.float64)
