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
    continues: str | None = Field(
        default=None, description="the scan whose recording this log takes up again"
    )
    plan: dict[str, Any] | None = Field(
        default=None, description="the [scan] table of the rig file that this scan follows"
    )


class ScanEnd(LogEvent):
    """Last message of a log that ended by itself."""

    ended: Ended
    frames: int
    note: str = ""


class TurntableAngle(LogEvent):
    """Turntable position, as commanded and as the device reported it (None: no report).

    ``moving`` says that the table turned when it reported, or began to: the angle of a frame between
    this report and the next one lies between the two. Without it the angle holds until the next event.
    """

    commanded_rad: float
    reported_rad: float | None = None
    moving: Literal[True] | None = None


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


class StripeTruth(LogEvent):
    """What a simulated camera knows of one laser's stripe in one frame: exact, without noise.

    One entry for each stripe point, sorted by ``row`` and then ``u_px``. Columns are packed (base64 of
    little-endian numbers; truth.py packs and unpacks them) because truth must be exact to the last
    bit: as decimal text it is 2.5 times as long and takes twenty times as long to write.
    """

    frame: Annotated[int, Field(ge=0)] = Field(description="number of the frame in the scan")
    camera: str = "0"
    laser: Annotated[int, Field(ge=0, le=255)]
    stripe: Literal["vertical", "horizontal"] = Field(
        description="whether row counts rows, or columns of the frame"
    )
    angle_rad: float = Field(description="true angle of the turntable at the middle of the exposure")
    points: Annotated[int, Field(ge=0)]
    row: str = Field(description="uint16: row (vertical) or column (horizontal)")
    u_px: str = Field(description="float64: true centre along the row, in the distorted frame")
    x_mm: str = Field(description="float64: scene point behind it")
    y_mm: str = Field(description="float64")
    z_mm: str = Field(description="float64")
    range_mm: str = Field(description="float64: distance from the camera's centre")
    amplitude_dn: str = Field(description="float32: peak above ambient light, before saturation")
    width_px: str = Field(description="float32: standard deviation of the profile along the row")
    surface: str = Field(description="uint16: which shape of the scene, from 0")
