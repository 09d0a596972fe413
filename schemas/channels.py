"""The channels of a scan log: which topic carries what, in which encoding.

JSON channels carry the events of events.py. Images, camera calibration and tf are protobuf, because
viewers read only those. ``{camera}`` stands for the camera's id, ``{laser}`` for the laser's number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final

from .canonical import canonical_json
from .events import (
    CalibrationSnapshot,
    DeviceLine,
    Exposure,
    LaserState,
    LogEvent,
    LogLine,
    ReferenceEvent,
    ScanEnd,
    ScanStart,
    StripeTruth,
    TurntableAngle,
)
from .image_messages import COMPRESSED_IMAGE, RAW_IMAGE

PROFILE: Final = "turnscan"
CAMERA_CALIBRATION: Final = "foxglove.CameraCalibration"
FRAME_TRANSFORM: Final = "foxglove.FrameTransform"


@dataclass(frozen=True)
class Topic:
    """What a topic carries: JSON events of ``event``, or protobuf messages of ``schemas``."""

    schemas: tuple[str, ...]
    event: type[LogEvent] | None = None
    content: bool = False

    @property
    def encoding(self) -> str:
        """The message encoding, as MCAP names it."""
        return "protobuf" if self.event is None else "json"


#: Topics marked ``content`` are what processing reads; they enter the content digest.
TOPICS: Final = {
    "/scan/start": Topic(("scan-start",), ScanStart),
    "/scan/end": Topic(("scan-end",), ScanEnd),
    "/calibration": Topic(("calibration-snapshot",), CalibrationSnapshot),
    "/turntable/angle": Topic(("turntable-angle",), TurntableAngle, content=True),
    "/laser/state": Topic(("laser-state",), LaserState, content=True),
    "/reference": Topic(("reference-event",), ReferenceEvent),
    "/device/serial": Topic(("device-line",), DeviceLine),
    "/log": Topic(("log-line",), LogLine),
    "/camera/{camera}/exposure": Topic(("exposure",), Exposure, content=True),
    "/camera/{camera}/image": Topic((RAW_IMAGE, COMPRESSED_IMAGE), content=True),
    "/camera/{camera}/calibration": Topic((CAMERA_CALIBRATION,)),
    "/tf": Topic((FRAME_TRANSFORM,)),
    "/truth/{laser}": Topic(("stripe-truth",), StripeTruth),
}

_CAMERA = re.compile(r"^/camera/([A-Za-z0-9_.-]+)/(exposure|image|calibration)$")
_TRUTH = re.compile(r"^/truth/(0|[1-9][0-9]{0,2})$")
_EVENT_TOPICS: Final = {t.event: name for name, t in TOPICS.items() if t.event is not None}


@lru_cache(1024)
def topic_of(name: str) -> Topic | None:
    """What the topic ``name`` carries, or None for a topic that is not turnscan's."""
    if _TRUTH.match(name):
        return TOPICS["/truth/{laser}"]
    match = _CAMERA.match(name)
    return TOPICS.get(f"/camera/{{camera}}/{match[2]}" if match else name)


def event_topic(event: LogEvent) -> str:
    """The topic that ``event`` is written to."""
    name = _EVENT_TOPICS[type(event)]
    if isinstance(event, Exposure):
        return name.replace("{camera}", event.camera)
    if isinstance(event, StripeTruth):
        return name.replace("{laser}", str(event.laser))
    return name


@cache
def schema_bytes(name: str) -> tuple[str, bytes]:
    """MCAP schema encoding and data of ``name``: a JSON Schema, or a FileDescriptorSet."""
    if name.startswith("foxglove."):
        return "protobuf", _descriptor_set(name)
    from .json_schema import json_schemas

    return "jsonschema", canonical_json(json_schemas()[name])


def _descriptor_set(name: str) -> bytes:
    from importlib import import_module

    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

    short = name.removeprefix("foxglove.")
    module = import_module(f"foxglove_schemas_protobuf.{short}_pb2")
    out = FileDescriptorSet()
    seen: set[str] = set()

    def add(descriptor: object) -> None:
        file_name = descriptor.name  # type: ignore[attr-defined]
        if file_name in seen:
            return
        seen.add(file_name)
        for dependency in descriptor.dependencies:  # type: ignore[attr-defined]
            add(dependency)
        proto = FileDescriptorProto()
        descriptor.CopyToProto(proto)  # type: ignore[attr-defined]
        out.file.append(proto)

    add(module.DESCRIPTOR)
    return out.SerializeToString(deterministic=True)
