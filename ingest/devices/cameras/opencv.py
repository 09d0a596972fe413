"""Opening cv2.VideoCapture: imported late, and silent, since every failure is reported by us."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import cv2

_FFMPEG_QUIET = "-8"
#: OpenCV's wait for a V4L2 frame is 10 s; a camera that stalls would hold its thread so long.
V4L2_WAIT_S = 2


def open_video(source: str | int, backend: int, params: list[int]) -> cv2.VideoCapture | None:
    """An open capture of exactly this backend (no other is tried), or None."""
    # FFmpeg reads this when it is first used; a level that the user chose stays.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _FFMPEG_QUIET)
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(V4L2_WAIT_S))
    import cv2

    if "OPENCV_LOG_LEVEL" not in os.environ:
        # The warnings tell what our own errors tell better.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        video = cv2.VideoCapture(source, backend, params)  # type: ignore[arg-type, call-overload, unused-ignore]
    except cv2.error:
        return None
    if video.isOpened():
        return video
    video.release()
    return None


def four_letters(value: float) -> str:
    """A FourCC as text: letters as they are, other bytes by number."""
    raw = int(value).to_bytes(4, "little", signed=value < 0)
    return "".join(chr(b) if 32 <= b < 127 else f"[{b}]" for b in raw).rstrip()
