"""UVC and other V4L2 cameras, by index or by stable name.

Units are V4L2's (kernel documentation, Camera Control Reference): V4L2_CID_EXPOSURE_ABSOLUTE counts
100 us, V4L2_CID_EXPOSURE_AUTO 1 is manual, white balance is in kelvin; OpenCV passes them on unchanged.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo
from .capture import Fetched
from .opencv import V4L2_WAIT_S, four_letters, open_video
from .settings import Setting, apply, checked_info, refused
from .watch import no_frame

if TYPE_CHECKING:
    import cv2

#: Folders of names that stay the same when cameras are plugged in another order.
STABLE: Final = (Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path"))
_FOURCC: Final = {"mono8": "GREY", "mono16": "Y16 "}
_EXPOSURE_PER_US: Final = 0.01
_MANUAL: Final = 1.0


class V4L2Capture:
    """A camera of the kernel's video interface.

    Parameters
    ----------
    device
        An index (0 is /dev/video0), a path, or a name as it stands in /dev/v4l/by-id or by-path.
    encoding, width_px, height_px, fps, exposure_us, gain, white_balance
        Set and read back; None is left as it is. ``exposure_us`` and ``white_balance`` switch the
        camera's automatic off.
    """

    def __init__(
        self,
        device: int | str,
        *,
        encoding: str = "mono8",
        width_px: int | None = None,
        height_px: int | None = None,
        fps: float | None = None,
        exposure_us: float | None = None,
        gain: float | None = None,
        white_balance: float | None = None,
    ) -> None:
        self._device = device
        self._encoding = encoding
        self._size = (width_px, height_px)
        self._fps = fps
        self._exposure_us = exposure_us
        self._gain = gain
        self._white_balance = white_balance
        self._video: cv2.VideoCapture | None = None

    @property
    def name(self) -> str:
        """Driver and device as the rig file calls it."""
        return f"v4l2 {self._device}"

    def open(self) -> CameraInfo:
        """Open the device, set it, read it back, take the first frame.

        Raises
        ------
        DeviceError
            No such device (with the names of those present), no permission, in use, or a setting that
            the camera does not follow.
        """
        import cv2

        self.close()
        path = find_device(self._device)
        if not os.access(path, os.R_OK | os.W_OK):
            raise DeviceError(
                f"{self.name}: no permission to use {path}", hint="add yourself to the group video"
            )
        video = open_video(str(path), cv2.CAP_V4L2, [])
        if video is None:
            raise DeviceError(
                f"{self.name}: {path} is there but cannot be opened for capture",
                hint="close other programs that use it (fuser -v shows them); a camera has further "
                "devices for metadata: try its other numbers",
            )
        self._video = video
        try:
            settings: dict[str, float | str] = {"codec": self._set_format(video)}
            settings |= apply(video, self._settings(), camera=self.name)
            first = self.fetch()
            if first is None:
                raise no_frame(self.name, V4L2_WAIT_S)
            settings["time"] = "arrival" if first.taken_ns is None else "driver"
            return checked_info(
                self.name,
                first.image,
                encoding=self._encoding,
                width_px=self._size[0],
                height_px=self._size[1],
                settings=settings,
            )
        except DeviceError:
            self.close()
            raise

    def _set_format(self, video: cv2.VideoCapture) -> str:
        """Pixels untouched for grey; colour is converted from whatever the camera prefers."""
        import cv2

        wanted = _FOURCC.get(self._encoding)
        if wanted is not None:
            video.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*wanted))
            video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        found = four_letters(video.get(cv2.CAP_PROP_FOURCC))
        if wanted is not None and found != wanted.rstrip():
            raise refused(
                self.name,
                "encoding",
                f"{self._encoding} ({wanted.rstrip()})",
                found,
                hint='set encoding = "bgr8" for a colour camera; grey is a stage of the recipe',
            )
        return found

    def _settings(self) -> list[Setting]:
        import cv2

        width, height = self._size
        out: list[Setting] = []
        if width is not None and height is not None:
            out.append(Setting("width_px", cv2.CAP_PROP_FRAME_WIDTH, width))
            out.append(Setting("height_px", cv2.CAP_PROP_FRAME_HEIGHT, height))
        if self._fps is not None:
            # Frame intervals are fractions: 30 may read back as 29.97.
            out.append(Setting("fps", cv2.CAP_PROP_FPS, self._fps, tolerance=0.01 * self._fps))
        if self._exposure_us is not None:
            out += _exposure(self._exposure_us)
        if self._gain is not None:
            out.append(Setting("gain", cv2.CAP_PROP_GAIN, self._gain, tolerance=0.5))
        if self._white_balance is not None:
            out.append(Setting("white_balance_auto", cv2.CAP_PROP_AUTO_WB, 0.0))
            out.append(
                Setting(
                    "white_balance", cv2.CAP_PROP_WB_TEMPERATURE, self._white_balance, tolerance=0.5
                )
            )
        return out

    def fetch(self) -> Fetched | None:
        """The next frame with the driver's time stamp; None when the device is gone."""
        import cv2

        video = self._video
        if video is None:
            raise DeviceError(f"{self.name}: is not open")
        begun = time.monotonic()
        ok, image = video.read()
        arrived_ns = time.monotonic_ns()
        if not ok:
            waited_s = time.monotonic() - begun
            if waited_s > 0.9 * V4L2_WAIT_S:
                raise no_frame(self.name, waited_s)
            return None
        # The kernel's stamp of this buffer; drivers may use another clock, or none.
        taken_ns = round(video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        believable = 0 <= arrived_ns - taken_ns < 2_000_000_000
        return Fetched(image, arrived_ns, taken_ns if believable else None)

    def set_exposure(self, exposure_us: float) -> float:
        """Set the exposure time and read it back, in us."""
        if self._video is None:
            raise DeviceError(f"{self.name}: is not open")
        return apply(self._video, _exposure(exposure_us), camera=self.name)["exposure_us"]

    def close(self) -> None:
        """Give the device back."""
        if self._video is not None:
            self._video.release()
            self._video = None


def _exposure(exposure_us: float) -> list[Setting]:
    """Manual first: under the automatic, a set exposure time reads back and yet does not hold."""
    import cv2

    return [
        Setting("exposure_auto (1: manual)", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL),
        Setting(
            "exposure_us", cv2.CAP_PROP_EXPOSURE, exposure_us, per_unit=_EXPOSURE_PER_US, tolerance=50.0
        ),
    ]


def find_device(device: int | str) -> Path:
    """The device file of an index, path or stable name.

    Raises
    ------
    DeviceError
        There is none; the message names those that are there.
    """
    if isinstance(device, int):
        wanted = [Path(f"/dev/video{device}")]
    elif "/" in device:
        wanted = [Path(device)]
    else:
        wanted = [Path("/dev") / device, *(folder / device for folder in STABLE)]
    for path in wanted:
        if path.exists():
            return path.resolve()
    raise DeviceError(
        f"v4l2 {device}: no such device; {_present()}",
        hint="plug the camera in; in a container, hand /dev/video* through to it",
    )


def _present() -> str:
    for folder in STABLE:
        names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        if names:
            return f"in {folder}: {', '.join(names)}"
    bare = sorted(str(p) for p in Path("/dev").glob("video[0-9]*"))
    return f"present: {', '.join(bare)}" if bare else "no video device is present"
