"""What a capture is: how to open one kind of source, set it, read it back, and fetch frame after frame.

A capture knows nothing of time limits, of a frame's age, or of who asks; ``live`` and ``recorded`` do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo

Image = npt.NDArray[np.generic]


class DamagedFrameError(DeviceError):
    """One frame cannot be decoded whole; the ones after it may be sound."""


@dataclass(frozen=True)
class Fetched:
    """A frame as the source gave it.

    ``arrived_ns`` and ``taken_ns`` are CLOCK_MONOTONIC: when the source handed the frame over, before
    it was decoded, and what the driver says of its exposure (None where it says nothing).
    """

    image: Image
    arrived_ns: int
    taken_ns: int | None = None


class Capture(Protocol):
    """One kind of source. Used by one thread at a time."""

    @property
    def name(self) -> str:
        """How messages call it: driver and source."""

    def open(self) -> CameraInfo:
        """Open it, set what was asked, read it back. May be called again after :meth:`close`."""

    def fetch(self) -> Fetched | None:
        """The next frame; None when the source has ended.

        Raises
        ------
        DamagedFrameError
            This frame is broken.
        DeviceError
            The source failed.
        """

    def set_exposure(self, exposure_us: float) -> float:
        """Change the exposure time; returns what was read back, in us. DeviceError if refused."""

    def close(self) -> None:
        """Give the source back; may be called more than once."""


def encoding_of(image: Image) -> str:
    """The log's name of a frame's pixel format; a descriptive one for formats that the log has not."""
    channels = 1 if image.ndim == 2 else image.shape[2]
    bits = 8 * image.dtype.itemsize
    known: dict[tuple[int, Any], str] = {
        (1, np.dtype(np.uint8)): "mono8",
        (1, np.dtype(np.uint16)): "mono16",
        (3, np.dtype(np.uint8)): "bgr8",
    }
    return known.get((channels, image.dtype), f"{channels} channel(s) of {bits} bit")


def form_of(image: Image) -> str:
    """Size and pixel format in words."""
    return f"{image.shape[1]} x {image.shape[0]} {encoding_of(image)}"
