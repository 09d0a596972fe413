"""A camera over a source that does not wait."""

from __future__ import annotations

from collections.abc import Iterator

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo, Clock, Shot
from .capture import Capture
from .draining import Drain
from .watch import Limits


class LiveCamera:
    """Frames of a V4L2 camera or a network stream, drained all the time while it is open.

    Parameters
    ----------
    capture
        The source.
    clock
        Stamps frames; must be the session's.
    timeout_s
        Longest wait for a frame that is new enough.
    fps
        The rate that the source must have, measured; None is not checked.
    limits
        When silence or darkness is an error.
    """

    def __init__(
        self,
        capture: Capture,
        clock: Clock,
        *,
        timeout_s: float = 2.0,
        fps: float | None = None,
        limits: Limits | None = None,
    ) -> None:
        self._capture = capture
        self._clock = clock
        self._timeout_s = timeout_s
        self._fps = fps
        self._limits = limits or Limits()
        self._drain: Drain | None = None
        self._usual_us: float | None = None

    def open(self) -> CameraInfo:
        """Open the source, set and read back its settings, begin to drain."""
        self.close()
        info = self._capture.open()
        usual = info.settings.get("exposure_us")
        self._usual_us = None if usual is None else float(usual)
        self._drain = Drain(self._capture, info, self._clock, self._limits, self._fps)
        self._drain.start()
        return info

    def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
        """The first frame whose exposure surely began at or after ``after_ns``.

        Where the driver stamps frames, the stamp less one frame period must not be older; else the
        arrival, in rhythm, less two. ``exposure_us`` holds for this frame; without it the rig file's
        exposure time holds again.

        Raises
        ------
        DeviceError
            The source is silent, ended, dropping, black, of another size, or refuses the exposure time.
        """
        drain = self._opened()
        wanted = self._usual_us if exposure_us is None else exposure_us
        if wanted is not None:
            drain.change_exposure(wanted, self._timeout_s)
        return drain.shot_after(after_ns, self._timeout_s)

    def stream(self) -> Iterator[Shot]:
        """Every frame from this call on; ``dropped`` counts those that the source or we left out.

        Frames whose time is in doubt (see ``pace``) are left out and counted too.
        """
        drain = self._opened()
        drain.begin_queue()
        return self._stream(drain)

    def _stream(self, drain: Drain) -> Iterator[Shot]:
        try:
            while True:
                yield drain.next_queued(self._timeout_s)
        finally:
            drain.end_queue()

    def close(self) -> None:
        """Stop draining and give the source back."""
        drain, self._drain = self._drain, None
        if drain is not None:
            drain.close()

    def _opened(self) -> Drain:
        if self._drain is None:
            raise DeviceError(f"{self._capture.name}: is not open")
        return self._drain
