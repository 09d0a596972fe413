"""Whether a video file is whole: its container says how long it is. And its frames, through FFmpeg.

Decoders stop quietly where a file ends, and may give a last frame that is half garbage, so the sizes
that the container claims are held against the file first. Matroska: RFC 9559 and RFC 8794 (EBML);
MP4 and MOV: ISO/IEC 14496-12, 4.2 (boxes); AVI: RIFF chunks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from ..schemas.errors import InputError, StorageError
from .devices.cameras.ffv1 import SliceCheck, slices_sound
from .devices.cameras.opencv import four_letters, open_video

if TYPE_CHECKING:
    import cv2
    import numpy.typing as npt

# FFmpeg's tags of pixel formats that OpenCV hands over as they are: grey of 8 and of 16 bit.
_GREY = {"Y800", "GREY", "Y1[0][16]"}
# Codecs of which every packet is an image file by itself: its bytes are kept as they are.
_WHOLE_FILES = {"mjpg": "jpeg", "jpeg": "jpeg"}
_HIDDEN = {"vp80", "vp90", "av01"}


def missing_bytes(path: Path) -> int:
    """How many bytes the container promises beyond the end of the file; 0 where it is whole, or where
    the container does not say.

    Raises
    ------
    StorageError
        The file cannot be read.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(12)
            if head[:4] == b"\x1a\x45\xdf\xa3":
                return max(_matroska_end(file) - size, 0)
            if head[:4] == b"RIFF":
                return max(_riff_end(file, size) - size, 0)
            if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
                return max(_boxes_end(file, size) - size, 0)
    except FileNotFoundError as error:
        raise StorageError(f"{path}: no such file") from error
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror})") from error
    return 0


def _ebml_number(file: BinaryIO, *, keep_marker: bool) -> int | None:
    """A variable-size integer (RFC 8794, 4); None: unknown size, or the file ends."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    length = 9 - first[0].bit_length()
    data = first + file.read(length - 1)
    value = int.from_bytes(data, "big")
    marker = 1 << 7 * length
    if keep_marker:
        return value
    return None if value == 2 * marker - 1 else value - marker


def _matroska_end(file: BinaryIO) -> int:
    """Where the Segment, which holds everything behind the EBML head, says that it ends."""
    file.seek(0)
    for _ in range(2):
        _ebml_number(file, keep_marker=True)
        size = _ebml_number(file, keep_marker=False)
        if size is None:  # Written to a pipe: the end was never filled in.
            return 0
        file.seek(size, os.SEEK_CUR)
    return file.tell()


def _riff_end(file: BinaryIO, size: int) -> int:
    """AVI files above 1 GiB are several RIFF chunks, one behind the other."""
    at = 0
    while at < size:
        file.seek(at)
        head = file.read(8)
        if len(head) < 8 or head[:4] != b"RIFF":
            break
        at += 8 + int.from_bytes(head[4:], "little")
    return at


def _boxes_end(file: BinaryIO, size: int) -> int:
    at = 0
    while at < size:
        file.seek(at)
        head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        if length == 1:
            length = int.from_bytes(head[8:16], "big")
        if len(head) < 8 or length < 8:  # 0: up to the end of the file.
            break
        at += length
    return at


@dataclass(frozen=True)
class VideoFacts:
    """What a first reading found. ``times_ms`` are the container's; ``promised`` the number of frames
    it speaks of, 0 where it does not; ``stored`` how many it holds, ``damaged`` which of these are not
    what was written, where the codec has checksums (FFV1). ``files``: every frame is an image file of
    this format by itself.
    """

    frames: int
    times_ms: tuple[float, ...]
    fps: float
    codec: str
    grey: bool
    files: str
    promised: int
    missing_bytes: int
    stored: int
    damaged: tuple[int, ...]


def _open(path: Path, *, packets: bool = False) -> cv2.VideoCapture:
    import cv2

    capture = open_video(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1] if packets else [])
    if capture is None:
        raise InputError(
            f"{path}: is no video that FFmpeg can open, or its index is cut off",
            hint="copy it again from its source; an MP4 whose recorder died has no index",
        )
    # Pixels stay as the sensor stored them, because calibrations are true of those.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def video_facts(path: Path) -> VideoFacts:
    """Decode the whole video once, keeping nothing but times.

    Raises
    ------
    InputError
        It is no video, has no frame, or pixels that OpenCV would round.
    StorageError
        The file cannot be read.
    """
    missing = missing_bytes(path)
    import cv2

    capture = _open(path)
    try:
        times = []
        while capture.grab():
            times.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)))
        codec = four_letters(capture.get(cv2.CAP_PROP_FOURCC))
        pixels = four_letters(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        promised = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        fps = float(capture.get(cv2.CAP_PROP_FPS))
    finally:
        capture.release()
    if not times:
        raise InputError(f"{path}: not one frame can be decoded", hint="copy it again from its source")
    files = _WHOLE_FILES.get(codec.casefold(), "")
    if "[" in pixels and pixels not in _GREY and not files:
        # FFmpeg writes the depth of formats beyond 8 bit into their tags.
        raise InputError(
            f"{path}: its pixels are {pixels}; OpenCV would round them to 8 bit",
            hint="convert it to grey of 16 bit: ffmpeg -i IN -c:v ffv1 -pix_fmt gray16le OUT.mkv",
        )
    stored, damaged = _packets(path, codec)
    return VideoFacts(
        frames=len(times),
        times_ms=tuple(times),
        fps=fps,
        codec=codec,
        grey=pixels in _GREY,
        files=files,
        promised=int(promised) if 0 < promised < 2**31 else 0,
        missing_bytes=missing,
        # Of these a packet may be a frame that is never shown.
        stored=len(times) if codec.casefold() in _HIDDEN else stored,
        damaged=damaged,
    )


def _packets(path: Path, codec: str) -> tuple[int, tuple[int, ...]]:
    """How many frames are stored, and which of them do not fit their checksums."""
    check = SliceCheck.of(path) if codec.casefold() == "ffv1" else None
    if check is not None:
        check.close()
    capture = _open(path, packets=True)
    damaged: list[int] = []
    stored = 0
    try:
        while True:
            ok, packet = capture.read()
            if not ok:
                return stored, tuple(damaged)
            if check is not None and not slices_sound(packet.tobytes()):
                damaged.append(stored)
            stored += 1
    finally:
        capture.release()


def decoded(path: Path, facts: VideoFacts) -> Iterator[npt.NDArray[Any]]:
    """Frames in order: (H, W) uint8 or uint16 of a grey video, else (H, W, 3) uint8 in BGR order; or,
    where ``facts.files`` says so, the bytes of an image file each.
    """
    import cv2

    capture = _open(path, packets=bool(facts.files))
    if facts.grey and not facts.files:
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    try:
        while True:
            ok, frame = capture.read()
            if not ok:
                return
            yield frame
    finally:
        capture.release()
