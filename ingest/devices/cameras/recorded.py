"""A camera over a source that waits: every frame in order, none dropped, stamped when handed over."""

from __future__ import annotations

from collections.abc import Iterator

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo, Clock, Shot
from .capture import Capture
from .watch import check_form


class RecordedCamera:
    """Frames of an image sequence or a video file as if they were taken now.

    Parameters
    ----------
    capture
        The source.
    clock
        Stamps frames; must be the session's.
    fps
        :meth:`stream` gives at most so many frames a second; None: as fast as they are read.
    """

    def __init__(self, capture: Capture, clock: Clock, *, fps: float | None = None) -> None:
        self._capture = capture
        self._clock = clock
        self._period_ns = 0 if fps is None else round(1e9 / fps)
        self._info: CameraInfo | None = None
        self._number = 0

    def open(self) -> CameraInfo:
        """Open the source at its first frame."""
        self._info = self._capture.open()
        self._number = 0
        return self._info

    def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
        """The next frame, stamped now, which is not before ``after_ns``.

        Raises
        ------
        DeviceError
            All frames were given, this one is damaged or of another size than the first, or an exposure
            time was asked of a source that has none.
        """
        if exposure_us is not None:
            self._opened()
            self._capture.set_exposure(exposure_us)
        shot = self._next(after_ns)
        if shot is None:
            raise DeviceError(
                f"{self._capture.name}: all of its {self._number} frames were given",
                hint="the scan asks for more poses than there are frames",
            )
        return shot

    def stream(self) -> Iterator[Shot]:
        """The remaining frames, paced by ``fps``; ends after the last."""
        self._opened()
        return self._stream()

    def _stream(self) -> Iterator[Shot]:
        due_ns = 0
        while (shot := self._next(due_ns)) is not None:
            yield shot
            due_ns = shot.t_ns + self._period_ns

    def close(self) -> None:
        """Give the source back."""
        self._info = None
        self._capture.close()

    def _opened(self) -> CameraInfo:
        if self._info is None:
            raise DeviceError(f"{self._capture.name}: is not open")
        return self._info

    def _next(self, not_before_ns: int) -> Shot | None:
        info = self._opened()
        fetched = self._capture.fetch()
        if fetched is None:
            return None
        check_form(f"{self._capture.name}: frame {self._number}", fetched.image, info)
        while (ahead_ns := not_before_ns - self._clock.now_ns()) > 0:
            self._clock.sleep_s(ahead_ns / 1e9)
        shot = Shot(self._clock.now_ns(), fetched.image, self._number)
        self._number += 1
        return shot
