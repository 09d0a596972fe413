"""Frames as the compiled methods take them: what is none is refused, with what is wrong and where."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError

#: The type that holds the difference of two frames, for each type of frame.
SIGNED: Final = {"B": cv2.CV_16S, "H": cv2.CV_32S, "f": cv2.CV_32F, "d": cv2.CV_64F}


def checked(frame: npt.NDArray[Any], what: str) -> npt.NDArray[Any]:
    """``frame``, contiguous; or an InputError that says what is wrong with it."""
    if not isinstance(frame, np.ndarray):
        raise InputError(f"the {what} is {type(frame).__name__}, expected an array (H, W)")
    kind = frame.dtype.char
    if frame.ndim != 2 or frame.size == 0:
        raise InputError(
            f"the {what} has shape {frame.shape}, expected (H, W)",
            hint="convert colour frames first (stage grey)",
        )
    if frame.shape[0] > 65535 or frame.shape[1] > 65535:
        raise InputError(f"the {what} has shape {frame.shape}; rows and columns go up to 65535")
    if kind not in SIGNED:
        raise InputError(f"the {what} is {frame.dtype}, expected uint8, uint16 or floating point")
    if kind in "fd" and not np.isfinite(frame).all():
        row, column = np.argwhere(~np.isfinite(frame))[0]
        raise InputError(
            f"the {what} holds {frame[row, column]} in row {row}, column {column}, expected numbers",
            hint="replace what is missing before extraction",
        )
    return frame if frame.flags.c_contiguous else np.ascontiguousarray(frame)


def locked(frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """``frame``, not to be written: else the kernels would be compiled for either sort of array."""
    if not frame.flags.writeable:
        return frame
    view = frame.view()
    view.flags.writeable = False
    return view


def clip_level(frame: npt.NDArray[Any], asked: float | None) -> float:
    """From which level on samples of ``frame`` are clipped; ``asked`` is what the recipe says of it."""
    kind = frame.dtype.char
    if asked is None and kind == "B":
        return 254.0
    if kind in "fd":
        return float("inf") if asked is None else float(asked)
    full = 255 if kind == "B" else 65535
    if asked is None:
        # Cameras of 10, 12 and 14 bits clip far below the type's own limit.
        brightest = int(frame.max())
        full = next(level for level in (1023, 4095, 16383, 65535) if brightest <= level)
        # Noise and rounding take a clipped sample one step down.
        return full - 1.0
    if not 0.0 < asked <= full:
        raise InputError(
            f"saturation_dn is {asked:g}, the frame is {frame.dtype} with a full scale of {full}",
            hint="give the level in DN of these frames, or leave it out",
        )
    return float(asked)
