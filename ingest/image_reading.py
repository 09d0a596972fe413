"""Read one image file whole and be sure that it is: decoders forgive what an archive must not.

OpenCV fills the missing part of a truncated JPEG with grey and says nothing, so the end of every file
is looked at, and its pixels are decoded once.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from ..schemas.errors import DamageError, InputError
from ..store.log_reader import decode_image_file
from .image_sources import FORMATS

_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class ImageFile:
    """A checked image: its original bytes, its format, and what its pixels are."""

    path: Path
    data: bytes
    encoding: str
    width_px: int
    height_px: int
    channels: int
    dtype: str

    @property
    def kind(self) -> str:
        """Size, channels and depth in words; all images of a scan must have the same."""
        colour = {1: "grey", 3: "colour", 4: "colour with alpha"}[self.channels]
        bits = "8 bit" if self.dtype == "uint8" else "16 bit"
        return f"{self.width_px} x {self.height_px}, {colour}, {bits}"


def read_image(path: Path) -> ImageFile:
    """The image in ``path``, decoded once to be sure of it.

    Raises
    ------
    InputError
        The file cannot be read, is cut off, is another format than its name says, has several pages,
        or holds pixels that are neither 8 nor 16 bit.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    encoding = FORMATS[path.suffix.lower()]
    found = _sniff(data)
    if found is None:
        raise InputError(f"{path}: is no {encoding.upper()} image", hint="leave it out, or replace it")
    try:
        complete = _CHECKS[found](data)
    except (struct.error, IndexError):
        complete = False
    if not complete:
        raise InputError(
            f"{path}: the image is cut off ({len(data)} bytes)", hint="copy it again from its source"
        )
    if found == "tiff" and _tiff_pages(data) > 1:
        raise InputError(f"{path}: holds several pages", hint="save each page as a file of its own")
    try:
        pixels = decode_image_file(data, where=str(path))
    except DamageError as error:
        raise InputError(str(error), hint="copy it again from its source, or leave it out") from error
    if pixels.dtype not in ("uint8", "uint16"):
        raise InputError(f"{path}: pixels are {pixels.dtype}, expected 8 or 16 bit")
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels not in (1, 3, 4):
        raise InputError(f"{path}: has {channels} channels, expected grey or colour")
    height, width = pixels.shape[:2]
    return ImageFile(path, data, found, width, height, channels, str(pixels.dtype))


def _sniff(data: bytes) -> str | None:
    if data.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if data.startswith(_PNG):
        return "png"
    if data.startswith(b"BM"):
        return "bmp"
    if data.startswith((b"II*\0", b"MM\0*")):
        return "tiff"
    return None


def _jpeg_complete(data: bytes) -> bool:
    """The end-of-image marker closes the scan data; some cameras append more after it."""
    at = 2
    while True:
        if data[at] != 0xFF:
            return False
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker == 0xD9:
            return True
        if marker == 0x01 or 0xD0 <= marker <= 0xD7:
            at += 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        at += 2 + length
        if marker == 0xDA:
            # Entropy-coded data: 0xFF is followed by 0 or a restart marker until the next segment.
            while True:
                at = data.find(b"\xff", at)
                if at < 0:
                    return False
                if data[at + 1] == 0 or 0xD0 <= data[at + 1] <= 0xD7:
                    at += 2
                else:
                    break


def _png_complete(data: bytes) -> bool:
    """Chunks follow one another up to IEND."""
    at = len(_PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at += 12 + length
    return False


def _bmp_complete(data: bytes) -> bool:
    """The head's file size, or the pixels that it promises, are there."""
    offset, _, width, height = struct.unpack_from("<IIii", data, 10)
    bits, compression = struct.unpack_from("<HI", data, 28)
    if compression not in (0, 3):
        return len(data) >= struct.unpack_from("<I", data, 2)[0]
    stride = (width * bits + 31) // 32 * 4
    return len(data) >= offset + stride * abs(height)


_TIFF_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8}
_STRIP_OFFSETS, _STRIP_BYTES, _TILE_OFFSETS, _TILE_BYTES = 273, 279, 324, 325


def _tiff_directory(data: bytes, at: int) -> tuple[dict[int, list[int]], int]:
    """Integer tags of the directory at ``at``, and where the next one is (0: none)."""
    order = "<" if data[:2] == b"II" else ">"
    (count,) = struct.unpack_from(f"{order}H", data, at)
    tags: dict[int, list[int]] = {}
    for i in range(count):
        tag, kind, number = struct.unpack_from(f"{order}HHI", data, at + 2 + 12 * i)
        if kind not in (3, 4):
            continue
        size = _TIFF_SIZES[kind] * number
        start = at + 10 + 12 * i
        if size > 4:
            (start,) = struct.unpack_from(f"{order}I", data, start)
        letter = "H" if kind == 3 else "I"
        tags[tag] = list(struct.unpack_from(f"{order}{number}{letter}", data, start))
    (following,) = struct.unpack_from(f"{order}I", data, at + 2 + 12 * count)
    return tags, following


def _tiff_first(data: bytes) -> int:
    (at,) = struct.unpack_from("<I" if data[:2] == b"II" else ">I", data, 4)
    return int(at)


def _tiff_complete(data: bytes) -> bool:
    """Every strip or tile that the first directory names lies inside the file."""
    tags, _ = _tiff_directory(data, _tiff_first(data))
    for offsets, sizes in ((_STRIP_OFFSETS, _STRIP_BYTES), (_TILE_OFFSETS, _TILE_BYTES)):
        if offsets in tags:
            ends = [a + b for a, b in zip(tags[offsets], tags.get(sizes, []), strict=False)]
            return bool(ends) and max(ends) <= len(data)
    return False


def _tiff_pages(data: bytes) -> int:
    _, following = _tiff_directory(data, _tiff_first(data))
    return 2 if following else 1


_CHECKS = {
    "jpeg": _jpeg_complete,
    "png": _png_complete,
    "bmp": _bmp_complete,
    "tiff": _tiff_complete,
}
