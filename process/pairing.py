"""Pair each laser-lit frame with its angle and its laser-off frame, by time, in one pass.

Recording writes facts; which facts belong together is decided here. The angle of a frame is the
last one at or before its exposure, as the device reported it if it did, else as commanded. Where the
table was turning at that report, the frame's angle lies on the line from there to the next report.
Its laser-off frame is the one at the same angle, before or after it, else the last one before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from ..schemas.errors import InputError
from ..schemas.events import TurntableAngle


class LitFrame(NamedTuple):
    """One frame with at least one laser on, its angle and, where asked for, its laser-off frame.

    ``image`` and ``background`` are what the items' ``decode()`` gives.
    """

    frame: int
    t_ns: int
    angle_rad: float
    lasers_on: tuple[int, ...]
    image: Any
    background: Any


class Placed(NamedTuple):
    """A frame and the angle that it was taken at; None before the first angle of the log."""

    item: Any
    angle_rad: float | None
    #: Whether the table was turning: no other frame was taken at the same angle.
    turning: bool = False


def place_frames(items: Iterable[Any], left_out: list[int]) -> Iterator[Placed]:
    """Every frame of a log in time order, with its angle.

    ``items`` are turntable angles and frames (``frame``, ``t_ns``, ``lasers_on``, ``decode()``) in
    time order. Frames taken while the table turned are held back until its next report. Those after
    the last report have no angle: they are not given, and their numbers go to ``left_out``.
    """
    last: TurntableAngle | None = None
    held: list[Any] = []
    for item in items:
        if isinstance(item, TurntableAngle):
            if last is not None:
                yield from (Placed(h, _between(last, item, h.t_ns), turning=True) for h in held)
                held.clear()
            last = item
        elif last is not None and last.moving:
            held.append(item)
        else:
            yield Placed(item, None if last is None else _value(last))
    left_out += [h.frame for h in held]


def pair_frames(
    items: Iterable[Any], *, with_background: bool, left_out: list[int] | None = None
) -> Iterator[LitFrame]:
    """Lit frames of a log in time order.

    ``items`` and ``left_out`` as in :func:`place_frames`. With ``with_background`` at most the frames
    of one angle are held back, until the laser-off frame of that angle has been seen or the turntable
    has moved on.

    Raises
    ------
    InputError
        A frame comes before any angle; or laser-off frames are asked for and there is none.
    """
    off: Any = None
    off_angle: float | None = None
    waiting: list[tuple[Placed, Any]] = []

    def release() -> Iterator[LitFrame]:
        for placed, image in waiting:
            if off is None:
                raise InputError(
                    f"frame {placed.item.frame} has no laser-off frame at or before its angle",
                    hint='record or import laser-off frames, or set extract.background = "none"',
                )
            yield _lit(placed, image, off)
        waiting.clear()

    for placed in place_frames(items, [] if left_out is None else left_out):
        item, angle = placed.item, placed.angle_rad
        if waiting and angle != waiting[0][0].angle_rad:
            yield from release()
        if not item.lasers_on:
            if with_background:
                off, off_angle = item.decode(), angle
                yield from release()
            continue
        if angle is None:
            raise InputError(
                f"frame {item.frame} (t_ns {item.t_ns}) has no turntable angle at or before it",
                hint="the log lacks /turntable/angle events; import it again with angles",
            )
        image = item.decode()
        if not with_background:
            yield _lit(placed, image, None)
        elif off is not None and not waiting and (placed.turning or off_angle == angle):
            yield _lit(placed, image, off)
        else:
            waiting.append((placed, image))
    yield from release()


def _value(angle: TurntableAngle) -> float:
    return angle.commanded_rad if angle.reported_rad is None else angle.reported_rad


def _between(before: TurntableAngle, after: TurntableAngle, t_ns: int) -> float:
    """The angle at ``t_ns`` on the line through two reports."""
    first, second = _value(before), _value(after)
    if after.t_ns == before.t_ns:
        return second
    return first + (second - first) * ((t_ns - before.t_ns) / (after.t_ns - before.t_ns))


def _lit(placed: Placed, image: Any, background: Any) -> LitFrame:
    assert placed.angle_rad is not None
    return LitFrame(
        frame=placed.item.frame,
        t_ns=placed.item.t_ns,
        angle_rad=placed.angle_rad,
        lasers_on=placed.item.lasers_on,
        image=image,
        background=background,
    )
