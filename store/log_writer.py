"""Write a scan log (DESIGN: docs/format.md, "The scan log"), so that a crash loses nothing flushed.

The writer appends to ``scan.mcap.part``; renaming and manifests belong to the archive. Log times never
decrease, every chunk stands alone, and chunk, data section and summary carry a CRC-32.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from isal import isal_zlib
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Schema,
    Statistics,
    SummaryOffset,
)

from ..schemas.calibration import Calibration
from ..schemas.canonical import canonical_json
from ..schemas.channels import (
    CAMERA_CALIBRATION,
    FRAME_TRANSFORM,
    PROFILE,
    event_topic,
    schema_bytes,
    topic_of,
)
from ..schemas.errors import ConflictError, InputError, StorageError
from ..schemas.events import CalibrationSnapshot, Exposure, LogEvent
from ..schemas.image_messages import (
    COMPRESSED_IMAGE,
    RAW_IMAGE,
    compressed_image_head,
    raw_image_head,
)
from ..schemas.software import SOFTWARE
from .log_chunk import Buffer, ChunkBuilder
from .log_viewers import camera_calibration_message, frame_transform_message

if TYPE_CHECKING:
    import numpy.typing as npt

MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_BYTES: Final = 1 << 20
_SYNC_EVERY_S: Final = 1.0


class LogWriter:
    """Writes one log file from its first message to its summary.

    Parameters
    ----------
    path
        The file to make; it must not exist (``scan.mcap.part`` by convention).
    chunk_bytes
        A chunk is closed when it holds this many uncompressed bytes.
    durable
        Close the chunk and fdatasync after every image, instead of at most once a second.

    Use as a context manager: :meth:`finish` is called at the end unless an exception leaves, in which
    case the file stays as it is, to be salvaged.
    """

    def __init__(self, path: Path, *, chunk_bytes: int = CHUNK_BYTES, durable: bool = False) -> None:
        self.path = path
        self._chunk_bytes = chunk_bytes
        self._durable = durable
        self._chunk = ChunkBuilder()
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[tuple[str, str], Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}
        self._last_t_ns = -1
        self._first_t_ns = 0
        self._crc = 0
        self._offset = 0
        self._synced_at = time.monotonic()
        self._finished = False
        try:
            # Unbuffered: a chunk is one writev, and what was written is in the kernel's hands.
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            raise ConflictError(
                f"{path} exists already", hint="a log is never written over; use another folder"
            ) from error
        except OSError as error:
            raise StorageError(f"cannot write {path}: {error.strerror}") from error
        builder = RecordBuilder()
        Header(profile=PROFILE, library=SOFTWARE).write(builder)
        self._write([MAGIC, builder.end()])

    # -- messages ---------------------------------------------------------------------------------

    def write_event(self, event: LogEvent) -> None:
        """Append a JSON event on its own topic at its own time."""
        topic = event_topic(event)
        known = topic_of(topic)
        if known is None:
            raise InputError(f"{topic!r} is no topic of a scan log: camera ids are letters, digits")
        data = canonical_json(event.plain())
        self._message(topic, known.schemas[0], event.t_ns, [data], sequence=_sequence(event))

    def write_image(
        self, exposure: Exposure, image: npt.NDArray[Any] | None = None, **file: Any
    ) -> None:
        """Append one frame: its exposure event, then its image.

        ``image`` is (H, W) uint8 or uint16, or (H, W, 3) uint8 in BGR order. For an imported file give
        ``data`` (its bytes) and ``encoding`` ("png", "jpeg", "tiff", "bmp") instead.
        """
        self.write_event(exposure)
        topic = f"/camera/{exposure.camera}/image"
        if image is None:
            data = file["data"]
            head = compressed_image_head(
                t_ns=exposure.t_ns,
                camera=exposure.camera,
                encoding=file["encoding"],
                size=len(data),
            )
            parts: list[Buffer] = [head, data]
            schema = COMPRESSED_IMAGE
        else:
            parts = _raw_parts(exposure, image)
            schema = RAW_IMAGE
        self._message(topic, schema, exposure.t_ns, parts, sequence=exposure.frame)
        if self._durable or time.monotonic() - self._synced_at > _SYNC_EVERY_S:
            self.flush(sync=True)

    def write_calibration(self, calibration: Calibration, t_ns: int, *, camera: str = "0") -> None:
        """Append the whole calibration document, and what viewers can show of it."""
        snapshot = CalibrationSnapshot(
            t_ns=t_ns,
            calibration=calibration.calibration_id(),
            sha256=calibration.sha256(),
            document=calibration.plain(),
        )
        self.write_event(snapshot)
        if calibration.camera is not None:
            data = camera_calibration_message(calibration.camera, t_ns, camera)
            self._message(f"/camera/{camera}/calibration", CAMERA_CALIBRATION, t_ns, [data])
        if calibration.turntable is not None:
            data = frame_transform_message(calibration.turntable, t_ns, camera)
            self._message("/tf", FRAME_TRANSFORM, t_ns, [data])

    def write_message(self, topic: str, schema: str, t_ns: int, data: Buffer, *, sequence: int) -> None:
        """Append an already encoded message of a turnscan topic, as salvage does."""
        known = topic_of(topic)
        if known is None or schema not in known.schemas:
            raise InputError(f"{topic!r} with schema {schema!r} is no channel of a scan log")
        self._message(topic, schema, t_ns, [data], sequence=sequence)

    def _message(
        self,
        topic: str,
        schema_name: str,
        t_ns: int,
        parts: Sequence[Buffer],
        *,
        sequence: int = 0,
    ) -> None:
        if self._finished:
            raise InputError(f"{self.path} is finished: nothing can be added")
        if t_ns < self._last_t_ns:
            raise InputError(
                f"{self.path}: {topic} at t_ns {t_ns} comes after {self._last_t_ns}",
                hint="messages of a log must be written in the order of their times",
            )
        schema, channel = self._channel(topic, schema_name)
        if self._last_t_ns < 0:
            self._first_t_ns = t_ns
        self._last_t_ns = t_ns
        self._chunk.add(schema, channel, sequence=sequence, t_ns=t_ns, parts=parts)
        self._counts[channel.id] = self._counts.get(channel.id, 0) + 1
        if self._chunk.uncompressed_size >= self._chunk_bytes:
            self._close_chunk()

    def _channel(self, topic: str, schema_name: str) -> tuple[Schema, Channel]:
        schema = self._schemas.get(schema_name)
        if schema is None:
            encoding, data = schema_bytes(schema_name)
            schema = Schema(id=len(self._schemas) + 1, name=schema_name, encoding=encoding, data=data)
            self._schemas[schema_name] = schema
        channel = self._channels.get((topic, schema_name))
        if channel is None:
            channel = Channel(
                id=len(self._channels) + 1,
                topic=topic,
                message_encoding="protobuf" if schema.encoding == "protobuf" else "json",
                metadata={},
                schema_id=schema.id,
            )
            self._channels[topic, schema_name] = channel
        return schema, channel

    # -- the file ---------------------------------------------------------------------------------

    def flush(self, *, sync: bool = False) -> None:
        """Close the chunk: every message before this survives a kill (with ``sync``, a power cut)."""
        self._close_chunk()
        if sync:
            try:
                os.fdatasync(self._file.fileno())
            except OSError as error:
                raise self._refused(error, 0) from error
            self._synced_at = time.monotonic()

    def _close_chunk(self) -> None:
        if self._chunk.empty:
            return
        parts, index = self._chunk.finish(self._offset)
        self._write(parts)
        self._chunks.append(index)
        self._chunk.start()

    def _write(self, parts: Sequence[Buffer]) -> None:
        views = [memoryview(p) for p in parts if len(p)]
        size = sum(len(v) for v in views)
        crc = self._crc
        for view in views:
            crc = isal_zlib.crc32(view, crc)
        try:
            while views:
                written = os.writev(self._file.fileno(), views[:512])
                while views and written >= len(views[0]):
                    written -= len(views.pop(0))
                if written:
                    views[0] = views[0][written:]
        except OSError as error:
            raise self._refused(error, size) from error
        self._crc, self._offset = crc, self._offset + size

    def _refused(self, error: OSError, size: int) -> StorageError:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            return StorageError(
                f"{self.path}: no room for {size} more bytes ({error.strerror})",
                hint="free some space; what was flushed before is kept (turnscan repair)",
            )
        return StorageError(f"{self.path}: writing failed ({error.strerror})")

    def drop_unwritten(self) -> int:
        """After a refused write: take back what did not get to the disk whole; returns the messages.

        The file then ends with the last chunk that was written, and the log can be finished, if there
        is room for a summary.
        """
        try:
            os.ftruncate(self._file.fileno(), self._offset)
            self._file.seek(self._offset)
        except OSError as error:
            raise self._refused(error, 0) from error
        lost = 0
        for channel, entries in self._chunk.index.items():
            self._counts[channel] -= len(entries)
            lost += len(entries)
        self._chunk.start()
        return lost

    @property
    def images(self) -> int:
        """Frames in the log so far."""
        topics = {c.id for (topic, _), c in self._channels.items() if topic.endswith("/image")}
        return sum(n for channel, n in self._counts.items() if channel in topics)

    @property
    def last_t_ns(self) -> int:
        """Time of the last message; -1 before the first."""
        return self._last_t_ns

    @property
    def size_bytes(self) -> int:
        """Bytes written to the file so far."""
        return self._offset

    def finish(self) -> None:
        """Write the summary and make the whole file durable. Nothing can be added afterwards."""
        if self._finished:
            return
        self._close_chunk()
        builder = RecordBuilder()
        DataEnd(data_section_crc=self._crc).write(builder)
        self._write([builder.end()])
        self._write([self._summary()])
        try:
            os.fsync(self._file.fileno())
            self._file.close()
        except OSError as error:
            raise self._refused(error, 0) from error
        self._finished = True

    def _summary(self) -> bytes:
        start = self._offset
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_start_time=self._first_t_ns,
            message_end_time=max(self._last_t_ns, 0),
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[Any]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
        ]
        builder = RecordBuilder()
        offsets = []
        for opcode, records in groups:
            begin = builder.count
            for record in records:
                record.write(builder)
            if builder.count > begin:
                offsets.append(SummaryOffset(opcode, start + begin, builder.count - begin))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        footer_at = builder.count
        Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=0).write(builder)
        data = bytearray(builder.end())
        # The summary's CRC covers everything up to, but not including, itself.
        crc = isal_zlib.crc32(memoryview(data)[: footer_at + 9 + 16])
        data[footer_at + 25 : footer_at + 29] = crc.to_bytes(4, "little")
        return bytes(data) + MAGIC

    def abandon(self) -> None:
        """Close the file without a summary; what was flushed can be salvaged."""
        self._finished = True
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self.abandon()


def _sequence(event: LogEvent) -> int:
    return event.frame if isinstance(event, Exposure) else 0


def _raw_parts(exposure: Exposure, image: npt.NDArray[Any]) -> list[Buffer]:
    import numpy as np

    kinds: dict[tuple[int, str], str] = {(2, "u1"): "mono8", (2, "u2"): "mono16", (3, "u1"): "bgr8"}
    encoding = kinds.get((image.ndim, image.dtype.str[1:]))
    if encoding is None or (image.ndim == 3 and image.shape[2] != 3) or image.size == 0:
        raise InputError(
            f"frame {exposure.frame}: an image of shape {image.shape} and type {image.dtype} cannot "
            "be written",
            hint="give (H, W) uint8 or uint16, or (H, W, 3) uint8",
        )
    pixels = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("<"))
    head = raw_image_head(
        t_ns=exposure.t_ns,
        camera=exposure.camera,
        width_px=image.shape[1],
        height_px=image.shape[0],
        encoding=encoding,
        step=pixels.strides[0],
        size=pixels.nbytes,
    )
    return [head, pixels.data.cast("B")]
