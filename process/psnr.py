"""How far filtered frames are from a reference: MSE, PSNR and SNR, as in the paper's Table 1.

PSNR = 10 log10(peak^2 / MSE), peak being the full scale of the frames' type: 255 DN, or 65535 DN in
16 bit whatever the camera's own depth. The paper does not define its SNR; here it has the mean square
of the filtered image for peak^2, which is what the differences of its rows agree with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.errors import InputError


def peak_dn(dtype: npt.DTypeLike) -> float:
    """Full scale of a frame's type."""
    return float(np.iinfo(dtype).max)


@dataclass
class Distance:
    """Squared differences gathered over frames; MSE and mean square are over all their pixels."""

    pixels: int = 0
    squares: float = 0.0
    power: float = 0.0

    def add(self, image: npt.NDArray[Any], reference: npt.NDArray[Any]) -> None:
        """Add a filtered image (H, W) and its reference; InputError if their shapes differ."""
        if image.shape != reference.shape:
            raise InputError(f"the image is {image.shape}, its reference {reference.shape}")
        values = image.astype(np.float64)
        self.pixels += values.size
        self.power += float(np.vdot(values, values))
        values -= reference
        self.squares += float(np.vdot(values, values))

    @property
    def mse_dn2(self) -> float:
        """Mean squared error in DN^2; NaN before the first image."""
        return self.squares / self.pixels if self.pixels else math.nan

    def psnr_db(self, peak_dn: float) -> float:
        """Peak signal-to-noise ratio; infinite where nothing differs."""
        return ratio_db(peak_dn**2, self.mse_dn2)

    def snr_db(self) -> float:
        """Mean square of the images over the mean squared error."""
        return ratio_db(self.power / self.pixels if self.pixels else math.nan, self.mse_dn2)


def ratio_db(signal: float, error: float) -> float:
    """10 log10(signal / error): infinite for an error of 0, minus infinite for a signal of 0."""
    if error == 0.0:
        return math.inf
    if signal == 0.0:
        return -math.inf
    return 10.0 * math.log10(signal / error)
