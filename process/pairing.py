"""Pair each laser-lit frame with its angle and its laser-off frame, by time, in one pass.

Recording writes facts; which facts belong together is decided here. The angle of a frame is the
last one at or before its exposure, as the device reported it if it did, else as commanded. Its
laser-off frame is the one at the same angle, before or after it, else the last one before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..schemas.errors import InputError
from ..schemas.events import TurntableAngle

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True)
class LitFrame:
    """One frame with at least one laser on, its angle and, where asked for, its laser-off frame."""

    frame: int
    t_ns: int
    angle_rad: float
    lasers_on: tuple[int, ...]
    image: Image
    background: Image | None


@dataclass
class _Waiting:
    frame: Any
    image: Image
    angle_rad: float


def pair_frames(items: Iterable[Any], *, with_background: bool) -> Iterator[LitFrame]:
    """Lit frames of a log in time order.

    ``items`` are turntable angles and frames (``frame``, ``t_ns``, ``lasers_on``, ``decode()``) in
    time order. With ``with_background`` at most the frames of one angle are held back, until the
    laser-off frame of that angle has been seen or the turntable has moved on.

    Raises
    ------
    InputError
        A frame comes before any angle; or laser-off frames are asked for and there is none.
    """
    angle: TurntableAngle | None = None
    off: Image | None = None
    off_angle: float | None = None
    waiting: list[_Waiting] = []

    def release() -> Iterator[LitFrame]:
        for held in waiting:
            if off is None:
                raise InputError(
                    f"frame {held.frame.frame} has no laser-off frame at or before its angle",
                    hint='record or import laser-off frames, or set extract.background = "none"',
                )
            yield _lit(held, off)
        waiting.clear()

    for item in items:
        if isinstance(item, TurntableAngle):
            if waiting and _value(item) != waiting[0].angle_rad:
                yield from release()
            angle = item
            continue
        if not item.lasers_on:
            if with_background:
                off, off_angle = item.decode(), None if angle is None else _value(angle)
                yield from release()
            continue
        if angle is None:
            raise InputError(
                f"frame {item.frame} (t_ns {item.t_ns}) has no turntable angle at or before it",
                hint="the log lacks /turntable/angle events; import it again with angles",
            )
        value = _value(angle)
        held = _Waiting(item, item.decode(), value)
        if not with_background:
            yield _lit(held, None)
        elif off_angle == value and not waiting:
            yield _lit(held, off)
        else:
            waiting.append(held)
    yield from release()


def _value(angle: TurntableAngle) -> float:
    return angle.commanded_rad if angle.reported_rad is None else angle.reported_rad


def _lit(held: _Waiting, background: Image | None) -> LitFrame:
    return LitFrame(
        frame=held.frame.frame,
        t_ns=held.frame.t_ns,
        angle_rad=held.angle_rad,
        lasers_on=held.frame.lasers_on,
        image=held.image,
        background=background,
    )
