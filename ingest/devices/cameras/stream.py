"""MJPEG over HTTP, through OpenCV's FFmpeg capture in raw mode.

FFmpeg only takes the stream apart; each JPEG is decoded here, because FFmpeg's decoding hides what must
be seen: it scales frames of another size to the first one's, shows half a JPEG as a whole one, and
turns grey into colour.
"""

from __future__ import annotations

import time
import urllib.error
import urllib.parse
import urllib.request
from typing import TYPE_CHECKING

from ....schemas.errors import DamageError, DeviceError
from ....store.log_reader import decode_image_file
from ..contracts import CameraInfo
from .capture import DamagedFrameError, Fetched
from .opencv import four_letters, open_video
from .settings import checked_info, no_such_settings
from .watch import no_frame

if TYPE_CHECKING:
    import cv2


class StreamCapture:
    """A network camera.

    Parameters
    ----------
    url
        http:// or https://, answering with multipart/x-mixed-replace JPEGs.
    encoding, width_px, height_px
        What the frames must be; None is not checked.
    exposure_us, gain, white_balance
        Refused when given: a stream cannot be asked.
    open_s, read_s
        Longest waits for the answer and for a frame.
    """

    def __init__(
        self,
        url: str,
        *,
        encoding: str = "mono8",
        width_px: int | None = None,
        height_px: int | None = None,
        exposure_us: float | None = None,
        gain: float | None = None,
        white_balance: float | None = None,
        open_s: float = 2.0,
        read_s: float = 1.8,
    ) -> None:
        self.url = url
        self._encoding = encoding
        self._size = (width_px, height_px)
        self._unavailable = {"exposure_us": exposure_us, "gain": gain, "white_balance": white_balance}
        self._open_s = open_s
        self._read_s = read_s
        self._video: cv2.VideoCapture | None = None

    @property
    def name(self) -> str:
        """Driver and address, without a password that may stand in it: names go into logs."""
        parts = urllib.parse.urlsplit(self.url)
        return f"stream {parts._replace(netloc=parts.netloc.rpartition('@')[2]).geturl()}"

    def open(self) -> CameraInfo:
        """Connect and look at the first frame.

        Raises
        ------
        DeviceError
            No answer, no MJPEG stream, another size or encoding than asked, or a setting that streams
            have not.
        """
        if not self.url.startswith(("http://", "https://")):
            raise DeviceError(
                f"{self.name}: not an address of an HTTP stream",
                hint="it begins with http:// or https://",
            )
        no_such_settings(self.name, self._unavailable)
        import cv2

        self.close()
        video = open_video(
            self.url,
            cv2.CAP_FFMPEG,
            [
                *(cv2.CAP_PROP_FORMAT, -1),
                *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * self._open_s)),
                *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * self._read_s)),
            ],
        )
        if video is None:
            raise DeviceError(
                f"{self.name}: {self._why()}",
                hint="open the address in a browser: does it show the picture?",
            )
        self._video = video
        try:
            return self._look(four_letters(video.get(cv2.CAP_PROP_FOURCC)))
        except DeviceError:
            self.close()
            raise

    def _look(self, codec: str) -> CameraInfo:
        if codec != "MJPG":
            raise DeviceError(
                f"{self.name}: sends {codec}, expected MJPG (motion JPEG)",
                hint="choose MJPEG in the camera; codecs that predict frames from others smear stripes",
            )
        first = self.fetch()
        if first is None:
            raise DeviceError(f"{self.name}: ended before its first frame")
        return checked_info(
            self.name,
            first.image,
            encoding=self._encoding,
            width_px=self._size[0],
            height_px=self._size[1],
            settings={"codec": codec, "time": "arrival"},
        )

    def fetch(self) -> Fetched | None:
        """The next frame, decoded; None when the other side hung up."""
        video = self._video
        if video is None:
            raise DeviceError(f"{self.name}: is not open")
        begun = time.monotonic()
        if not video.grab():
            waited_s = time.monotonic() - begun
            if waited_s > 0.9 * self._read_s:
                raise no_frame(self.name, waited_s)
            return None
        arrived_ns = time.monotonic_ns()
        ok, data = video.retrieve()
        if not ok:
            raise DamagedFrameError(
                f"{self.name}: sends frames without data", hint="check its cable or network"
            )
        try:
            return Fetched(decode_image_file(data, where=self.name), arrived_ns)
        except DamageError as error:
            raise DamagedFrameError(
                f"{self.name}: sends broken JPEGs", hint="check its cable or network"
            ) from error

    def set_exposure(self, exposure_us: float) -> float:
        """Always refused."""
        no_such_settings(self.name, {"exposure_us": exposure_us})
        raise AssertionError

    def close(self) -> None:
        """Hang up."""
        if self._video is not None:
            self._video.release()
            self._video = None

    def _why(self) -> str:
        """Why the stream did not open, found out by asking once more without OpenCV."""
        try:
            with urllib.request.urlopen(self.url, timeout=self._open_s) as answer:  # noqa: S310 (checked)
                kind = answer.headers.get_content_type()
        except urllib.error.HTTPError as error:
            error.close()
            return f"the server answers {error.code} {error.reason}"
        except TimeoutError:
            return f"no answer within {self._open_s:g} s"
        except (urllib.error.URLError, OSError, ValueError) as error:
            return f"cannot be reached ({getattr(error, 'reason', error)})"
        return f"answers with {kind}, not with a stream of JPEGs"
