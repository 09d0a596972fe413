"""What a log is about: content digests and the facts of scan.json, gathered in one pass.

``content_sha256`` covers all that processing reads: for each image, exposure, angle and laser message,
in order, topic, log time and payload (of images: encoding, size and the SHA-256 of the pixel data).
``frames_sha256`` covers the images with their angle and lasers, without times and names.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ..schemas.calibration import Calibration
from ..schemas.channels import topic_of
from ..schemas.errors import InputError
from ..schemas.events import (
    CalibrationSnapshot,
    Ended,
    Exposure,
    LogEvent,
    ScanEnd,
    ScanStart,
    TurntableAngle,
)
from .log_reader import LogFrame, ScanLog, snapshot_calibration
from .log_records import LogMessage


@dataclass(frozen=True)
class LogFacts:
    """What scan.json says of a log, but for the file's own size and digest."""

    start: ScanStart
    ended: Ended
    ended_ns: int
    cameras: tuple[str, ...]
    lasers: tuple[int, ...]
    frames: int
    background_frames: int
    width_px: int
    height_px: int
    encoding: str
    angle_min_rad: float
    angle_max_rad: float
    calibration: Calibration | None
    content_sha256: str
    frames_sha256: str


class LogDigest:
    """Running digests and facts; a recorder may update it while it writes."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._content = hashlib.sha256(b"turnscan:log-content\n")
        self._frames = hashlib.sha256(b"turnscan:log-frames\n")
        self._start: ScanStart | None = None
        self._end: ScanEnd | None = None
        self._calibration: Calibration | None = None
        self._angle: float | None = None
        self._lowest, self._highest = math.inf, -math.inf
        self._cameras: set[str] = set()
        self._lasers: set[int] = set()
        self._lit = self._dark = 0
        self._shape: tuple[int, int, str] | None = None
        self._last_ns = 0

    def update(self, topic: str, message: LogMessage, item: LogEvent | LogFrame | None) -> None:
        """Take in one message and its typed item, in the order of the log."""
        self._last_ns = message.log_time
        if isinstance(item, LogFrame):
            self._frame(topic, item)
            return
        known = topic_of(topic)
        if known is not None and known.content:
            self._entry(topic, message.log_time, bytes(message.data))
        if isinstance(item, ScanStart):
            self._start = item
        elif isinstance(item, ScanEnd):
            self._end = item
        elif isinstance(item, CalibrationSnapshot):
            self._calibration = snapshot_calibration(item, where=self._where)
        elif isinstance(item, TurntableAngle):
            self._angle = item.commanded_rad if item.reported_rad is None else item.reported_rad
            self._lowest = min(self._lowest, self._angle)
            self._highest = max(self._highest, self._angle)
        elif isinstance(item, Exposure):
            self._lasers.update(item.lasers_on)

    def _entry(self, topic: str, t_ns: int, payload: bytes) -> None:
        self._content.update(f"{topic}\n{t_ns}\n{len(payload)}\n".encode())
        self._content.update(payload)

    def _frame(self, topic: str, item: LogFrame) -> None:
        image = item.image
        pixels = hashlib.sha256(image.data).hexdigest()
        what = f"{image.encoding} {image.width_px} {image.height_px} {image.step} {pixels}"
        self._entry(topic, item.t_ns, what.encode())
        lasers = ",".join(map(str, item.lasers_on))
        self._frames.update(f"{item.camera} {self._angle!r} [{lasers}] {what}\n".encode())
        self._cameras.add(item.camera)
        if item.lasers_on:
            self._lit += 1
        else:
            self._dark += 1
        if self._shape is None:
            height, width = (
                (image.height_px, image.width_px) if image.width_px else item.decode().shape[:2]
            )
            self._shape = (width, height, image.encoding)

    def facts(self) -> LogFacts:
        """What is known after the last message.

        Raises
        ------
        InputError
            The log has no start, no frame or no angle, so that no scan can be made of it.
        """
        for value, what in (
            (self._start, "/scan/start event"),
            (self._shape, "frame"),
            (self._angle is not None, "/turntable/angle event"),
        ):
            if not value:
                raise InputError(f"{self._where}: the log holds no {what}, so it is no scan")
        assert self._start is not None
        assert self._shape is not None
        return LogFacts(
            start=self._start,
            ended=self._end.ended if self._end else "interrupted",
            ended_ns=self._last_ns,
            cameras=tuple(sorted(self._cameras)),
            lasers=tuple(sorted(self._lasers)),
            frames=self._lit + self._dark,
            background_frames=self._dark,
            width_px=self._shape[0],
            height_px=self._shape[1],
            encoding=self._shape[2],
            angle_min_rad=self._lowest,
            angle_max_rad=self._highest,
            calibration=self._calibration,
            content_sha256=self._content.hexdigest(),
            frames_sha256=self._frames.hexdigest(),
        )


def digested_items(log: ScanLog, digest: LogDigest) -> Iterator[LogEvent | LogFrame]:
    """The items of a log in time order, each taken into ``digest`` before it is given."""
    exposures: dict[str, Exposure] = {}
    for topic, schema, message in log.messages():
        item = log.item(topic, schema, message, exposures)
        digest.update(topic, message, item)
        if item is not None:
            yield item


def digest_log(log: ScanLog, advance: Any = None) -> LogFacts:
    """Facts and digests of a whole log in one pass, every CRC checked on the way."""
    digest = LogDigest(str(log.path))
    for n, _ in enumerate(digested_items(log, digest)):
        if advance is not None:
            advance(n)
    return digest.facts()
