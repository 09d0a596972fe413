"""Undistort whole frames, as the paper does before anything else.

The result is what a camera with the same focal lengths and centre, without distortion and skew, would
have seen. Stripe points are undistorted exactly, and far cheaper, by camera.undistort_points.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Intrinsics
from .camera import distort, pixels


class FrameUndistorter:
    """Undistorts frames of one camera; its maps are computed once.

    Bilinear interpolation by ``cv2.remap``, whose weights are in steps of 1/32 px; samples from
    outside the frame are 0.
    """

    def __init__(self, camera: Intrinsics) -> None:
        v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
        xn, yn = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
        map_u, map_v = pixels(*distort(xn, yn, camera), camera)
        self._map = cv2.convertMaps(map_u.astype(np.float32), map_v.astype(np.float32), cv2.CV_16SC2)

    def __call__(self, frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """``frame`` (H, W) or (H, W, 3), uint8 or uint16, undistorted, in the same type."""
        return cv2.remap(frame, self._map[0], self._map[1], cv2.INTER_LINEAR)
