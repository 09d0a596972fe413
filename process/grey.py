"""Colour frames to one channel. Channels come in OpenCV's order: blue, green, red."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.errors import InputError
from ..schemas.recipe import Grey

_CHANNEL = {"blue": 0, "green": 1, "red": 2}


def to_grey(frame: npt.NDArray[Any], grey: Grey) -> npt.NDArray[Any]:
    """``frame`` as (H, W) in its own type; (H, W) passes unchanged.

    ``luma`` is ITU-R BT.601 (0.299 R + 0.587 G + 0.114 B) as OpenCV rounds it; ``weights`` are
    rounded and clipped to the type's range; ``red-minus-others`` is R - max(G, B), clipped at 0.
    The alpha channel of a four-channel frame is left out.

    Raises
    ------
    InputError
        The frame has another shape than (H, W), (H, W, 3) or (H, W, 4).
    """
    if frame.ndim == 2:
        return frame
    if frame.ndim != 3 or frame.shape[2] not in (3, 4):
        raise InputError(f"a frame of shape {frame.shape} is neither grey nor colour")
    if grey.mode == "luma":
        code = cv2.COLOR_BGR2GRAY if frame.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        return cv2.cvtColor(frame, code)
    if grey.mode in _CHANNEL:
        return np.ascontiguousarray(frame[:, :, _CHANNEL[grey.mode]])
    if grey.mode == "max":
        return np.ascontiguousarray(frame[:, :, :3].max(axis=2))
    if grey.mode == "red-minus-others":
        others = cv2.max(np.ascontiguousarray(frame[:, :, 0]), np.ascontiguousarray(frame[:, :, 1]))
        return cv2.subtract(np.ascontiguousarray(frame[:, :, 2]), others)
    assert grey.weights is not None
    red, green, blue = grey.weights
    mixed = frame[:, :, 2] * red + frame[:, :, 1] * green + frame[:, :, 0] * blue
    top = np.iinfo(frame.dtype).max
    return np.clip(np.rint(mixed), 0, top).astype(frame.dtype)
