"""The paper's denoising (section 3.2.1): Gaussian 3 x 3, median, and both orders of the two."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.recipe import Denoise

# Formula (12), with the centre weight on f(i, j): [1 2 1; 2 4 2; 1 2 1] / 16.
_GAUSSIAN = np.array([0.25, 0.5, 0.25])


def denoise(frame: npt.NDArray[Any], step: Denoise) -> npt.NDArray[Any]:
    """``frame`` (H, W), uint8 or uint16, filtered, in the same type; borders are reflected."""
    for name in step.method.split("-"):
        if name == "gaussian":
            frame = cv2.sepFilter2D(frame, -1, _GAUSSIAN, _GAUSSIAN, borderType=cv2.BORDER_REFLECT_101)
        elif name == "median":
            frame = cv2.medianBlur(frame, step.median_size_px)
    return frame
