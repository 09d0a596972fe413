"""From the [camera] table of a rig file to a camera."""

from __future__ import annotations

from pathlib import Path

from ....schemas.errors import DeviceError
from ....schemas.rig import CameraSettings
from ..contracts import Camera, Clock
from .images import ImagesCapture
from .live import LiveCamera
from .recorded import RecordedCamera
from .stream import StreamCapture
from .v4l2 import V4L2Capture
from .video import VideoCapture


def camera_of(settings: CameraSettings, clock: Clock, *, folder: Path) -> Camera:
    """The camera that a rig file names, not yet open.

    Parameters
    ----------
    settings
        The [camera] table; its driver must be one of v4l2, images, video, stream.
    clock
        Stamps frames; the session's.
    folder
        Where the rig file lies: paths in it are relative to that.

    Raises
    ------
    DeviceError
        The driver is another one.
    """
    size_and_settings = settings.model_dump(
        include={"encoding", "width_px", "height_px", "exposure_us", "gain", "white_balance"}
    )
    fps, timeout_s = settings.fps, settings.timeout_s
    if settings.driver == "v4l2" and settings.device is not None:
        v4l2 = V4L2Capture(settings.device, fps=fps, **size_and_settings)
        return LiveCamera(v4l2, clock, timeout_s=timeout_s, fps=fps)
    if settings.driver == "stream" and settings.url is not None:
        # Three frames of a slow camera may take longer than silence is allowed otherwise.
        read_s = max(1.8, 0.0 if fps is None else 4 / fps)
        stream = StreamCapture(settings.url, read_s=read_s, **size_and_settings)
        return LiveCamera(stream, clock, timeout_s=timeout_s, fps=fps)
    if settings.path is not None and settings.driver in ("images", "video"):
        kind = ImagesCapture if settings.driver == "images" else VideoCapture
        return RecordedCamera(kind(folder / settings.path, **size_and_settings), clock, fps=fps)
    raise DeviceError(f'camera driver = "{settings.driver}" is none of v4l2, images, video, stream')
