"""One message of any encoding as a plain tree: dicts, lists and values, whatever wrote it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ...schemas.errors import InputError
from .cdr import CdrDecoder
from .definitions import parse_definitions, short_name, standard_definitions

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

Decode = Callable[[memoryview], Any]

#: A second has this many nanoseconds.
SECOND_NS = 1_000_000_000


def decoder_for(schema: Schema | None, channel: Channel) -> Decode:
    """The function that turns a message of ``channel`` into a tree.

    Raises
    ------
    InputError
        The channel's encoding, or its schema's, cannot be read.
    """
    encoding = channel.message_encoding
    if encoding == "json":
        return _json
    if encoding == "cdr" and schema is not None:
        return _cdr(schema, channel.topic)
    if encoding == "protobuf" and schema is not None and schema.encoding == "protobuf":
        return _protobuf(schema, channel.topic)
    what = f"{encoding!r} with {f'schema {schema.name!r}' if schema else 'no schema'}"
    hint = "known: cdr (ROS 2), json, protobuf"
    if encoding == "ros1":
        hint = "ROS 1 recordings: convert them to ROS 2 first (rosbags-convert)"
    raise InputError(f"topic {channel.topic}: messages are {what}", hint=hint)


def _json(message: memoryview) -> Any:
    try:
        return json.loads(bytes(message))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON ({error})") from error


def _cdr(schema: Schema, topic: str) -> Decode:
    definitions = None
    if schema.encoding == "ros2msg" and schema.data:
        definitions = parse_definitions(schema.name, schema.data.decode("utf-8", "replace"))
    else:
        definitions = standard_definitions(schema.name)
    if definitions is None:
        raise InputError(
            f"topic {topic}: the file has no ros2msg definition of {schema.name} "
            f"(its schema is {schema.encoding or 'empty'!r})",
            hint="of messages without a definition, the standard ones of std_msgs and sensor_msgs "
            "can be read",
        )
    return CdrDecoder(definitions).decode


def _protobuf(schema: Schema, topic: str) -> Decode:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

    pool = DescriptorPool()
    try:
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        message_class = GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (DecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"topic {topic}: its protobuf schema {schema.name!r} cannot be read ({error})"
        ) from error

    def decode(message: memoryview) -> Any:
        try:
            return _tree(message_class.FromString(bytes(message)))
        except DecodeError as error:
            raise InputError(f"no {schema.name} message ({error})") from error

    return decode


def _tree(message: Any) -> dict[str, Any]:
    """Fields by name; one that may be absent, and is, is None (not the zero that protobuf gives)."""
    out: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            is_message = field.message_type.fields_by_name["value"].message_type is not None
            out[field.name] = {str(k): _tree(v) if is_message else v for k, v in value.items()}
        elif field.is_repeated:
            out[field.name] = [_tree(v) for v in value] if field.message_type else list(value)
        elif field.has_presence and not message.HasField(field.name):
            out[field.name] = None
        else:
            out[field.name] = _tree(value) if field.message_type else value
    return out


def stamp_ns(tree: Any) -> int | None:
    """The time that the message itself says, or None where it says none (a stamp of zero is none).

    ROS: ``header.stamp``; Foxglove: ``timestamp``; turnscan: ``t_ns``.
    """
    if not isinstance(tree, dict):
        return None
    if isinstance(tree.get("t_ns"), int):
        return int(tree["t_ns"]) or None
    header = tree.get("header")
    stamp = header.get("stamp") if isinstance(header, dict) else tree.get("timestamp")
    if not isinstance(stamp, dict):
        return None
    seconds = next((stamp[k] for k in ("sec", "seconds") if k in stamp), None)
    nanos = next((stamp[k] for k in ("nanosec", "nsec", "nanos") if k in stamp), None)
    if not isinstance(seconds, int) or not isinstance(nanos, int):
        return None
    t_ns = seconds * SECOND_NS + nanos
    return t_ns if 0 < t_ns < 2**63 and 0 <= nanos < SECOND_NS else None


def is_named(schema: Schema | None, *names: str) -> bool:
    """Whether the schema is one of ``names``, given as ``package/Name`` or ``foxglove.Name``."""
    return schema is not None and short_name(schema.name) in names
