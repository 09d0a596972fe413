"""Salvage an unfinished or damaged log: every whole message goes into a new log that says so."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zstandard
from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from ..schemas.canonical import canonical_json
from ..schemas.channels import topic_of
from ..schemas.errors import DamageError, InputError
from ..schemas.events import ScanEnd, ScanStart
from .log_records import MAGIC, LogMessage, damaged, inner_records, parse_message, parse_record
from .log_writer import LogWriter

_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")


@dataclass(frozen=True)
class Salvage:
    """What was saved, and in words what was not."""

    messages: int
    frames: int
    lost: tuple[str, ...]


def salvage_log(damaged_path: Path, new_path: Path, *, scan: str, salvaged_from: str) -> Salvage:
    """Write every whole message of ``damaged_path`` into a new log at ``new_path``.

    The old file is only read. The new log begins with the old start event, which then names the new
    ``scan`` and ``salvaged_from``, and ends with ``ended = "salvaged"``.

    Raises
    ------
    InputError
        Nothing but a start can be saved, or not even that.
    """
    lost: list[str] = []
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages = frames = 0
    last = 0
    pending: tuple[Any, ...] | None = None
    with LogWriter(new_path) as writer:
        for record in _whole_records(damaged_path, lost):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, LogMessage):
                channel = channels.get(record.channel_id)
                schema = schemas.get(channel.schema_id) if channel else None
                if channel is None or schema is None or topic_of(channel.topic) is None:
                    lost.append(f"a message at t_ns {record.log_time} on an unknown channel")
                    continue
                if channel.topic == "/scan/end":
                    continue
                if record.log_time < last:
                    lost.append(f"a message of {channel.topic} that steps back in time")
                    continue
                last = record.log_time
                data: bytes | memoryview = record.data
                if channel.topic == "/scan/start":
                    start = ScanStart.model_validate_json(bytes(data))
                    change = {"scan": scan, "salvaged_from": salvaged_from}
                    data = canonical_json(start.model_copy(update=change).plain())
                message = (channel.topic, schema.name, record.log_time, data, record.sequence)
                # An exposure event counts only with its image; it is written when that comes.
                if channel.topic.endswith("/exposure"):
                    pending = message
                    continue
                if channel.topic.endswith("/image"):
                    if pending is None or pending[4] != record.sequence:
                        lost.append(f"frame {record.sequence}, whose exposure event is gone")
                        continue
                    _put(writer, pending)
                    messages += 1
                    frames += 1
                    pending = None
                _put(writer, message)
                messages += 1
        if frames == 0:
            raise InputError(
                f"{damaged_path}: no whole frame can be saved",
                hint="the file is kept as it is; nothing was made of it",
            )
        note = f"{len(lost)} losses" if lost else "nothing lost but the end"
        writer.write_event(ScanEnd(t_ns=last, ended="salvaged", frames=frames, note=note))
    return Salvage(messages, frames, tuple(lost))


def _put(writer: LogWriter, message: tuple[Any, ...]) -> None:
    topic, schema, t_ns, data, sequence = message
    writer.write_message(topic, schema, t_ns, data, sequence=sequence)


def _whole_records(path: Path, lost: list[str]) -> Iterator[Any]:
    """Every record that is provably whole; what is not is put into words in ``lost``."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise damaged(path, 0, "it does not begin as an MCAP file")
        offset = len(MAGIC)
        while True:
            head = file.read(9)
            if len(head) < 9:
                if head:
                    lost.append(f"{len(head)} bytes at the end (byte {offset})")
                return
            opcode, length = _RECORD_HEAD.unpack(head)
            cut = length > size - offset - 9
            if cut and opcode != Opcode.CHUNK:
                lost.append(f"a record cut off at byte {offset}")
                return
            body = file.read(length if not cut else size - offset - 9)
            if opcode == Opcode.DATA_END:
                return
            if opcode == Opcode.CHUNK:
                yield from _whole_chunk(memoryview(body), path, offset, lost, cut=cut)
            elif opcode == Opcode.MESSAGE:
                yield parse_message(memoryview(body), path, offset)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield parse_record(opcode, body, path, offset)
            if cut:
                return
            offset += 9 + length


def _whole_chunk(
    body: memoryview, path: Path, offset: int, lost: list[str], *, cut: bool
) -> Iterator[Any]:
    """Records of a chunk whose CRC fits; of one that the end of the file cut, those before the cut.

    A broken chunk that is not cut gives nothing: without its CRC no message can be told from garbage.
    A cut one is a true beginning of what was written, so what decompresses from it is whole.
    """
    try:
        start, end, size, crc, name_size = _CHUNK_HEAD.unpack_from(body)
        at = _CHUNK_HEAD.size + name_size
        name = bytes(body[_CHUNK_HEAD.size : at])
        (stored,) = struct.unpack_from("<Q", body, at)
        data = body[at + 8 : at + 8 + stored]
        if name not in (b"", b"zstd"):
            lost.append(f"the chunk at byte {offset} has the unknown compression {name!r}")
            return
        if cut:
            if name:
                data = memoryview(zstandard.ZstdDecompressor().decompressobj().decompress(data))
            lost.append(f"the end of the chunk at byte {offset}, from its byte {len(data)} of {size}")
            yield from inner_records(_whole_part(data), path, offset, start=start, end=end)
            return
        if name:
            data = memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
        if len(data) != size or isal_zlib.crc32(data) != crc:
            lost.append(f"the chunk at byte {offset} does not fit its CRC")
            return
        yield from inner_records(data, path, offset, start=start, end=end)
    except (struct.error, zstandard.ZstdError, DamageError, MemoryError):
        lost.append(f"the chunk at byte {offset} is cut off or broken")


def _whole_part(data: memoryview) -> memoryview:
    """``data`` up to the end of its last whole record."""
    at = 0
    while at + 9 <= len(data):
        _, length = _RECORD_HEAD.unpack_from(data, at)
        if at + 9 + length > len(data):
            break
        at += 9 + length
    return data[:at]
