"""Write ROS 2 messages: an encoder of its own, so that the decoder is not tested against itself."""

from __future__ import annotations

import struct
from typing import Any

KINDS = "bool byte char int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64"
LETTERS = dict(zip(KINDS.split(), "?BBbBhHiIqQfd", strict=True))

TEXTS = {
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "sensor_msgs/msg/Image": (
        "# an image\nstd_msgs/Header header # with a stamp\nuint32 height\nuint32 width\n"
        "string encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\n\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort\n"
    ),
    "std_msgs/msg/Float64": "float64 data\n",
    "std_msgs/msg/Float32": "float32 data\n",
    "std_msgs/msg/Bool": "bool data\n",
    "std_msgs/msg/String": "string data\n",
    "sensor_msgs/msg/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
        "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
        "RegionOfInterest roi\n"
    ),
}
PARTS = {
    "sensor_msgs/msg/CameraInfo": ("sensor_msgs/msg/RegionOfInterest",),
}


def full_text(name: str) -> str:
    """The message's text with those of all that it holds, as recorders write it."""
    needed = list(PARTS.get(name, ()))
    if "Header" in TEXTS[name]:
        needed += ["std_msgs/msg/Header", "builtin_interfaces/msg/Time"]
    rule = "=" * 80
    return TEXTS[name] + "".join(f"{rule}\nMSG: {n.replace('/msg/', '/')}\n{TEXTS[n]}" for n in needed)


class Writer:
    """XCDR 1, plain."""

    def __init__(self, order: str = "<") -> None:
        self.order = order
        self.out = bytearray()

    def number(self, kind: str, value: Any) -> None:
        letter = LETTERS[kind]
        size = struct.calcsize(f"={letter}")
        while len(self.out) % size:
            self.out.append(0)
        self.out += struct.pack(f"{self.order}{letter}", value)

    def text(self, value: str) -> None:
        data = value.encode() + b"\0"
        self.number("uint32", len(data))
        self.out += data

    def done(self) -> bytes:
        return (b"\0\1\0\0" if self.order == "<" else b"\0\0\0\0") + bytes(self.out)


def write(fields: list[tuple[str, Any]], order: str = "<") -> bytes:
    """(type, value) of every field; ``T[]`` a sequence, ``T[n]`` an array, struct: a list of such."""
    writer = Writer(order)
    _fields(writer, fields)
    return writer.done()


def _fields(writer: Writer, fields: list[tuple[str, Any]]) -> None:
    for kind, value in fields:
        base, _, array = kind.partition("[")
        if not array:
            _one(writer, base, value)
            continue
        if array == "]":
            writer.number("uint32", len(value))
        if base in ("uint8", "byte", "char"):
            writer.out += bytes(value)
            continue
        for item in value:
            _one(writer, base, item)


def _one(writer: Writer, kind: str, value: Any) -> None:
    if kind == "struct":
        _fields(writer, value)
    elif kind == "string":
        writer.text(value)
    else:
        writer.number(kind, value)


def header(t_ns: int) -> tuple[str, Any]:
    return "struct", [
        ("struct", [("int32", t_ns // 10**9), ("uint32", t_ns % 10**9)]),
        ("string", "camera"),
    ]


def image(
    t_ns: int,
    encoding: str,
    data: bytes,
    *,
    width: int,
    height: int,
    step: int,
    big: int = 0,
    order: str = "<",
) -> bytes:
    return write(
        [
            header(t_ns),
            ("uint32", height),
            ("uint32", width),
            ("string", encoding),
            ("uint8", big),
            ("uint32", step),
            ("uint8[]", data),
        ],
        order,
    )


def compressed(t_ns: int, fmt: str, data: bytes) -> bytes:
    return write([header(t_ns), ("string", fmt), ("uint8[]", data)])


def joints(t_ns: int, positions: dict[str, float], velocity: float | None = None) -> bytes:
    speeds = [] if velocity is None else [velocity] * len(positions)
    return write(
        [
            header(t_ns),
            ("string[]", list(positions)),
            ("float64[]", list(positions.values())),
            ("float64[]", speeds),
            ("float64[]", []),
        ]
    )


def camera_info(
    t_ns: int, k: list[float], d: list[float], *, width: int = 64, height: int = 48
) -> bytes:
    return write(
        [
            header(t_ns),
            ("uint32", height),
            ("uint32", width),
            ("string", "plumb_bob"),
            ("float64[]", d),
            ("float64[9]", k),
            ("float64[9]", [1.0, 0, 0, 0, 1, 0, 0, 0, 1]),
            ("float64[12]", [0.0] * 12),
            ("uint32", 0),
            ("uint32", 0),
            ("struct", [("uint32", 0)] * 4 + [("bool", False)]),
        ]
    )
