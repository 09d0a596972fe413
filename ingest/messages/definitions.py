"""Read ROS message definitions, as MCAP files carry them ("ros2msg": the text of .msg files).

A file's own definitions say how its messages are laid out, so any message can be read, not only the
ones known beforehand. Where a file names a standard message without its definition (or gives it as
IDL), the one below stands in. Format: ROS 2 documentation, "About ROS 2 interfaces"; several texts
are joined by a line of ``=`` and a line ``MSG: package/Name``, as the MCAP specification says.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from ...schemas.errors import InputError

#: Primitive -> (struct letter, bytes). A string is length-prefixed and stands in the decoder.
PRIMITIVES = {
    "bool": ("?", 1),
    "byte": ("B", 1),
    "char": ("B", 1),
    "int8": ("b", 1),
    "uint8": ("B", 1),
    "int16": ("h", 2),
    "uint16": ("H", 2),
    "int32": ("i", 4),
    "uint32": ("I", 4),
    "int64": ("q", 8),
    "uint64": ("Q", 8),
    "float32": ("f", 4),
    "float64": ("d", 8),
}
TEXTS = ("string", "wstring")

_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<eq>=)?"
)

# Facts of the ROS 2 interface packages builtin_interfaces, std_msgs and sensor_msgs: names, order and
# types of the fields are the wire format.
_STANDARD = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    **{
        f"std_msgs/{kind.capitalize() if not kind.startswith('uint') else 'UInt' + kind[4:]}": (
            f"{kind} data"
        )
        for kind in PRIMITIVES
    },
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort"
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n"
        "uint32 binning_y\nRegionOfInterest roi"
    ),
}


@dataclass(frozen=True)
class Field:
    """One field: a primitive, a text or another message; alone, ``count`` times, or as a sequence."""

    name: str
    type: str
    is_array: bool = False
    count: int | None = None


Definitions = dict[str, tuple[Field, ...]]


def short_name(name: str) -> str:
    """``package/Name`` of ``package/msg/Name``."""
    return name.replace("/msg/", "/")


def standard_definitions(name: str) -> Definitions | None:
    """The definitions of a standard message and all that it holds, or None if it is none of these."""
    return (
        parse_definitions(name, _STANDARD[short_name(name)]) if short_name(name) in _STANDARD else None
    )


def parse_definitions(name: str, text: str) -> Definitions:
    """Message name -> its fields, for ``name`` and every message that it holds.

    Raises
    ------
    InputError
        A line is no field, or a type is defined nowhere.
    """
    root = short_name(name)
    first, *rest = _SEPARATOR.split(text.replace("\r\n", "\n"))
    texts = {root: first}
    for part in rest:
        head, _, body = part.lstrip("\n").partition("\n")
        if head.startswith("MSG:"):
            texts[short_name(head.removeprefix("MSG:").strip())] = body
    out: Definitions = {}
    wanted = [root]
    while wanted:
        one = wanted.pop()
        if one in out:
            continue
        found = texts.get(one, _STANDARD.get(one))
        if found is None:
            raise InputError(
                f"message {name}: the type {one} is defined nowhere in the file",
                hint="record it again with the schemas of its messages",
            )
        out[one] = _fields(one, found)
        wanted += [f.type for f in out[one] if f.type not in PRIMITIVES and f.type not in TEXTS]
    _check_finite(root, out, ())
    return {root: out.pop(root), **out}


def _check_finite(name: str, definitions: Definitions, above: tuple[str, ...]) -> None:
    """A message that holds itself would never end; ROS knows none."""
    if name in above:
        raise InputError(f"message {above[0]}: {name} holds itself")
    for field in definitions[name]:
        if field.type in definitions:
            _check_finite(field.type, definitions, (*above, name))


def _fields(message: str, text: str) -> tuple[Field, ...]:
    package = message.split("/", maxsplit=1)[0]
    out = []
    for line in text.splitlines():
        plain = line.strip()
        if not plain or plain.startswith("#"):
            continue
        match = _FIELD.match(plain)
        if match is None:
            raise InputError(f"message {message}: {plain[:60]!r} is no field of a ROS message")
        if match["eq"]:
            continue  # A constant: not in the message.
        kind = short_name(match["type"])
        if kind == "Header":
            kind = "std_msgs/Header"
        elif kind not in PRIMITIVES and kind not in TEXTS and "/" not in kind:
            kind = f"{package}/{kind}"
        array = match["array"]
        fixed = array is not None and array[1:-1].isdigit()
        out.append(Field(match["name"], kind, array is not None, int(array[1:-1]) if fixed else None))
    return tuple(out)
