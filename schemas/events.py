"""Events inside a scan log: one JSON object a message, each with its time ``t_ns``.

The message's log time equals ``t_ns``. Channels that viewers draw (images, camera calibration, tf)
are protobuf and stand in image_messages.py; which topic carries which event is in channels.py.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from .document import Model

Nanoseconds = Annotated[int, Field(ge=0, lt=2**63)]
Tags = dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,60}$")], str]
Ended = Literal["complete", "interrupted", "salvaged"]


class LogEvent(Model):
    """A recorded fact with a time (integer nanoseconds, UTC epoch)."""

    t_ns: Nanoseconds


class ScanStart(LogEvent):
    """First message of every log: what this scan is."""

    format_version: Literal[1] = 1
    scan: str
    rig: str
    label: str = ""
    tags: Tags = Field(default_factory=dict)
    source: str = Field(description="recorded, imported images, salvaged, simulated")
    time_source: str = Field(description="where the times come from: clock, csv, given, file-mtime")
    software: str = Field(description="turnscan and its version")
    cameras: tuple[str, ...] = ("0",)
    lasers: tuple[int, ...] = (0,)
    salvaged_from: str | None = None


class ScanEnd(LogEvent):
    """Last message of a log that ended by itself."""

    ended: Ended
    frames: int
    note: str = ""


class TurntableAngle(LogEvent):
    """Turntable position, as commanded and as the device reported it (None: no report)."""

    commanded_rad: float
    reported_rad: float | None = None


class LaserState(LogEvent):
    """One laser was switched."""

    laser: Annotated[int, Field(ge=0, le=255)]
    on: bool


class Exposure(LogEvent):
    """What belongs to the image message of the same sequence number on the same camera."""

    frame: Annotated[int, Field(ge=0)]
    camera: str = "0"
    lasers_on: tuple[int, ...] = Field(description="lasers lit in this frame; empty: background")
    exposure_ns: int | None = Field(default=None, description="exposure duration, where known")
    file: str | None = Field(default=None, description="name of the imported file")


class CalibrationSnapshot(LogEvent):
    """The whole calibration document that held when the scan was made, with its digest."""

    calibration: str
    sha256: str
    document: dict[str, Any]


class ReferenceEvent(LogEvent):
    """A trusted measurement made during the scan."""

    kind: str
    value: dict[str, Any]


class DeviceLine(LogEvent):
    """One line sent to or received from a serial device."""

    device: str
    direction: Literal["sent", "received"]
    line: str


class LogLine(LogEvent):
    """A remark of the recording program."""

    level: Literal["debug", "info", "warning", "error"]
    message: str
