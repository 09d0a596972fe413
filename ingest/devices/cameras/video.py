"""A video file as a source: every frame, in order, once, without loss where the codec has none.

OpenCV turns every video into 8-bit colour unless told otherwise. So the file's own pixel format
decides: 8-bit and 16-bit grey are taken as they are (bit-exact with FFV1), colour of 8 bit as BGR, and
whatever would be rounded on the way is refused.
"""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo
from .capture import DamagedFrameError, Fetched
from .ffv1 import SliceCheck
from .opencv import four_letters, open_video
from .settings import Setting, apply, checked_info

if TYPE_CHECKING:
    import cv2

#: FFmpeg's tags of grey pixel formats that OpenCV hands over untouched.
_GREY: Final = {"Y800", "Y1[0][16]"}


#: FFmpeg's tags of formats that may have more than 8 bit a channel: the depth as a number at the end
#: (planes, low byte first) or the beginning (high byte first), bits a pixel (packed), or two digits
#: (P010).
_DEEP: Final = re.compile(
    r"..\[\d+\]\[(?P<low>\d+)\]|\[(?P<high>\d+)\]\[\d+\].."
    r"|[A-Z]{3}\[(?P<packed>\d+)\]|P\d1[0-6]"
)


def rounded(pixels: str) -> bool:
    """Whether OpenCV would round pixels of this FFmpeg tag to 8 bit."""
    found = _DEEP.fullmatch(pixels)
    if found is None:
        return False
    planes = found["low"] or found["high"]
    if planes is not None:
        return int(planes) > 8
    return found["packed"] is None or int(found["packed"]) >= 30


class VideoCapture:
    """A video file.

    Parameters
    ----------
    path
        The file; .mkv with FFV1 is what keeps every bit.
    encoding, width_px, height_px
        What the frames must be; None is not checked.
    exposure_us, gain, white_balance
        Asked of OpenCV's capture and read back as of any other: video files refuse.
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
        self._path = Path(path)
        self._encoding = encoding
        self._size = (width_px, height_px)
        self._asked = {"exposure_us": exposure_us, "gain": gain, "white_balance": white_balance}
        self._video: cv2.VideoCapture | None = None
        self._slices: SliceCheck | None = None
        self._frames = 0
        self._expected = 0

    @property
    def name(self) -> str:
        """Driver and file."""
        return f"video {self._path}"

    def open(self) -> CameraInfo:
        """Open the file and look at its first frame.

        Raises
        ------
        DeviceError
            No such file, no video in it, pixels that would be rounded, another size or encoding than
            asked, or a setting that a file does not follow.
        """
        self.close()
        if not self._path.is_file():
            raise DeviceError(f"{self.name}: no such file")
        try:
            info = self._look(self._connect())
            # Not every container winds back exactly: the first frame is had by opening it again.
            self._connect()
        except DeviceError:
            self.close()
            raise
        return info

    def _look(self, settings: dict[str, float | str]) -> CameraInfo:
        import cv2

        first = self.fetch()
        if first is None:
            raise DeviceError(f"{self.name}: holds no frame that can be decoded")
        assert self._video is not None
        properties = {
            "exposure_us": cv2.CAP_PROP_EXPOSURE,
            "gain": cv2.CAP_PROP_GAIN,
            "white_balance": cv2.CAP_PROP_WB_TEMPERATURE,
        }
        asked = [Setting(n, properties[n], v) for n, v in self._asked.items() if v is not None]
        apply(self._video, asked, camera=self.name)
        return checked_info(
            self.name,
            first.image,
            encoding=self._encoding,
            width_px=self._size[0],
            height_px=self._size[1],
            settings=settings,
        )

    def _connect(self) -> dict[str, float | str]:
        import cv2

        self.close()
        video = open_video(str(self._path), cv2.CAP_FFMPEG, [])
        if video is None:
            raise DeviceError(f"{self.name}: no video that this OpenCV's FFmpeg can read")
        self._video = video
        codec = four_letters(video.get(cv2.CAP_PROP_FOURCC))
        pixels = four_letters(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        if pixels in _GREY:
            apply(video, [Setting("convert_rgb", cv2.CAP_PROP_CONVERT_RGB, 0.0)], camera=self.name)
        elif rounded(pixels):
            raise DeviceError(
                f"{self.name}: its pixels are {pixels}; reading them here would round them to 8 bit",
                hint="convert it to grey of 16 bit: ffmpeg -i IN -c:v ffv1 -pix_fmt gray16le OUT.mkv",
            )
        self._slices = SliceCheck.of(self._path) if codec.casefold() == "ffv1" else None
        self._frames = 0
        self._expected = max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
        return {
            "codec": codec,
            "pixels": pixels,
            "frames": float(self._expected),
            "slice_crc": "checked" if self._slices else "none",
            "time": "hand-over",
        }

    def fetch(self) -> Fetched | None:
        """The next frame.

        Raises
        ------
        DamagedFrameError
            A checksum inside this frame (FFV1) does not fit; FFmpeg shows older pixels instead.
        DeviceError
            The file ends well before its last frame.
        """
        if self._video is None:
            raise DeviceError(f"{self.name}: is not open")
        ok, image = self._video.read()
        sound = self._slices is None or self._slices.next_is_sound()
        if not ok:
            # Containers without a count give an estimate from duration and rate, off by one at most.
            if self._frames + 1 < self._expected:
                raise DeviceError(
                    f"{self.name}: ends after {self._frames} of {self._expected} frames: "
                    "cut off or damaged",
                    hint="copy it again from its source",
                )
            return None
        self._frames += 1
        if not sound:
            raise DamagedFrameError(
                f"{self.name}: frame {self._frames - 1} is damaged (checksum of a slice)",
                hint="copy it again from its source",
            )
        return Fetched(image, time.monotonic_ns())

    def set_exposure(self, exposure_us: float) -> float:
        """Refused, as the read-back shows."""
        import cv2

        if self._video is None:
            raise DeviceError(f"{self.name}: is not open")
        wanted = Setting("exposure_us", cv2.CAP_PROP_EXPOSURE, exposure_us)
        return apply(self._video, [wanted], camera=self.name)["exposure_us"]

    def close(self) -> None:
        """Close the file."""
        if self._slices is not None:
            self._slices.close()
            self._slices = None
        if self._video is not None:
            self._video.release()
            self._video = None
