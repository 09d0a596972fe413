"""First pass over a foreign MCAP file: what is on each topic, when, and at which angle.

Every CRC is checked before anything is written. Of each message that may be needed a few numbers are
kept, of images no pixel, so a long recording costs some bytes a message.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..schemas.calibration import Intrinsics
from ..schemas.errors import CutOffError, DocumentError, InputError
from ..store.log_walk import read_messages
from .messages.cameras import intrinsics_of, is_camera
from .messages.images import image_role
from .messages.paths import (
    AnglePath,
    Unit,
    angle_rad,
    is_lit,
    joint_names,
    likely_angle,
    likely_laser,
    unit_of,
    value_at,
)
from .messages.trees import Decode, decoder_for, stamp_ns

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

    from ..store.log_records import LogMessage


@dataclass(frozen=True)
class Asked:
    """What the user said of the file; None: to be found."""

    image_topic: str | None = None
    angle_topic: str | None = None
    angle_path: tuple[str, ...] | None = None
    angle_unit: Unit | None = None
    laser_topic: str | None = None
    laser_path: tuple[str, ...] | None = None


@dataclass
class Track:
    """The messages of one topic: their times and, of an angle or a laser, their values.

    Times are 0 where a message says none, ``reported`` is NaN where an angle was commanded only, and
    ``lasers`` is -1 where a message does not say which laser it is about. ``problem`` is what is wrong
    with the first message that could not be used; it matters only if the topic is chosen.
    """

    topic: str
    schema: str
    encoding: str
    count: int = 0
    log_ns: array[int] = field(default_factory=lambda: array("q"))
    stamp_ns: array[int] = field(default_factory=lambda: array("q"))
    commanded: array[float] = field(default_factory=lambda: array("d"))
    reported: array[float] = field(default_factory=lambda: array("d"))
    moving: bytearray = field(default_factory=bytearray)
    lit: bytearray = field(default_factory=bytearray)
    lasers: array[int] = field(default_factory=lambda: array("h"))
    path: AnglePath | None = None
    laser_path: tuple[str, ...] | None = None
    image_encoding: str = ""
    cameras: list[Intrinsics] = field(default_factory=list)
    problem: InputError | None = None

    def described(self) -> str:
        """Topic, count and schema, as errors list it."""
        return f"{self.topic} ({self.count} x {self.schema or 'no schema'}, {self.encoding})"


@dataclass
class Survey:
    """What a file holds, by topic; ``lost`` says what a cut took away."""

    path: Path
    topics: dict[str, Track] = field(default_factory=dict)
    images: dict[str, Track] = field(default_factory=dict)
    angles: dict[str, Track] = field(default_factory=dict)
    lasers: dict[str, Track] = field(default_factory=dict)
    cameras: dict[str, Track] = field(default_factory=dict)
    lost: str = ""


def survey_file(path: Path, asked: Asked) -> Survey:
    """Read the whole file once.

    Raises
    ------
    DamageError
        A CRC, length or reference does not fit.
    StorageError
        The file cannot be read.
    InputError
        The file was cut off before its first whole message.
    """
    reading = _Reading(Survey(path), asked)
    try:
        for schema, channel, message in read_messages(path):
            reading.add(schema, channel, message)
    except CutOffError as error:
        # The chunks and messages before the cut have passed their checks.
        if not reading.survey.topics:
            raise
        reading.survey.lost = str(error)
    return reading.survey


class _Reading:
    """The survey while it grows."""

    def __init__(self, survey: Survey, asked: Asked) -> None:
        self.survey = survey
        self.asked = asked
        self._decoders: dict[int, Decode | None] = {}
        self._roles: dict[int, list[tuple[str, Track]]] = {}

    def add(self, schema: Schema | None, channel: Channel, message: LogMessage) -> None:
        track = self.survey.topics.get(channel.topic)
        name = schema.name if schema else ""
        if track is None:
            track = Track(channel.topic, name, channel.message_encoding)
            self.survey.topics[channel.topic] = track
        track.count += 1
        if channel.id not in self._roles:
            self._roles[channel.id] = self._enter(track, schema, channel, message)
        roles = self._roles[channel.id]
        if all(one.problem is not None for _, one in roles):
            return
        decode = self._decoders[channel.id]
        assert decode is not None
        try:
            tree = decode(message.data)
        except InputError as error:
            for _, one in roles:
                self._fail(one, track.count, error)
            return
        for role, one in roles:
            if one.problem is None:
                try:
                    self._take(role, one, message.log_time, tree)
                except (InputError, DocumentError) as error:
                    self._fail(one, track.count, error)

    def _fail(self, track: Track, number: int, error: InputError | DocumentError) -> None:
        text = f"{self.survey.path}: {track.topic}, message {number}: {error}"
        track.problem = InputError(text, hint=error.hint)

    def _enter(
        self, track: Track, schema: Schema | None, channel: Channel, message: LogMessage
    ) -> list[tuple[str, Track]]:
        """Which roles the channel's messages may have, as told or by the first of them."""
        asked = self.asked
        topic = channel.topic
        try:
            decode = decoder_for(schema, channel)
            tree = decode(message.data)
        except InputError as error:
            self._decoders[channel.id] = None
            self._fail(track, track.count, error)
            for wanted, known in (
                (asked.image_topic, self.survey.images),
                (asked.angle_topic, self.survey.angles),
                (asked.laser_topic, self.survey.lasers),
            ):
                if topic == wanted:
                    known.setdefault(topic, track)
            return []
        self._decoders[channel.id] = decode
        roles = []
        if image_role(schema) and asked.image_topic in (None, topic):
            roles.append(("image", self.survey.images))
        if is_camera(schema):
            roles.append(("camera", self.survey.cameras))
        angle = self._angle_path(topic, tree)
        unclear = joint_names(tree) if asked.angle_topic is None and asked.angle_path is None else ()
        if angle is not None or unclear or topic == asked.angle_topic:
            roles.append(("angle", self.survey.angles))
        if topic == asked.laser_topic or (asked.laser_topic is None and topic == "/laser/state"):
            roles.append(("laser", self.survey.lasers))
        out = []
        for role, known in roles:
            one = known.get(topic)
            if one is None:
                one = known[topic] = Track(topic, track.schema, track.encoding)
                one.path = angle
                one.laser_path = likely_laser(tree) if asked.laser_path is None else asked.laser_path
            elif one.schema != (schema.name if schema else ""):
                self._fail(one, track.count, InputError(f"its schema was {one.schema!r} before"))
            out.append((role, one))
        return out

    def _angle_path(self, topic: str, tree: Any) -> AnglePath | None:
        asked = self.asked
        if asked.angle_topic not in (None, topic):
            return None
        likely = likely_angle(tree)
        if asked.angle_path is None:
            return likely
        if asked.angle_topic is None:
            # Without a topic, the path must lead somewhere for the topic to be a candidate.
            try:
                value_at(tree, asked.angle_path)
            except InputError:
                return None
        unit = unit_of(asked.angle_path)
        if unit is None and joint_names(tree) and "position" in asked.angle_path:
            unit = "rad"
        return AnglePath(asked.angle_path, unit)

    def _take(self, role: str, track: Track, log_ns: int, tree: Any) -> None:
        if role == "camera":
            camera = intrinsics_of(tree, where="camera")
            if camera not in track.cameras:
                track.cameras.append(camera)
            return
        if role == "angle":
            self._take_angle(track, tree)
        elif role == "laser":
            if track.laser_path is None:
                raise InputError("it says nowhere whether the laser is on", hint="give --laser-field")
            track.lit.append(is_lit(tree, track.laser_path))
            # A log of turnscan names the laser in each message.
            laser = tree.get("laser") if isinstance(tree, dict) else None
            track.lasers.append(laser if isinstance(laser, int) and 0 <= laser < 256 else -1)
        elif not track.image_encoding:
            track.image_encoding = str(tree.get("encoding") or tree.get("format") or "")
        track.count += 1
        track.log_ns.append(log_ns)
        track.stamp_ns.append(stamp_ns(tree) or 0)

    def _take_angle(self, track: Track, tree: Any) -> None:
        path = track.path
        if path is None:
            joints = joint_names(tree)
            raise InputError(
                "it does not say which of its fields is the angle",
                hint=f"give --angle-field: position.{' or position.'.join(joints)}"
                if joints
                else "give --angle-field, such as state.angle_deg",
            )
        if path.both:
            commanded = angle_rad(tree, ("commanded_rad",), "rad")
            said = tree.get("reported_rad")
            reported = math.nan if said is None else angle_rad(tree, ("reported_rad",), "rad")
        else:
            commanded = reported = angle_rad(
                tree, path.path, self.asked.angle_unit or path.unit or "rad"
            )
        track.commanded.append(commanded)
        track.reported.append(reported)
        track.moving.append((path.both and tree.get("moving") is True) or _turns(tree, path.path))


def _turns(tree: Any, path: tuple[str, ...]) -> bool:
    """Whether a joint says that it moves: its velocity stands beside its position."""
    if "position" not in path:
        return False
    try:
        speed = value_at(tree, tuple("velocity" if p == "position" else p for p in path))
    except InputError:
        return False
    return isinstance(speed, (int, float)) and speed != 0
