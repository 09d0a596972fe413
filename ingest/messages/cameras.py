"""Camera calibration messages (sensor_msgs/CameraInfo, foxglove.CameraCalibration) as intrinsics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from ...schemas.calibration import Intrinsics
from ...schemas.document import validate
from ...schemas.errors import InputError

if TYPE_CHECKING:
    from mcap.records import Schema

from .trees import is_named


def is_camera(schema: Schema | None) -> bool:
    """Whether messages of this schema describe a camera."""
    names = ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration", "foxglove_msgs/CameraCalibration")
    return is_named(schema, *names)


def intrinsics_of(tree: Any, *, where: str) -> Intrinsics:
    """The camera that a message describes.

    ``plumb_bob`` is the model of :class:`Intrinsics` with coefficients in the same order; skew stands
    in K[0][1] as fx times skew.

    Raises
    ------
    InputError
        The camera is uncalibrated (K is zero), of another model, binned or cropped, or incomplete.
    """
    if not isinstance(tree, dict):
        raise InputError(f"{where}: no camera calibration message")
    lower = {str(key).lower(): value for key, value in tree.items()}
    model = lower.get("distortion_model")
    d, k = (_numbers(lower.get(name), name, where) for name in ("d", "k"))
    if len(k) != 9 or not k[0] or not k[4]:
        raise InputError(f"{where}: the camera is not calibrated (K is {k[:9]})")
    if model not in ("plumb_bob", "") or len(d) not in (0, 4, 5) or (not model and any(d)):
        raise InputError(f"{where}: its model is {model!r} with {len(d)} coefficients, not plumb_bob")
    if k[3] or k[6] or k[7] or k[8] != 1:
        raise InputError(f"{where}: K is no camera matrix ({k})")
    if any(lower.get(n, 0) not in (0, 1) for n in ("binning_x", "binning_y")) or _is_cropped(lower):
        raise InputError(f"{where}: the camera is binned or cropped, so K is not that of the image")
    return validate(
        Intrinsics,
        {
            "width_px": lower.get("width"),
            "height_px": lower.get("height"),
            "fx_px": k[0],
            "fy_px": k[4],
            "cx_px": k[2],
            "cy_px": k[5],
            "skew": k[1] / k[0],
            "distortion": [*d, *(0.0 for _ in range(5 - len(d)))],
        },
        where=where,
    )


def _numbers(value: Any, name: str, where: str) -> list[float]:
    if not isinstance(value, (list, tuple)) or not all(
        isinstance(v, (int, float)) and math.isfinite(v) for v in value
    ):
        raise InputError(f"{where}: {name.upper()} is missing or not finite")
    return [float(v) for v in value]


def _is_cropped(lower: dict[str, Any]) -> bool:
    """ROS: a region of zeros is the whole image."""
    roi = lower.get("roi")
    if not isinstance(roi, dict):
        return False
    whole = (0, 0, lower.get("height"), lower.get("width"))
    found = tuple(roi.get(n, 0) for n in ("x_offset", "y_offset", "height", "width"))
    return found not in ((0, 0, 0, 0), whole)
