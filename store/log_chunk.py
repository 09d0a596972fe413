"""One MCAP chunk being written: messages are gathered in one buffer and compressed at once.

Schemas and channels are written before their first use in *each* chunk, so that a chunk can be read
alone. CRC-32 is isal's: ten times faster than zlib's, so that it never tempts anybody to turn it off.
Compressing a stream of pieces would copy them inside zstd just the same, and was measured slower.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

import zstandard
from isal import isal_zlib
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, MessageIndex, Schema

# Fast strategy with long matches: frames are sensor noise, in which short matches cost time and gain
# nothing, and nearly all of the gain is Huffman coding of literals (target_length 0 keeps it on). A
# hash table of 2^8 was measured as small as 2^12 (0.42 of raw) and a tenth faster.
_PARAMETERS: Final = zstandard.ZstdCompressionParameters(
    strategy=zstandard.STRATEGY_FAST,
    min_match=7,
    hash_log=8,
    chain_log=6,
    window_log=20,
    target_length=0,
)
_MESSAGE = struct.Struct("<BQHIQQ")

Buffer = bytes | bytearray | memoryview


class ChunkBuilder:
    """Messages of one chunk, in log-time order."""

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(compression_params=_PARAMETERS)
        self._buffer = memoryview(bytearray(1 << 16))
        self._heads: dict[int, bytes] = {}
        self.start()

    def start(self) -> None:
        """Begin an empty chunk."""
        self._channels: set[int] = set()
        self.uncompressed_size = 0
        self.index: dict[int, list[tuple[int, int]]] = {}
        self.start_time = 0
        self.end_time = 0

    @property
    def empty(self) -> bool:
        """Whether the chunk holds no message."""
        return not self.index

    def _append(self, parts: Sequence[Buffer], size: int) -> None:
        at = self.uncompressed_size
        if at + size > len(self._buffer):
            # The buffer stays as large as the largest chunk was: it is filled again and again.
            larger = memoryview(bytearray(at + max(at, size)))
            larger[:at] = self._buffer[:at]
            self._buffer = larger
        for part in parts:
            end = at + len(part)
            self._buffer[at:end] = part
            at = end
        self.uncompressed_size = at

    def _head(self, schema: Schema, channel: Channel) -> bytes:
        """Schema and channel record of ``channel``, encoded once."""
        head = self._heads.get(channel.id)
        if head is None:
            builder = RecordBuilder()
            schema.write(builder)
            channel.write(builder)
            head = self._heads[channel.id] = builder.end()
        return head

    def add(
        self,
        schema: Schema,
        channel: Channel,
        *,
        sequence: int,
        t_ns: int,
        parts: Sequence[Buffer],
    ) -> None:
        """Append one message whose data is the concatenation of ``parts``."""
        if channel.id not in self._channels:
            head = self._head(schema, channel)
            self._append([head], len(head))
            self._channels.add(channel.id)
        if not self.index:
            self.start_time = t_ns
        self.end_time = t_ns
        self.index.setdefault(channel.id, []).append((t_ns, self.uncompressed_size))
        size = 22 + sum(len(p) for p in parts)
        message = _MESSAGE.pack(Opcode.MESSAGE, size, channel.id, sequence, t_ns, t_ns)
        self._append([message, *parts], 9 + size)

    def finish(self, offset: int) -> tuple[list[Buffer], ChunkIndex]:
        """The chunk record and its message indexes as buffers to write at ``offset``."""
        content = self._buffer[: self.uncompressed_size]
        data = self._compressor.compress(content)
        compressed = len(data)
        name = b"zstd"
        body = struct.pack(
            "<QQQII",
            self.start_time,
            self.end_time,
            self.uncompressed_size,
            isal_zlib.crc32(content),
            len(name),
        )
        body += name + struct.pack("<Q", compressed)
        head = struct.pack("<BQ", Opcode.CHUNK, len(body) + compressed) + body
        chunk_length = len(head) + compressed
        indexes = RecordBuilder()
        offsets: dict[int, int] = {}
        for channel_id, entries in sorted(self.index.items()):
            offsets[channel_id] = offset + chunk_length + indexes.count
            MessageIndex(channel_id=channel_id, records=entries).write(indexes)
        tail = indexes.end()
        record = ChunkIndex(
            chunk_start_offset=offset,
            chunk_length=chunk_length,
            compression="zstd",
            compressed_size=compressed,
            uncompressed_size=self.uncompressed_size,
            message_start_time=self.start_time,
            message_end_time=self.end_time,
            message_index_length=len(tail),
            message_index_offsets=offsets,
        )
        return [head, data, tail], record
