"""The protobuf wire form of ``foxglove.RawImage`` and ``foxglove.CompressedImage``.

Written and walked by hand so that a frame's pixels are never copied: encoding gives the small fields
and leaves the pixel buffer to follow as it is, decoding gives a view into the message. Everything is
checked against the generated classes in the tests. Field numbers: Foxglove's published schemas;
wire types: the Protocol Buffers encoding guide. Foxglove draws compressed images of format jpeg,
png, webp and avif; tiff and bmp are kept all the same, because original bytes are worth more.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from .errors import DamageError

RAW_IMAGE: Final = "foxglove.RawImage"
COMPRESSED_IMAGE: Final = "foxglove.CompressedImage"

#: RawImage encoding -> (bytes a channel, channels).
ENCODINGS: Final = {"mono8": (1, 1), "mono16": (2, 1), "bgr8": (1, 3)}

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


@dataclass(frozen=True)
class ImageMessage:
    """One decoded image message; ``data`` is a view into the message it came from.

    For a raw image ``encoding`` is a key of :data:`ENCODINGS`, rows are ``step`` bytes apart and
    mono16 is little-endian. For a compressed one ``encoding`` is the file format ("png", "jpeg",
    "tiff", "bmp") and width, height and step are 0.
    """

    schema: str
    t_ns: int
    camera: str
    encoding: str
    width_px: int
    height_px: int
    step: int
    data: memoryview


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _tagged(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | _BYTES) + _varint(len(data)) + data


def _timestamp(t_ns: int) -> bytes:
    seconds, nanos = divmod(t_ns, 1_000_000_000)
    return _tagged(1, b"\x08" + _varint(seconds) + b"\x10" + _varint(nanos))


def raw_image_head(
    *, t_ns: int, camera: str, width_px: int, height_px: int, encoding: str, step: int, size: int
) -> bytes:
    """All of a RawImage but its pixels: ``size`` bytes of pixels must follow directly."""
    return b"".join(
        (
            _timestamp(t_ns),
            b"\x15" + struct.pack("<I", width_px),
            b"\x1d" + struct.pack("<I", height_px),
            _tagged(4, encoding.encode()),
            b"\x2d" + struct.pack("<I", step),
            _tagged(7, camera.encode()),
            _varint(6 << 3 | _BYTES),
            _varint(size),
        )
    )


def compressed_image_head(*, t_ns: int, camera: str, encoding: str, size: int) -> bytes:
    """All of a CompressedImage but its data: ``size`` bytes of the file must follow directly."""
    return b"".join(
        (
            _timestamp(t_ns),
            _tagged(3, encoding.encode()),
            _tagged(4, camera.encode()),
            _varint(2 << 3 | _BYTES),
            _varint(size),
        )
    )


class _Walker:
    """Fields of one protobuf message, in order."""

    def __init__(self, data: memoryview) -> None:
        self.data = data
        self.at = 0

    def varint(self) -> int:
        value = shift = 0
        while True:
            if self.at >= len(self.data) or shift > 63:
                raise DamageError("image message: a number runs past its end")
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7

    def take(self, size: int) -> memoryview:
        if size > len(self.data) - self.at:
            raise DamageError(
                f"image message: a field of {size} bytes runs past its end ({len(self.data)} bytes)"
            )
        self.at += size
        return self.data[self.at - size : self.at]

    def fields(self) -> dict[int, int | memoryview]:
        """Field number -> its last value, as protobuf readers do."""
        out: dict[int, int | memoryview] = {}
        while self.at < len(self.data):
            tag = self.varint()
            kind = tag & 7
            if kind == _VARINT:
                out[tag >> 3] = self.varint()
            elif kind == _BYTES:
                out[tag >> 3] = self.take(self.varint())
            elif kind == _FIXED32:
                out[tag >> 3] = int.from_bytes(self.take(4), "little")
            elif kind == _FIXED64:
                out[tag >> 3] = int.from_bytes(self.take(8), "little")
            else:
                raise DamageError(f"image message: unknown wire type {kind}")
        return out


def _number(fields: dict[int, int | memoryview], field: int) -> int:
    value = fields.get(field, 0)
    if not isinstance(value, int):
        raise DamageError(f"image message: field {field} is no number")
    return value


def _buffer(fields: dict[int, int | memoryview], field: int) -> memoryview:
    value = fields.get(field, memoryview(b""))
    if isinstance(value, int):
        raise DamageError(f"image message: field {field} is no text or bytes")
    return value


def _text(fields: dict[int, int | memoryview], field: int) -> str:
    try:
        return str(_buffer(fields, field), "utf-8")
    except UnicodeDecodeError as error:
        raise DamageError(f"image message: field {field} is no text") from error


def decode_image(schema: str, message: memoryview) -> ImageMessage:
    """The image in ``message``, without copying its data.

    Raises
    ------
    DamageError
        The bytes are no such message, or a raw image's size does not fit its data.
    """
    if schema not in (RAW_IMAGE, COMPRESSED_IMAGE):
        raise DamageError(f"{schema!r} is no image message that turnscan knows")
    fields = _Walker(message).fields()
    stamp = _Walker(_buffer(fields, 1)).fields()
    t_ns = _number(stamp, 1) * 1_000_000_000 + _number(stamp, 2)
    if schema == COMPRESSED_IMAGE:
        return ImageMessage(
            schema, t_ns, _text(fields, 4), _text(fields, 3), 0, 0, 0, _buffer(fields, 2)
        )
    image = ImageMessage(
        schema,
        t_ns,
        _text(fields, 7),
        _text(fields, 4),
        _number(fields, 2),
        _number(fields, 3),
        _number(fields, 5),
        _buffer(fields, 6),
    )
    if image.encoding not in ENCODINGS:
        raise DamageError(f"image message: encoding {image.encoding!r} is not one of {[*ENCODINGS]}")
    size, channels = ENCODINGS[image.encoding]
    if image.step < image.width_px * size * channels or image.step * image.height_px != len(image.data):
        raise DamageError(
            f"image message: {image.width_px} x {image.height_px} {image.encoding} with step "
            f"{image.step} does not fit {len(image.data)} bytes"
        )
    return image
