"""Read one image file whole and be sure that it is: decoders forgive what an archive must not.

libjpeg fills what is missing of a JPEG with grey and only warns, so every file is walked to its end
first, and then its pixels are decoded once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..schemas.errors import DamageError, InputError
from ..store.log_reader import decode_image_file
from .image_sources import FORMATS
from .sealing import ImportedFrame, image_kind

Size = tuple[int, int]

# Twice the largest sensor there is. A few bytes may claim any size, and decoding would believe them.
LARGEST_PX = 1 << 29
_RESAVE = "save it as a PNG or TIFF of 8 or 16 bit, grey or colour"
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class ImageFile:
    """A checked image: its original bytes, its format, and what its pixels are."""

    where: str
    data: bytes
    encoding: str
    width_px: int
    height_px: int
    channels: int
    dtype: str

    @property
    def kind(self) -> str:
        """Size, channels and depth in words; all images of a scan must have the same."""
        bits = 8 if self.dtype == "uint8" else 16
        return image_kind(self.width_px, self.height_px, self.channels, bits)

    def as_frame(
        self, t_ns: int, lasers_on: tuple[int, ...], *, file: str | None = None
    ) -> ImportedFrame:
        """The frame that this image makes of a scan."""
        return ImportedFrame(
            t_ns=t_ns,
            lasers_on=lasers_on,
            where=self.where,
            kind=self.kind,
            width_px=self.width_px,
            height_px=self.height_px,
            file=file,
            data=self.data,
            encoding=self.encoding,
        )


def read_image(path: Path) -> ImageFile:
    """The image in ``path``, decoded once to be sure of it. Its content says what format it has.

    Raises
    ------
    InputError
        The file cannot be read, or :func:`check_image` refuses it.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    return check_image(data, where=str(path), claimed=FORMATS[path.suffix.lower()])


def check_image(data: bytes, *, where: str, claimed: str) -> ImageFile:
    """The image that ``data`` is, decoded once; ``claimed`` is the format that it is said to have.

    Raises
    ------
    InputError
        It is no image, is cut off, claims an absurd size, has several pages, or holds pixels that are
        neither 8 nor 16 bit.
    """
    found = _sniff(data)
    if found is None:
        what = f"is no {claimed.upper()} image" if data else "is empty"
        raise InputError(f"{where}: {what}", hint="leave it out, or replace it")
    try:
        size = _SIZES[found](data)
    except (struct.error, IndexError, KeyError):
        size = None
    if size is None:
        raise InputError(
            f"{where}: the image is cut off ({len(data)} bytes)", hint="copy it again from its source"
        )
    if size[0] * size[1] > LARGEST_PX:
        raise InputError(
            f"{where}: its head says {size[0]} x {size[1]} pixels, more than {LARGEST_PX}",
            hint="leave it out, or replace it",
        )
    if found == "tiff" and _tiff_pages(data) > 1:
        raise InputError(f"{where}: holds several pages", hint="save each page as a file of its own")
    try:
        pixels = decode_image_file(data, where=where)
    except DamageError as error:
        raise InputError(str(error), hint="copy it again from its source, or leave it out") from error
    if pixels.dtype not in ("uint8", "uint16"):
        raise InputError(f"{where}: pixels are {pixels.dtype}, expected 8 or 16 bit", hint=_RESAVE)
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels not in (1, 3, 4):
        raise InputError(f"{where}: has {channels} channels, expected grey or colour", hint=_RESAVE)
    width, height = pixels.shape[1], pixels.shape[0]
    if (width, height) != size:
        raise InputError(
            f"{where}: its head says {size[0]} x {size[1]} pixels, decoding gives {width} x {height}",
            hint="copy it again from its source, or leave it out",
        )
    return ImageFile(where, data, found, width, height, channels, str(pixels.dtype))


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


def _jpeg_size(data: bytes) -> Size | None:
    """The end-of-image marker closes the scan data; some cameras append more after it."""
    at = 2
    size: Size | None = None
    while True:
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker == 0xD9:
            break
        if marker == 0x01 or 0xD0 <= marker <= 0xD7:
            at += 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            size = (width, height)
        (length,) = struct.unpack_from(">H", data, at + 2)
        at += 2 + length
        if marker == 0xDA:
            # Entropy-coded data: 0xFF is followed by 0 or a restart marker until the next segment.
            while True:
                at = data.find(b"\xff", at)
                if at < 0:
                    return None
                if data[at + 1] == 0 or 0xD0 <= data[at + 1] <= 0xD7:
                    at += 2
                else:
                    break
    # A block of 64 pixels takes a bit at least (16 x 16 where colour is coarser): less is not all.
    if size is None or size[0] * size[1] > len(data) * 8 * 256:
        return None
    return size


def _png_size(data: bytes) -> Size | None:
    """Chunks follow one another up to IEND."""
    at = len(_PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        if data[at + 4 : at + 8] == b"IEND":
            width, height = struct.unpack_from(">II", data, len(_PNG) + 8)
            return width, height
        at += 12 + length
    return None


def _bmp_size(data: bytes) -> Size | None:
    """The pixels that the head promises, or its file size where they are packed, are there."""
    file_bytes, _, offset, head_bytes = struct.unpack_from("<IIII", data, 2)
    if head_bytes == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        compression = 0
    else:
        width, height, _, bits, compression = struct.unpack_from("<iiHHI", data, 18)
    stride = (width * bits + 31) // 32 * 4
    needed = offset + stride * abs(height) if compression in (0, 3) else file_bytes
    # Rows stand from the bottom up; a height below zero turns them over.
    return (width, abs(height)) if len(data) >= needed else None


_TIFF_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8}
_WIDTH, _HEIGHT = 256, 257
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


def _tiff_size(data: bytes) -> Size | None:
    """Every strip or tile that the first directory names lies inside the file."""
    tags, _ = _tiff_directory(data, _tiff_first(data))
    for offsets, sizes in ((_STRIP_OFFSETS, _STRIP_BYTES), (_TILE_OFFSETS, _TILE_BYTES)):
        if offsets in tags:
            ends = [a + b for a, b in zip(tags[offsets], tags.get(sizes, []), strict=False)]
            if ends and max(ends) <= len(data):
                return tags[_WIDTH][0], tags[_HEIGHT][0]
    return None


def _tiff_pages(data: bytes) -> int:
    _, following = _tiff_directory(data, _tiff_first(data))
    return 2 if following else 1


# The size in the head of a file that is whole, else None.
_SIZES: dict[str, Callable[[bytes], Size | None]] = {
    "jpeg": _jpeg_size,
    "png": _png_size,
    "bmp": _bmp_size,
    "tiff": _tiff_size,
}
