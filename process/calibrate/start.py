"""Where the least squares begin: OpenCV's camera calibration (Zhang 2000), without skew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.errors import CalibrationError
from .boards import BoardView
from .projection import rotation_of

Floats = npt.NDArray[np.float64]

Fix = Literal["skew", "aspect", "principal-point", "k1", "k2", "p1", "p2", "k3"]


def start_camera(views: Sequence[BoardView], fix: Sequence[Fix]) -> tuple[Floats, Floats, Floats]:
    """The ten parameters (skew 0), rotations (V, 3, 3) and shifts (V, 3) mm, ``camera_from_board``.

    Raises
    ------
    CalibrationError
        OpenCV finds no camera in front of the boards.
    """
    size = (views[0].width_px, views[0].height_px)
    flags = 0
    for name, flag in (
        ("aspect", cv2.CALIB_FIX_ASPECT_RATIO),
        ("principal-point", cv2.CALIB_FIX_PRINCIPAL_POINT),
        ("k1", cv2.CALIB_FIX_K1),
        ("k2", cv2.CALIB_FIX_K2),
        ("k3", cv2.CALIB_FIX_K3),
    ):
        flags |= flag if name in fix else 0
    if "p1" in fix or "p2" in fix:
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    objects = [v.points_mm.astype(np.float32) for v in views]
    images = [v.points_px.astype(np.float32) for v in views]
    near = np.eye(3)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 1e-5)
    try:
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            objects, images, size, near, np.zeros(5), flags=flags, criteria=stop
        )
    except cv2.error as error:
        raise CalibrationError(
            "no camera explains the views: the board may be another than was said",
            hint="check --pattern, and tilt the board in several directions",
        ) from error
    k = np.ravel(lens)[:5]
    camera = _rounded([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], 0.0, *k])
    rotations = rotation_of(np.stack([_rounded(t) for t in turns]))
    translations = np.stack([_rounded(t) for t in shifts])
    if (
        not np.isfinite(camera).all()
        or min(camera[0], camera[1]) <= 0
        or (translations[:, 2] <= 0).any()
    ):
        raise CalibrationError(
            "no camera in front of the board explains the views",
            hint="tilt the board in several directions; check --pattern",
        )
    return camera, rotations, translations


def _rounded(values: npt.ArrayLike) -> Floats:
    """To six decimals: OpenCV's threads add up in any order; equal input shall give equal bits."""
    return np.round(np.asarray(values, np.float64).ravel(), 6)
