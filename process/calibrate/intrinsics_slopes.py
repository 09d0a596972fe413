"""How pixels and rays follow the ten intrinsics, in the order of their covariance."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ..camera import undistort_points
from .pose import project_with_slopes

Floats = npt.NDArray[np.float64]

_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "skew")
#: Steps of the central differences: the functions are smooth, so these are exact to 1e-6 and better.
_STEPS = (0.1, 0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4)


def changed(camera: Intrinsics, index: int, step: float) -> Intrinsics:
    """``camera`` with one of fx fy cx cy skew k1 k2 p1 p2 k3 (0 to 9) larger by ``step``."""
    if index < len(_NAMES):
        name = _NAMES[index]
        return camera.model_copy(update={name: getattr(camera, name) + step})
    lens = list(camera.distortion)
    lens[index - len(_NAMES)] += step
    return camera.model_copy(update={"distortion": tuple(lens)})


def _pairs(camera: Intrinsics) -> Iterator[tuple[Intrinsics, Intrinsics, float]]:
    for k, step in enumerate(_STEPS):
        yield changed(camera, k, step), changed(camera, k, -step), 2.0 * step


def pixel_slopes(points_mm: Floats, camera: Intrinsics) -> Floats:
    """Derivatives (N, 2, 10) of the pixels of points (N, 3) in camera space."""
    out = [
        (project_with_slopes(points_mm, a)[0] - project_with_slopes(points_mm, b)[0]) / width
        for a, b, width in _pairs(camera)
    ]
    return np.stack(out, axis=2)


def ray_slopes(u_px: Floats, v_px: Floats, camera: Intrinsics) -> Floats:
    """Derivatives (N, 2, 10) of the ideal rays (xn, yn) of pixels."""
    out = []
    for a, b, width in _pairs(camera):
        plus, minus = undistort_points(u_px, v_px, a), undistort_points(u_px, v_px, b)
        out.append(np.stack([(p - m) / width for p, m in zip(plus, minus, strict=True)], axis=1))
    return np.stack(out, axis=2)
