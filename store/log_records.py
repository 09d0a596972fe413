"""Walk the records of any MCAP file once, in file order, with every CRC checked.

The `mcap` package's readers check CRCs only when told to, and attachments' never; here nothing can be
turned off. Messages are views into the decompressed chunk. Anything that does not fit is a
DamageError with file and offset, at the latest when the end of the data section is reached.
"""

from __future__ import annotations

import io
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Protocol

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

from ..schemas.channels import PROFILE
from ..schemas.errors import CutOffError, DamageError, StorageError

MAGIC: Final = b"\x89MCAP0\r\n"
_THREAD = threading.local()
_LARGEST_CHUNK: Final = 1 << 31
_CHUNK_HEAD = struct.Struct("<QQQII")
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY = struct.Struct("<QQ")
# Chunks are larger than this and so are read past the buffer, without a second copy.
_BUFFER_BYTES: Final = 1 << 16

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


def damaged(path: Path, offset: int, what: str) -> DamageError:
    """The error for broken bytes of a log."""
    return DamageError(
        f"{path}: damaged at byte {offset}: {what}",
        hint="restore the file from a copy; turnscan repair salvages what is whole",
    )


def _cut_off(file: Any, path: Path, offset: int, what: str) -> DamageError:
    """The error for a file that is too short at ``offset``. One that ends as it should was not cut:
    then it is the length that is wrong.
    """
    file.seek(-len(MAGIC), io.SEEK_END)
    error = damaged(path, offset, what)
    return error if file.read() == MAGIC else CutOffError(error.message, hint=error.hint)


def _has_footer(data: memoryview) -> bool:
    """Whether a footer (20 bytes) and a magic, right or wrong, end ``data``."""
    at = len(data) - len(MAGIC) - 20 - _RECORD_HEAD.size
    return at >= 0 and _RECORD_HEAD.unpack_from(data, at) == (Opcode.FOOTER, 20)


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
        opcode, length = _RECORD_HEAD.unpack_from(data, at)
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


def _body(file: Any, length: int, scratch: list[bytearray]) -> memoryview:
    """A chunk's body, read into ``scratch``: fresh memory for each would cost more than the read."""
    if len(scratch[0]) < length:
        scratch[0] = bytearray(length)
    view = memoryview(scratch[0])[:length]
    return view[: file.readinto(view)]


class Growth(Protocol):
    """What a walk asks while another process still writes the file."""

    def wait_for(self, size: int | None) -> int:
        """The file's size, once it is at least ``size``, or (None) once nothing more will come."""

    def take(self, data: bytes | memoryview) -> None:
        """Called with every byte of the file, in order."""


class RecordWalk:
    """One pass over a file. Iterating yields (offset, record); ``library`` and ``profile`` are set
    by the first record. With ``growth`` records are read as they are written; with ``ahead`` each chunk
    is decompressed in a thread of its own while the records of the one before are used.
    """

    def __init__(self, path: Path, growth: Growth | None = None, *, ahead: bool = False) -> None:
        self.path = path
        self._growth = growth
        self._ahead = ahead
        self._pool: ThreadPoolExecutor | None = None
        self.profile = ""
        self.library = ""

    def __iter__(self) -> Iterator[tuple[int, Any]]:
        try:
            with self.path.open("rb", buffering=_BUFFER_BYTES) as file:
                size = file.seek(0, io.SEEK_END)
                file.seek(0)
                yield from (
                    self._in_order(self._walk(file, size)) if self._ahead else self._walk(file, size)
                )
        except FileNotFoundError as error:
            raise StorageError(f"{self.path}: no such file") from error
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be read ({error.strerror})") from error
        finally:
            if self._pool is not None:
                self._pool.shutdown()

    def _in_order(self, walk: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
        """The records of ``walk``, a chunk's in the place of its future: one chunk is always ahead."""
        waiting: deque[tuple[int, Any]] = deque()

        def until(left: int) -> Iterator[tuple[int, Any]]:
            while len(waiting) > left:
                offset, record = waiting.popleft()
                if isinstance(record, Future):
                    for inner in record.result():
                        yield offset, inner
                else:
                    yield offset, record

        while True:
            try:
                step = next(walk, None)
            except (DamageError, OSError):
                # What stands before the fault comes first, as it does without the thread.
                yield from until(0)
                raise
            if step is None:
                break
            waiting.append(step)
            if isinstance(step[1], Future):
                yield from until(1)
        yield from until(0)

    def _walk(self, file: Any, size: int) -> Iterator[tuple[int, Any]]:
        size = self._reach(len(MAGIC), size)
        magic = file.read(len(MAGIC))
        if magic != MAGIC:
            raise damaged(self.path, 0, "it does not begin as an MCAP file")
        self._taken(magic)
        crc = isal_zlib.crc32(magic)
        offset = len(magic)
        strict = False
        scratch, spare = [bytearray()], [bytearray()]
        while True:
            size = self._reach(offset + 9, size)
            head = file.read(9)
            if len(head) < 9:
                raise _cut_off(file, self.path, offset, "the file ends before its data section does")
            opcode, length = _RECORD_HEAD.unpack(head)
            size = self._reach(offset + 9 + length, size)
            if length > size - offset - 9:
                what = f"a record of {length} bytes runs past the end"
                raise _cut_off(file, self.path, offset, what)
            body = _body(file, length, scratch) if opcode == Opcode.CHUNK else file.read(length)
            if len(body) != length:
                raise damaged(self.path, offset, "the file is shorter than it was")
            self._taken(head, body)
            if opcode == Opcode.DATA_END:
                record = parse_record(opcode, body, self.path, offset)
                if (record.data_section_crc or strict) and record.data_section_crc != crc:
                    raise damaged(self.path, offset, "the CRC of the data section does not fit")
                yield offset, record
                yield from self._summary(file, offset + 9 + length, strict=strict)
                return
            crc = isal_zlib.crc32(body, isal_zlib.crc32(head, crc))
            if opcode == Opcode.CHUNK:
                yield from self._chunk(body, offset, strict=strict)
                # With a thread the next chunk is read while this one's bytes are still in use.
                scratch, spare = spare, scratch
            elif opcode == Opcode.FOOTER:
                raise damaged(self.path, offset, "the data section has no end record")
            else:
                if opcode == Opcode.ATTACHMENT:
                    self._check_attachment(body, offset)
                record = parse_record(opcode, body, self.path, offset)
                if isinstance(record, Header):
                    self.profile, self.library = record.profile, record.library
                    strict = record.profile == PROFILE
                if record is not None:
                    yield offset, record
            offset += 9 + length

    def _chunk(self, body: memoryview, offset: int, *, strict: bool) -> Iterator[tuple[int, Any]]:
        """The records of a chunk; with a thread, one future of them."""
        if self._pool is not None:
            yield offset, self._pool.submit(chunk_records, body, self.path, offset, strict=strict)
            return
        for record in chunk_records(body, self.path, offset, strict=strict):
            yield offset, record
        if self._ahead:
            # From the second chunk on: many scans are so small that they have no other.
            self._pool = ThreadPoolExecutor(1, "decompress")

    def _reach(self, wanted: int | None, size: int) -> int:
        """The file's size, after waiting for ``wanted`` bytes of a file that grows."""
        if self._growth is None or (wanted is not None and wanted <= size):
            return size
        return self._growth.wait_for(wanted)

    def _taken(self, *parts: bytes | memoryview) -> None:
        if self._growth is not None:
            for part in parts:
                self._growth.take(part)

    def _check_attachment(self, body: bytes | memoryview, offset: int) -> None:
        """The CRC stands right after the data; a record may be longer than its fields."""
        try:
            at = 16
            for _ in ("name", "media type"):
                at += 4 + struct.unpack_from("<I", body, at)[0]
            at += 8 + struct.unpack_from("<Q", body, at)[0]
            (crc,) = struct.unpack_from("<I", body, at)
        except struct.error as error:
            raise damaged(self.path, offset, "an attachment is malformed") from error
        if crc and isal_zlib.crc32(memoryview(body)[:at]) != crc:
            raise damaged(self.path, offset, "the CRC of an attachment does not fit")

    def _summary(self, file: Any, begin: int, *, strict: bool) -> Iterator[tuple[int, Any]]:
        self._reach(None, 0)
        data = memoryview(file.read())
        self._taken(data)
        if bytes(data[-len(MAGIC) :]) != MAGIC:
            what = "it does not end as an MCAP file"
            if _has_footer(data):  # Nothing is missing: the last bytes are wrong.
                raise damaged(self.path, begin + len(data), what)
            raise _cut_off(file, self.path, begin + len(data), what)
        end = len(data) - len(MAGIC)
        at = 0
        while at < end:
            if at + 9 > end:
                raise damaged(self.path, begin + at, "the summary is cut off")
            opcode, length = _RECORD_HEAD.unpack_from(data, at)
            if length > end - at - 9:
                raise damaged(self.path, begin + at, "a record of the summary runs past its end")
            body = data[at + 9 : at + 9 + length]
            record = parse_record(opcode, body, self.path, begin + at)
            if isinstance(record, Footer):
                if at + 9 + length != end:
                    raise damaged(self.path, begin + at, "something follows the footer")
                crc = isal_zlib.crc32(data[: at + 9 + 16])
                if (record.summary_crc or strict) and record.summary_crc != crc:
                    raise damaged(self.path, begin + at, "the CRC of the summary does not fit")
                yield begin + at, record
                return
            if record is not None:
                yield begin + at, record
            at += 9 + length
        raise damaged(self.path, begin + at, "the file has no footer")


def read_messages(
    path: Path,
    topics: set[str] | None = None,
    growth: Growth | None = None,
    *,
    ahead: bool = False,
) -> Iterator[tuple[Schema | None, Channel, LogMessage]]:
    """Messages of any MCAP file in file order, with their channel and schema.

    ``growth`` and ``ahead`` as in :class:`RecordWalk`.

    Raises
    ------
    DamageError
        Any CRC, length or reference in the file does not fit, at the latest after the last message.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    # The summary repeats schemas and channels; they are checked by the walk and change nothing.
    for offset, record in RecordWalk(path, growth, ahead=ahead):
        if isinstance(record, LogMessage):
            channel = channels.get(record.channel_id)
            if channel is None:
                raise damaged(path, offset, f"a message on the unknown channel {record.channel_id}")
            if topics is None or channel.topic in topics:
                yield schemas.get(channel.schema_id), channel, record
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.schema_id and record.schema_id not in schemas:
                raise damaged(path, offset, f"channel {record.topic!r} names an unknown schema")
            channels[record.id] = record
