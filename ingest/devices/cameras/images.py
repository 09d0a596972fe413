"""A sequence of image files as a source: every file, in natural order, once."""

from __future__ import annotations

import time
from pathlib import Path

from ....schemas.errors import DeviceError, InputError
from ....store.log_reader import decode_image_file
from ...image_reading import read_image
from ...image_sources import find_images
from ..contracts import CameraInfo
from .capture import DamagedFrameError, Fetched
from .settings import checked_info, no_such_settings


class ImagesCapture:
    """Image files of 8 or 16 bit (PNG, TIFF, JPEG, BMP).

    Parameters
    ----------
    path
        A folder, a pattern such as ``shots/*.png``, or one file.
    encoding, width_px, height_px
        What the images must be; None is not checked.
    exposure_us, gain, white_balance
        Refused when given: files cannot be asked.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        encoding: str = "mono8",
        width_px: int | None = None,
        height_px: int | None = None,
        exposure_us: float | None = None,
        gain: float | None = None,
        white_balance: float | None = None,
    ) -> None:
        self._path = path
        self._encoding = encoding
        self._size = (width_px, height_px)
        self._unavailable = {"exposure_us": exposure_us, "gain": gain, "white_balance": white_balance}
        self._files: list[Path] = []
        self._next = 0

    @property
    def name(self) -> str:
        """Driver and folder or pattern."""
        return f"images {self._path}"

    def open(self) -> CameraInfo:
        """Find the files, look at the first. DeviceError as in :meth:`fetch`, or if there are none."""
        no_such_settings(self.name, self._unavailable)
        try:
            self._files, _ = find_images([self._path])
        except InputError as error:
            raise DeviceError(error.message, hint=error.hint) from error
        self._next = 0
        first = self.fetch()
        assert first is not None
        self._next = 0
        return checked_info(
            self.name,
            first.image,
            encoding=self._encoding,
            width_px=self._size[0],
            height_px=self._size[1],
            settings={"frames": float(len(self._files)), "time": "hand-over"},
        )

    def fetch(self) -> Fetched | None:
        """The next image; a file that cannot be read whole is a DamagedFrameError that names it."""
        if self._next >= len(self._files):
            return None
        path = self._files[self._next]
        self._next += 1
        try:
            file = read_image(path)
        except InputError as error:
            raise DamagedFrameError(error.message, hint=error.hint) from error
        return Fetched(decode_image_file(file.data, where=str(path)), time.monotonic_ns())

    def set_exposure(self, exposure_us: float) -> float:
        """Always refused."""
        no_such_settings(self.name, {"exposure_us": exposure_us})
        raise AssertionError

    def close(self) -> None:
        """Forget the files."""
        self._files = []
