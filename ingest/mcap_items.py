"""Second pass over a foreign MCAP file: its frames, angles and laser states in time order."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from heapq import merge
from pathlib import Path
from typing import Any, Literal

from ..schemas.errors import CutOffError, InputError
from ..schemas.events import LaserState, LogEvent, TurntableAngle
from ..store.log_walk import read_messages
from .mcap_choice import Choice
from .mcap_survey import Track
from .mcap_times import Clock, in_order
from .messages.images import frame_of, image_role
from .messages.trees import Decode, decoder_for
from .sealing import ImportedFrame, laser_switches

Mode = Literal["step", "continuous"]
LitAt = Callable[[int], tuple[int, ...]]


def frames_with_state(clock: Clock, choice: Choice) -> tuple[array[int], int]:
    """Places of the images in time order, without those before the first angle or laser state; and
    how many those are. What the table and the laser did before they said so is not known.
    """
    times = clock.times(choice.images)
    order = in_order(times)
    known = max(min(clock.times(t)) for t in (choice.angles, choice.laser) if t is not None)
    early = bisect_left(order, known, key=times.__getitem__)
    return order[early:], early


def angle_events(clock: Clock, track: Track, mode: Mode | None) -> Iterator[TurntableAngle]:
    """Every message of the angle's topic as an event, in time order."""
    times = clock.times(track)
    order = in_order(times)
    for place, i in enumerate(order):
        reported = track.reported[i]
        yield TurntableAngle(
            t_ns=times[i],
            commanded_rad=track.commanded[i],
            reported_rad=None if math.isnan(reported) else reported,
            moving=True if _moving(track, order, place, mode) else None,
        )


def _moving(track: Track, order: Sequence[int], place: int, mode: Mode | None) -> bool:
    """Whether the table turns from this report to the next."""
    if mode == "step" or place + 1 == len(order):
        return False
    here = order[place]
    if mode is None:
        return bool(track.moving[here])
    return _angle(track, here) != _angle(track, order[place + 1])


def _angle(track: Track, i: int) -> float:
    return track.commanded[i] if math.isnan(track.reported[i]) else track.reported[i]


def frames_between_angles(clock: Clock, choice: Choice, order: Sequence[int]) -> int:
    """How many frames have one angle before them and another one after, with nothing said of a turn."""
    track = choice.angles
    times = clock.times(track)
    ranked = in_order(times)
    sorted_ns = array("q", (times[i] for i in ranked))
    count = 0
    for i in order:
        t_ns = clock.times(choice.images)[i]
        after = bisect_right(sorted_ns, t_ns)
        if 0 < after < len(ranked) and sorted_ns[after - 1] != t_ns:
            before = ranked[after - 1]
            count += not track.moving[before] and _angle(track, before) != _angle(track, ranked[after])
    return count


def laser_events(clock: Clock, track: Track, laser: int) -> list[LaserState]:
    """Every message of the laser's topic as an event, in time order."""
    times = clock.times(track)
    return [
        LaserState(
            t_ns=times[i],
            laser=laser if track.lasers[i] < 0 else track.lasers[i],
            on=bool(track.lit[i]),
        )
        for i in in_order(times)
    ]


def lit_at(events: Sequence[LaserState]) -> LitAt:
    """The lasers that are on at a time: what was last said at or before it."""
    times = array("q", (e.t_ns for e in events))
    states: list[tuple[int, ...]] = [()]
    for event in events:
        on = {*states[-1], event.laser} if event.on else {*states[-1]} - {event.laser}
        states.append(tuple(sorted(on)))
    return lambda t_ns: states[bisect_right(times, t_ns)]


def frames(
    path: Path, choice: Choice, clock: Clock, order: Sequence[int], lit: LitAt, *, cut: bool
) -> Iterator[ImportedFrame]:
    """The images named in ``order``, in that order, the file read once; each is checked.

    Raises
    ------
    InputError
        An image cannot be kept as it is, or the file has changed since it was looked through.
    """
    times = clock.times(choice.images)
    rank = {message: place for place, message in enumerate(order)}
    waiting: dict[int, ImportedFrame] = {}
    following = number = 0
    decoders: dict[int, Decode] = {}
    for schema, channel, message in _messages(path, choice.images.topic, cut=cut):
        number += 1
        if number - 1 not in rank:
            continue
        decode = decoders.get(channel.id)
        if decode is None:
            decode = decoders[channel.id] = decoder_for(schema, channel)
        where = f"{path}: {channel.topic}, message {number}"
        role = image_role(schema)
        t_ns = times[number - 1]
        if role is None or message.log_time != choice.images.log_ns[number - 1]:
            break
        # A frame that waits must not hold on to the whole chunk that it came in.
        whole = message.data if rank[number - 1] == following else memoryview(bytes(message.data))
        waiting[rank[number - 1]] = frame_of(
            decode(whole), role, t_ns=t_ns, lasers_on=lit(t_ns), where=where
        )
        while following in waiting:
            yield waiting.pop(following)
            following += 1
    if following != len(order):
        raise InputError(
            f"{path}: changed while it was read", hint="import it when its recorder has closed it"
        )


def _messages(path: Path, topic: str, *, cut: bool) -> Iterator[Any]:
    try:
        yield from read_messages(path, {topic})
    except CutOffError:
        if not cut:
            raise


def items(
    events: Sequence[Iterator[LogEvent]], images: Iterator[ImportedFrame], switched_on: int | None
) -> Iterator[LogEvent | ImportedFrame]:
    """Everything in time order; at equal times in the order laser, angle, frame.

    ``switched_on``: the laser that is on from the first frame, where no topic says so.
    """

    def lighting(source: Iterator[ImportedFrame]) -> Iterator[LogEvent | ImportedFrame]:
        first = next(source)
        if switched_on is not None:
            yield from laser_switches(first.t_ns, (), (switched_on,))
        yield first
        yield from source

    return merge(*events, lighting(images), key=lambda item: item.t_ns)
