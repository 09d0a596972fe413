"""Read a scan log: its events and frames, typed, once, in time order, every CRC checked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mcap.records import Channel, Schema
from pydantic import ValidationError

from ..schemas.calibration import Calibration, parse_calibration
from ..schemas.canonical import canonical_json
from ..schemas.channels import topic_of
from ..schemas.errors import DamageError
from ..schemas.events import CalibrationSnapshot, Exposure, LogEvent, ScanStart
from ..schemas.image_messages import RAW_IMAGE, ImageMessage, decode_image
from .log_ahead import Prepare
from .log_records import LogMessage, TypedMessage, damaged
from .log_walk import Growth, read_messages

if TYPE_CHECKING:
    import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class LogFrame:
    """One frame of a log: what its exposure event says, and its image still encoded."""

    frame: int
    t_ns: int
    camera: str
    lasers_on: tuple[int, ...]
    file: str | None
    image: ImageMessage
    path: Path

    @property
    def encoded(self) -> bool:
        """Whether :meth:`decode` has a JPEG, PNG, TIFF or BMP to decode."""
        return self.image.schema != RAW_IMAGE

    def decode(self) -> npt.NDArray[Any]:
        """The pixels: (H, W) uint8 or uint16, or (H, W, 3) in BGR order; read-only where raw.

        Orientation tags of imported files are ignored: pixels are as the sensor stored them.
        """
        import numpy as np

        message = self.image
        if self.encoded:
            return decode_image_file(message.data, where=f"{self.path}: frame {self.frame}")
        kind = np.dtype("<u2") if message.encoding == "mono16" else np.dtype("u1")
        width = message.width_px * (3 if message.encoding == "bgr8" else 1)
        rows = np.frombuffer(message.data, dtype=kind).reshape(message.height_px, -1)[:, :width]
        if message.encoding == "bgr8":
            return rows.reshape(message.height_px, message.width_px, 3)
        return rows


class Each(Protocol):
    """What is made of a frame as soon as it is there."""

    def __call__(self, item: LogFrame) -> Any:
        """What comes in the frame's place; in any thread."""

    def worth_a_thread(self) -> bool:
        """Whether the threads that decompress should do it, or the caller's alone."""


_GONE = memoryview(b"")


def decode_image_file(data: Any, *, where: str) -> npt.NDArray[Any]:
    """Pixels of a JPEG, PNG, TIFF or BMP in memory, in its own depth and channels, unrotated.

    Raises
    ------
    DamageError
        The bytes are no image that can be decoded.
    """
    import cv2
    import numpy as np

    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise DamageError(f"{where}: the image cannot be decoded ({error.err})") from error
    if image is None:
        raise DamageError(f"{where}: the image cannot be decoded")
    return image


class ScanLog:
    """A sealed (or finished) scan log on disk; with ``growth``, one that is still being written."""

    def __init__(self, path: Path, growth: Growth | None = None) -> None:
        self.path = path
        self._growth = growth

    def messages(
        self, *, ahead: int = 0, prepare: Prepare | None = None
    ) -> Iterator[tuple[str, str, LogMessage]]:
        """(topic, schema name, message) of the whole log in time order.

        ``ahead``: decompress in so many threads beside the caller's; ``prepare`` as in
        :class:`RecordWalk`.

        Raises
        ------
        DamageError
            Any byte of the file is not what was written, at the latest after the last message.
        """
        last = -1
        messages = read_messages(self.path, growth=self._growth, ahead=ahead, prepare=prepare)
        for schema, channel, message in messages:
            if message.log_time < last:
                raise damaged(self.path, 0, f"{channel.topic} steps back in time from {last}")
            last = message.log_time
            yield channel.topic, schema.name if schema else "", message

    def items(self, *, ahead: int = 0, each: Each | None = None) -> Iterator[Any]:
        """Every event (:class:`LogEvent`) and every frame (:class:`LogFrame`), typed, in time order.

        ``ahead`` as in messages. With ``each`` what it makes of a frame comes in the frame's place:
        made where the frame was decompressed if that is worth it, in several threads, in any order.
        """
        exposures: dict[str, Exposure] = {}
        prepare = None if each is None else partial(self._type_ahead, each)
        for topic, schema, message in self.messages(ahead=ahead, prepare=prepare):
            if isinstance(message, TypedMessage):
                item = message.item
                if isinstance(item, Exposure):
                    exposures[item.camera] = item
            else:
                item = self.item(topic, schema, message, exposures)
                if each is not None and isinstance(item, LogFrame):
                    item = each(item)
            if item is not None:
                yield item

    def _type_ahead(self, each: Each, records: list[Any]) -> None:
        """Put typed messages in the place of those that the records of one chunk alone explain."""
        if not each.worth_a_thread():
            return
        channels: dict[int, tuple[str, str]] = {}
        schemas: dict[int, str] = {}
        exposures: dict[str, Exposure] = {}
        for i, record in enumerate(records):
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record.topic, schemas.get(record.schema_id, "")
            elif isinstance(record, LogMessage) and record.channel_id in channels:
                try:
                    item = self.item(*channels[record.channel_id], record, exposures)
                except DamageError:
                    # Its exposure may stand in the chunk before; if not, it is told of in its turn.
                    continue
                if item is not None:
                    head = (record.channel_id, record.sequence, record.log_time, record.publish_time)
                    made = each(item) if isinstance(item, LogFrame) else item
                    records[i] = TypedMessage(*head, _GONE, made)

    def item(
        self, topic: str, schema: str, message: LogMessage, exposures: dict[str, Exposure]
    ) -> LogEvent | LogFrame | None:
        """One typed item; ``exposures`` carries the last exposure of each camera from call to call."""
        known = topic_of(topic)
        if known is None:
            return None
        if known.event is not None:
            event = self._event(known.event, message)
            if isinstance(event, Exposure):
                exposures[event.camera] = event
            return event
        if not topic.endswith("/image"):
            return None
        camera = topic.split("/")[2]
        exposure = exposures.get(camera)
        if exposure is None or exposure.frame != message.sequence or exposure.t_ns != message.log_time:
            raise damaged(self.path, 0, f"frame {message.sequence} has no exposure event before it")
        try:
            image = decode_image(schema, message.data)
        except DamageError as error:
            raise DamageError(f"{self.path}: frame {exposure.frame}: {error}") from error
        return LogFrame(
            frame=exposure.frame,
            t_ns=exposure.t_ns,
            camera=camera,
            lasers_on=exposure.lasers_on,
            file=exposure.file,
            image=image,
            path=self.path,
        )

    def _event(self, model: type[LogEvent], message: LogMessage) -> LogEvent:
        try:
            event = model.model_validate_json(bytes(message.data))
        except ValidationError as error:
            raise damaged(
                self.path, 0, f"a {model.__name__} event at t_ns {message.log_time} is malformed"
            ) from error
        if event.t_ns != message.log_time:
            raise damaged(
                self.path, 0, f"a {model.__name__} event says {event.t_ns}, not {message.log_time}"
            )
        return event

    def start(self) -> ScanStart:
        """The first event of the log."""
        for item in self.items():
            if isinstance(item, ScanStart):
                return item
            break
        raise damaged(self.path, 0, "the log does not begin with /scan/start")

    def frames(self) -> Iterator[LogFrame]:
        """Every frame, in time order."""
        exposures: dict[str, Exposure] = {}
        for topic, schema, message in self.messages():
            # Other events are checked by their CRCs, but need not be parsed.
            if topic.startswith("/camera/"):
                item = self.item(topic, schema, message, exposures)
                if isinstance(item, LogFrame):
                    yield item


def snapshot_calibration(event: CalibrationSnapshot, *, where: str) -> Calibration:
    """The calibration in a snapshot event, after its digest was checked."""
    calibration = parse_calibration(canonical_json(event.document), where=f"{where}: /calibration")
    if calibration.sha256() != event.sha256:
        raise DamageError(
            f"{where}: the calibration snapshot has digest {calibration.sha256()[:12]}, "
            f"its event says {event.sha256[:12]}"
        )
    return calibration
