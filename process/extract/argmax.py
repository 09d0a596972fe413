"""Extreme value: the brightest pixel of the row (the paper's first common method)."""

from __future__ import annotations

import numpy as np

from .search import Floats, Stripes


def argmax(stripes: Stripes, noise: float) -> tuple[Floats, Floats]:  # noqa: ARG001
    """Centres (N,) at whole pixels, and their standard deviation: a uniform error of one pixel.

    Of a plateau the middle is taken, so that clipped stripes are not pulled to one side.
    """
    inside = np.where(stripes.run, stripes.samples, -np.inf)
    top = inside.max(axis=1, keepdims=True, initial=-np.inf)
    ties = inside == top
    positions = stripes.positions()
    first = np.where(ties, positions, np.inf).min(axis=1, initial=np.inf)
    last = np.where(ties, positions, -np.inf).max(axis=1, initial=-np.inf)
    centre = stripes.peak + np.floor((first + last) / 2.0)
    return centre, np.full(len(centre), np.sqrt(1.0 / 12.0))
