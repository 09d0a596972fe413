"""Recordings of other programs for the tests, written with `mcap`'s own writer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, IndexType, Writer

from .messages.cdr_writer import full_text

T0 = 1_700_000_000 * 10**9
MS = 10**6


class Recording:
    """``rec.ros("/joints", "sensor_msgs/msg/JointState", t_ns, data)`` and the like; then close."""

    def __init__(
        self,
        path: Path,
        *,
        compression: CompressionType = CompressionType.ZSTD,
        chunks: bool = True,
        index: bool = True,
        chunk_bytes: int = 1 << 20,
    ) -> None:
        self.path = path
        self._file = path.open("wb")
        self._writer = Writer(
            self._file,
            chunk_size=chunk_bytes,
            compression=compression,
            use_chunking=chunks,
            use_statistics=index,
            use_summary_offsets=index,
            repeat_channels=index,
            repeat_schemas=index,
            index_types=IndexType.ALL if index else IndexType.NONE,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile="ros2", library="tests")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def _put(self, topic: str, name: str, kind: tuple[str, str, bytes], t_ns: int, data: bytes) -> None:
        encoding, schema_encoding, schema = kind
        if name and name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, schema_encoding, schema)
        key = (topic, name)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                topic, encoding, self._schemas.get(name, 0)
            )
        self._writer.add_message(self._channels[key], t_ns, data, t_ns)

    def ros(self, topic: str, name: str, log_ns: int, data: bytes, text: str | None = None) -> None:
        schema = full_text(name) if text is None else text
        self._put(topic, name, ("cdr", "ros2msg", schema.encode()), log_ns, data)

    def json(self, topic: str, name: str, log_ns: int, value: Any) -> None:
        data = value if isinstance(value, bytes) else json.dumps(value).encode()
        self._put(topic, name, ("json", "jsonschema" if name else "", b"{}"), log_ns, data)

    def proto(self, topic: str, log_ns: int, message: Any) -> None:
        from turnscan.schemas.channels import schema_bytes

        name = message.DESCRIPTOR.full_name
        data = message.SerializeToString()
        self._put(topic, name, ("protobuf", *schema_bytes(name)), log_ns, data)

    def other(self, topic: str, encoding: str, name: str, log_ns: int, data: bytes) -> None:
        self._put(topic, name, (encoding, encoding, b""), log_ns, data)

    def close(self) -> Path:
        self._writer.finish()
        self._file.close()
        return self.path


def times(count: int, *, step_ms: int = 100) -> Sequence[int]:
    return [T0 + i * step_ms * MS for i in range(count)]
