"""Which clock an imported recording is told in, and the order of its messages by that clock."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ..schemas.errors import InputError
from .mcap_survey import Track

Times = Literal["auto", "stamp", "log"]

_STAMPS = "header stamps of the messages"
_LOG = "log times of the messages"
#: A table that said nothing for this long before the first frame is not believed to stand there still.
_STALE_NS = 60_000_000_000


@dataclass(frozen=True)
class Clock:
    """The times to use: the messages' own (``stamp``) or the recorder's; in words, and why."""

    use: Literal["stamp", "log"]
    source: str
    why: str

    def times(self, track: Track) -> array[int]:
        """The time of every message of ``track``, in file order."""
        return track.stamp_ns if self.use == "stamp" else track.log_ns


def choose_clock(asked: Times, tracks: Sequence[Track]) -> Clock:
    """One clock for all ``tracks``: images first, then the angle, then the laser if there is one.

    A stamp says when something was, a log time when the recorder heard of it; so stamps are taken
    where every message has one and they belong together. Times of two clocks are never mixed.

    Raises
    ------
    InputError
        The images and the rest have no moment in common by the chosen clock.
    """
    bare = [t.topic for t in tracks if not all(t.stamp_ns)]
    if asked == "stamp" and bare:
        raise InputError(f"{bare[0]}: not every message has a header stamp", hint="use --times log")
    if asked != "log" and not bare:
        stamps = Clock("stamp", _STAMPS, "every message has one")
        apart = _apart(stamps, tracks)
        if apart is None:
            return stamps
        log = Clock("log", _LOG, f"by their stamps {apart}")
        if asked == "stamp" or _apart(log, tracks) is not None:
            raise _no_overlap(apart)
        return log
    why = "as asked" if asked == "log" else f"{bare[0]} has messages without a stamp"
    log = Clock("log", _LOG, why)
    apart = _apart(log, tracks)
    if apart is not None:
        raise _no_overlap(apart)
    return log


def _no_overlap(apart: str) -> InputError:
    return InputError(
        f"no overlap in time: {apart}",
        hint="choose topics that were recorded together, or another clock with --times log|stamp",
    )


def _apart(clock: Clock, tracks: Sequence[Track]) -> str | None:
    """In words, if a track has no moment in common with the images.

    What was said before the first of them still holds, but not for ever: an angle from long before
    is one by another clock, or of another scan. A laser may have been switched on for good.
    """
    first = clock.times(tracks[0])
    for place, track in enumerate(tracks[1:]):
        times = clock.times(track)
        stale = place == 0 and max(times) < min(first) - _STALE_NS
        if min(times) > max(first) or stale:
            return (
                f"{tracks[0].topic} runs from t_ns {min(first)} to {max(first)}, "
                f"{track.topic} from {min(times)} to {max(times)}"
            )
    return None


def in_order(times: Sequence[int]) -> array[int]:
    """Places of the messages in the order of their times; equal times stay in file order."""
    return array("q", sorted(range(len(times)), key=times.__getitem__))


def most_waiting(order: Sequence[int]) -> int:
    """How many messages must be held at once to give them in ``order`` while reading the file once."""
    rank = {message: place for place, message in enumerate(order)}
    held: set[int] = set()
    following = most = 0
    for message in sorted(order):
        held.add(rank[message])
        most = max(most, len(held))
        while following in held:
            held.remove(following)
            following += 1
    return most
