"""Image messages to frames: pixels as they are, compressed bytes as they are, else a clear no.

Encodings are those of ROS (sensor_msgs/image_encodings.hpp) and Foxglove (RawImage). Colour order is
turned round and rows are packed; values never change. Bayer mosaics, YUV and floating point would
have to be computed into something else, so they are refused by name.
"""

from __future__ import annotations

import base64
import binascii
from typing import TYPE_CHECKING, Any, Literal

from ...schemas.errors import InputError
from ..image_reading import LARGEST_PX, check_image
from ..sealing import ImportedFrame, image_kind

if TYPE_CHECKING:
    import numpy.typing as npt
    from mcap.records import Schema

from .trees import is_named

#: Encoding -> (bytes a channel, channels, whether red comes first).
RAW = {
    "mono8": (1, 1, False),
    "8UC1": (1, 1, False),
    "mono16": (2, 1, False),
    "16UC1": (2, 1, False),
    "bgr8": (1, 3, False),
    "rgb8": (1, 3, True),
    "bgra8": (1, 4, False),
    "rgba8": (1, 4, True),
}
_FORMATS = ("jpeg", "jpg", "png")


def image_role(schema: Schema | None) -> Literal["raw", "compressed"] | None:
    """What kind of image the messages of this schema are, or None."""
    if is_named(schema, "sensor_msgs/Image", "foxglove.RawImage", "foxglove_msgs/RawImage"):
        return "raw"
    names = ("sensor_msgs/CompressedImage", "foxglove.CompressedImage", "foxglove_msgs/CompressedImage")
    return "compressed" if is_named(schema, *names) else None


def frame_of(
    tree: Any, role: Literal["raw", "compressed"], *, t_ns: int, lasers_on: tuple[int, ...], where: str
) -> ImportedFrame:
    """The frame that a message is; ``where`` names it in errors.

    Raises
    ------
    InputError
        A field is missing, the size does not fit the data, or the encoding cannot be kept exactly.
    """
    data = _bytes(_field(tree, "data", (bytes, memoryview, str), where), where)
    if role == "compressed":
        claimed = str(_field(tree, "format", (str,), where))
        if "compresseddepth" in claimed.lower():
            raise InputError(f"{where}: its format is {claimed!r}, a depth image, not a photograph")
        image = check_image(bytes(data), where=where, claimed=claimed or "known")
        if image.encoding not in _FORMATS:
            raise InputError(f"{where}: holds a {image.encoding}, its format says {claimed!r}")
        return image.as_frame(t_ns, lasers_on)
    pixels = _pixels(tree, data, where)
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    height, width = pixels.shape[:2]
    return ImportedFrame(
        t_ns=t_ns,
        lasers_on=lasers_on,
        where=where,
        kind=image_kind(width, height, channels, 8 * pixels.dtype.itemsize),
        width_px=width,
        height_px=height,
        pixels=pixels,
    )


def _field(tree: Any, name: str, kinds: tuple[type, ...], where: str) -> Any:
    value = tree.get(name) if isinstance(tree, dict) else None
    if not isinstance(value, kinds) or isinstance(value, bool):
        shown = "missing" if value is None else f"a {type(value).__name__}"
        raise InputError(f"{where}: its field {name} is {shown}, so it is no image message")
    return value


def _bytes(value: bytes | memoryview | str, where: str) -> bytes | memoryview:
    """JSON carries bytes as base64."""
    if not isinstance(value, str):
        return value
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError) as error:
        raise InputError(f"{where}: its data is no base64 ({error})") from error


def _pixels(tree: Any, data: bytes | memoryview, where: str) -> npt.NDArray[Any]:
    """(H, W) uint8 or uint16, or (H, W, 3) uint8 in BGR order."""
    import numpy as np

    encoding = _field(tree, "encoding", (str,), where)
    if encoding not in RAW:
        raise InputError(
            f"{where}: its encoding {encoding!r} cannot be kept exactly",
            hint=f"known: {', '.join(RAW)}; convert the images (image_proc, ffmpeg) to one of these",
        )
    size, channels, red_first = RAW[encoding]
    width, height = _field(tree, "width", (int,), where), _field(tree, "height", (int,), where)
    step = _field(tree, "step", (int,), where)
    row = width * channels * size
    if min(width, height) < 1 or width * height > LARGEST_PX:
        raise InputError(f"{where}: claims a size of {width} x {height} pixels")
    if step < row or step * height != len(data):
        raise InputError(
            f"{where}: {width} x {height} {encoding} with rows of {step} bytes needs "
            f"{max(step, row) * height} bytes, {len(data)} are there"
        )
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]
    if size == 2:
        order = ">" if tree.get("is_bigendian") else "<"
        wide = np.ascontiguousarray(rows).view(f"{order}u2")
        return wide.astype("<u2", copy=False)
    if channels == 1:
        return rows
    colour = rows.reshape(height, width, channels)
    if channels == 4:
        alpha = colour[:, :, 3]
        if alpha.min() != alpha.max():
            raise InputError(
                f"{where}: its encoding {encoding!r} has an alpha channel that is not constant",
                hint="a scan log holds grey and colour; alpha that says something would be lost",
            )
        colour = colour[:, :, :3]
    return np.ascontiguousarray(colour[:, :, ::-1] if red_first else colour)
