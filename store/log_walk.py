"""Walk the records of any MCAP file once, in file order, with every CRC checked.

The `mcap` package's readers check CRCs only when told to, and attachments' never; here nothing can be
turned off. Anything that does not fit is a DamageError with file and offset, at the latest when the end
of the data section is reached.
"""

from __future__ import annotations

import io
import struct
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, Protocol

from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Footer,
    Header,
    Schema,
)

from ..schemas.channels import PROFILE
from ..schemas.errors import CutOffError, DamageError, StorageError
from .log_ahead import ChunkJob, Prepare, in_order, waiting_chunks
from .log_records import MAGIC, RECORD_HEAD, LogMessage, chunk_records, damaged, parse_record

# Chunks are larger than this and so are read past the buffer, without a second copy.
_BUFFER_BYTES: Final = 1 << 16


def _cut_off(file: Any, path: Path, offset: int, what: str) -> DamageError:
    """The error for a file that is too short at ``offset``. One that ends as it should was not cut:
    then it is the length that is wrong.
    """
    file.seek(-len(MAGIC), io.SEEK_END)
    error = damaged(path, offset, what)
    return error if file.read() == MAGIC else CutOffError(error.message, hint=error.hint)


def _has_footer(data: memoryview) -> bool:
    """Whether a footer (20 bytes) and a magic, right or wrong, end ``data``."""
    at = len(data) - len(MAGIC) - 20 - RECORD_HEAD.size
    return at >= 0 and RECORD_HEAD.unpack_from(data, at) == (Opcode.FOOTER, 20)


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
    by the first record. With ``growth`` records are read as they are written; with ``ahead`` so many
    threads beside the caller's decompress chunks (log_ahead.py) and ``prepare`` their records there.
    """

    def __init__(
        self,
        path: Path,
        growth: Growth | None = None,
        *,
        ahead: int = 0,
        prepare: Prepare | None = None,
    ) -> None:
        self.path = path
        self._growth = growth
        self._ahead = ahead
        self._prepare = prepare
        self._pool: ThreadPoolExecutor | None = None
        self.profile = ""
        self.library = ""

    def __iter__(self) -> Iterator[tuple[int, Any]]:
        try:
            with self.path.open("rb", buffering=_BUFFER_BYTES) as file:
                size = file.seek(0, io.SEEK_END)
                file.seek(0)
                walk = self._walk(file, size)
                yield from in_order(walk, waiting_chunks(self._ahead)) if self._ahead else walk
        except FileNotFoundError as error:
            raise StorageError(f"{self.path}: no such file") from error
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be read ({error.strerror})") from error
        finally:
            if self._pool is not None:
                self._pool.shutdown(cancel_futures=True)

    def _walk(self, file: Any, size: int) -> Iterator[tuple[int, Any]]:
        size = self._reach(len(MAGIC), size)
        magic = file.read(len(MAGIC))
        if magic != MAGIC:
            raise damaged(self.path, 0, "it does not begin as an MCAP file")
        self._taken(magic)
        crc = isal_zlib.crc32(magic)
        offset = len(magic)
        strict = False
        # With threads the next chunks are read while the bytes of those before are still in use.
        scratch = deque([bytearray()] for _ in range(waiting_chunks(self._ahead) + 1))
        while True:
            size = self._reach(offset + 9, size)
            head = file.read(9)
            if len(head) < 9:
                raise _cut_off(file, self.path, offset, "the file ends before its data section does")
            opcode, length = RECORD_HEAD.unpack(head)
            size = self._reach(offset + 9 + length, size)
            if length > size - offset - 9:
                what = f"a record of {length} bytes runs past the end"
                raise _cut_off(file, self.path, offset, what)
            body = _body(file, length, scratch[0]) if opcode == Opcode.CHUNK else file.read(length)
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
                scratch.rotate()
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
        """The records of a chunk; with threads, one job that makes them."""
        if self._pool is not None:
            chunk = body, self.path, offset
            yield offset, ChunkJob(self._pool, chunk, strict, self._prepare)
            return
        for record in chunk_records(body, self.path, offset, strict=strict):
            yield offset, record
        if self._ahead:
            # From the second chunk on: many scans are so small that they have no other.
            self._pool = ThreadPoolExecutor(self._ahead, "decompress")

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
            opcode, length = RECORD_HEAD.unpack_from(data, at)
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
    ahead: int = 0,
    prepare: Prepare | None = None,
) -> Iterator[tuple[Schema | None, Channel, LogMessage]]:
    """Messages of any MCAP file in file order, with their channel and schema.

    ``growth``, ``ahead`` and ``prepare`` as in :class:`RecordWalk`.

    Raises
    ------
    DamageError
        Any CRC, length or reference in the file does not fit, at the latest after the last message.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    # The summary repeats schemas and channels; they are checked by the walk and change nothing.
    for offset, record in RecordWalk(path, growth, ahead=ahead, prepare=prepare):
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
