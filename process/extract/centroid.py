"""Grey centroid of the stripe above half its height.

The threshold moves with each row's own background and height, so that a glow beside the stripe or a
sloping background does not pull the centre, and a clipped stripe is centred by its flanks.
"""

from __future__ import annotations

import numpy as np

from .search import Floats, Stripes


def centroid(stripes: Stripes, noise: float) -> tuple[Floats, Floats]:
    """Centres (N,) in px and their standard deviation.

    xc = sum(w x) / sum(w) with w = sample - threshold over the stripe's run. First-order noise:
    var = s^2 sum((x - xc)^2) / sum(w)^2.
    """
    threshold = stripes.background_dn + 0.5 * stripes.amplitude_dn
    weight = np.where(stripes.run, stripes.samples - threshold[:, None], 0.0)
    positions = stripes.positions()
    total = weight.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (weight * positions).sum(axis=1) / total
        spread = np.where(stripes.run, (positions - offset[:, None]) ** 2, 0.0).sum(axis=1)
        sigma = noise * np.sqrt(spread) / total
    return stripes.peak + offset, sigma
