"""Single records and chunks of an MCAP file, from their bytes; what does not fit is a DamageError.

Messages are views into the decompressed chunk. In which order a file's records come, and what is
checked on the way, is in log_walk.py.
"""

from __future__ import annotations

import io
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import zstandard
from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from ..schemas.errors import DamageError

MAGIC: Final = b"\x89MCAP0\r\n"
_THREAD = threading.local()
_LARGEST_CHUNK: Final = 1 << 31
_CHUNK_HEAD = struct.Struct("<QQQII")
RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY = struct.Struct("<QQ")

_READERS: Final[dict[int, Callable[[ReadDataStream], Any]]] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: SummaryOffset.read,
    Opcode.DATA_END: DataEnd.read,
}


# What is asked for every record: as plain numbers, which compare much faster than members.
_MESSAGE: Final = int(Opcode.MESSAGE)
_REPEATED: Final = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message; ``data`` is a view that stays valid as long as it is held."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    data: memoryview


@dataclass(frozen=True, slots=True)
class TypedMessage(LogMessage):
    """A message of which ``item`` was made already; its data was let go of."""

    item: Any


def damaged(path: Path, offset: int, what: str) -> DamageError:
    """The error for broken bytes of a log."""
    return DamageError(
        f"{path}: damaged at byte {offset}: {what}",
        hint="restore the file from a copy; turnscan repair salvages what is whole",
    )


def parse_record(opcode: int, body: bytes | memoryview, path: Path, offset: int) -> Any:
    """The record in ``body``; None for an opcode that MCAP leaves to others."""
    if opcode == _MESSAGE:
        return parse_message(memoryview(body), path, offset)
    try:
        if opcode == Opcode.MESSAGE_INDEX:
            return _message_index(body)
        if opcode in _REPEATED:
            return _repeated(opcode, bytes(body))
        reader = _READERS.get(opcode)
        return None if reader is None else reader(ReadDataStream(io.BytesIO(body)))
    except (EndOfFile, struct.error, UnicodeDecodeError) as error:
        raise damaged(path, offset, f"a record of kind {opcode:#04x} is malformed") from error


@lru_cache(maxsize=256)
def _repeated(opcode: int, body: bytes) -> Any:
    """A schema or channel record: every chunk repeats those that it uses, byte for byte."""
    return _READERS[opcode](ReadDataStream(io.BytesIO(body)))


def _message_index(body: bytes | memoryview) -> MessageIndex:
    """One stands behind each chunk for each channel: read at once, not number by number."""
    channel, size = _INDEX_HEAD.unpack_from(body)
    entries = memoryview(body)[_INDEX_HEAD.size : _INDEX_HEAD.size + size]
    if len(entries) < size:
        raise EndOfFile
    return MessageIndex(channel, list(_INDEX_ENTRY.iter_unpack(entries)))


def parse_message(body: memoryview, path: Path, offset: int) -> LogMessage:
    """The message in ``body``, without copying its data."""
    if len(body) < _MESSAGE_HEAD.size:
        raise damaged(path, offset, f"a message of {len(body)} bytes")
    channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
    return LogMessage(channel, sequence, log_time, publish_time, body[_MESSAGE_HEAD.size :])


def chunk_records(body: memoryview, path: Path, offset: int, *, strict: bool) -> Iterator[Any]:
    """Schemas, channels and messages of the chunk record ``body``, its CRC checked before the first.

    ``strict`` refuses a chunk without a CRC.
    """
    if len(body) < _CHUNK_HEAD.size:
        raise damaged(path, offset, f"a chunk of {len(body)} bytes")
    start, end, size, crc, name_size = _CHUNK_HEAD.unpack_from(body)
    at = _CHUNK_HEAD.size
    name = bytes(body[at : at + name_size])
    at += name_size
    if at + 8 > len(body):
        raise damaged(path, offset, "a chunk's head runs past its end")
    (stored,) = struct.unpack_from("<Q", body, at)
    at += 8
    if stored > len(body) - at:
        raise damaged(path, offset, f"a chunk of {stored} bytes runs past its end")
    data = _decompress(name, body[at : at + stored], size, path, offset)
    if len(data) != size:
        raise damaged(path, offset, f"a chunk holds {len(data)} bytes, its head says {size}")
    if (crc or strict) and isal_zlib.crc32(data) != crc:
        raise damaged(path, offset, "the CRC of a chunk does not fit its content")
    return inner_records(memoryview(data), path, offset, start=start, end=end)


def inner_records(data: memoryview, path: Path, offset: int, *, start: int, end: int) -> Iterator[Any]:
    """Records of decompressed chunk content; message times must lie in [start, end]."""
    at, size = 0, len(data)
    while at < size:
        if at + 9 > size:
            raise damaged(path, offset, f"a record head is cut off at byte {at} of a chunk")
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        at += 9
        if length > size - at:
            raise damaged(path, offset, f"a record runs past the end of its chunk at byte {at}")
        body = data[at : at + length]
        at += length
        if opcode == _MESSAGE:
            message = parse_message(body, path, offset)
            if not start <= message.log_time <= end:
                raise damaged(path, offset, f"a message at {message.log_time} is outside its chunk")
            yield message
        elif opcode in _REPEATED:
            yield parse_record(opcode, body, path, offset)
        elif opcode < 0x80:
            raise damaged(path, offset, f"a record of kind {opcode:#04x} inside a chunk")


def _zstd() -> zstandard.ZstdDecompressor:
    """One decompressor a thread: making one costs as much as a small chunk, sharing is unsafe."""
    if not hasattr(_THREAD, "zstd"):
        _THREAD.zstd = zstandard.ZstdDecompressor()
    return _THREAD.zstd


def _decompress(name: bytes, data: memoryview, size: int, path: Path, offset: int) -> Any:
    if name == b"":
        # The chunk's bytes are read into memory that the next chunk is read into as well.
        return bytes(data)
    # zstd stores 128 KiB in no less than four bytes: what claims more would only fill the memory.
    if size > min(len(data) * 32_768 + 131_072, _LARGEST_CHUNK):
        raise damaged(path, offset, f"a chunk of {len(data)} bytes claims to hold {size}")
    try:
        if name == b"zstd":
            return _zstd().decompress(data, max_output_size=size)
        if name == b"lz4":
            import lz4.frame

            return lz4.frame.decompress(bytes(data))
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise damaged(path, offset, f"a chunk cannot be decompressed ({error})") from error
    raise damaged(path, offset, f"a chunk has the unknown compression {name!r}")
