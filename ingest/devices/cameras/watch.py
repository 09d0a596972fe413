"""What frames show of a source that fails: another size or format, darkness, a slower rhythm."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo
from .capture import DamagedFrameError, Image, encoding_of, form_of
from .pace import Pace

#: Up to this grey value everywhere, a frame is black. A dead source sends 0; JPEG may add a little.
_BLACK_DN: Final = 2
#: Below this part of the rate that stood at the beginning, a source is failing.
_SLOW: Final = 0.6


@dataclass(frozen=True)
class Limits:
    """How long a source may misbehave before it is an error; with a margin to the two seconds promised.

    ``stall_s`` is longer for a source whose frames take longer than a third of it.
    ``black_s`` None: black frames are let pass, for rooms so dark that nothing of a frame is bright.
    """

    stall_s: float = 1.3
    black_s: float | None = 1.3


def check_form(camera: str, image: Image, info: CameraInfo) -> None:
    """DeviceError if a frame is not of the size and encoding that the camera was opened with."""
    if image.shape[:2] != (info.height_px, info.width_px) or encoding_of(image) != info.encoding:
        raise DeviceError(
            f"{camera}: its frames changed from {info.width_px} x {info.height_px} {info.encoding} "
            f"to {form_of(image)}",
            hint="did another program set the camera? set the size in the rig file; "
            "record --resume continues the scan",
        )


class SilenceWatch:
    """Notices a source that gives nothing, or nothing whole. Whoever shares it holds a lock."""

    def __init__(self, camera: str, limits: Limits) -> None:
        self._camera = camera
        self._limits = limits
        self._since_ns = time.monotonic_ns()
        self._damage: DamagedFrameError | None = None

    def note(self, arrived_ns: int) -> None:
        """A whole frame came."""
        self._since_ns = arrived_ns
        self._damage = None

    def note_damage(self, damage: DamagedFrameError) -> None:
        """A broken frame came: that is no silence, but no frame either."""
        self._damage = damage

    def found(self, slowest_s: float) -> DeviceError | None:
        """The error, if it has lasted longer than the limit and three frames of ``slowest_s`` each."""
        silent_s = (time.monotonic_ns() - self._since_ns) / 1e9
        if silent_s <= max(self._limits.stall_s, 3 * slowest_s):
            return None
        if self._damage is not None:
            text = f"{self._damage} (no whole one for {silent_s:.1f} s)"
            return DeviceError(text, hint=self._damage.hint)
        return no_frame(self._camera, silent_s)


def no_frame(camera: str, waited_s: float) -> DeviceError:
    """The error of a source that fell silent."""
    return DeviceError(
        f"{camera}: no frame for {waited_s:.1f} s",
        hint="check its cable or network and its power; record --resume continues the scan",
    )


class BlackWatch:
    """Notices a source that showed something and then turns black.

    A dark room is black too while the laser is off, however long the table turns. So it takes both:
    every frame of the last ``Limits.black_s`` was black, and so were this shot and the one before it.
    """

    def __init__(self, camera: str, limits: Limits) -> None:
        self._camera = camera
        self._limits = limits
        self._seen = False
        self._black_since_ns: int | None = None
        self._last_was_black = False

    def note(self, image: Image, arrived_ns: int) -> None:
        """A frame came."""
        if not _is_black(image):
            self._seen = True
            self._black_since_ns = None
        elif self._black_since_ns is None and self._seen:
            self._black_since_ns = arrived_ns

    def check_given(self, image: Image, now_ns: int) -> None:
        """A frame is about to be given; DeviceError if the source is dead."""
        before, self._last_was_black = self._last_was_black, _is_black(image)
        since_ns, limit_s = self._black_since_ns, self._limits.black_s
        if since_ns is None or limit_s is None or not (before and self._last_was_black):
            return
        if now_ns - since_ns >= limit_s * 1e9:
            raise DeviceError(
                f"{self._camera}: its frames turned black (at most {_BLACK_DN} DN for {limit_s:g} s)",
                hint="lens cap, light, exposure? A little room light or gain lifts the dark above zero",
            )


def _is_black(image: Image) -> bool:
    return int(image.max()) <= _BLACK_DN


def check_rate(camera: str, pace: Pace, now_ns: int, asked_hz: float | None) -> None:
    """DeviceError if the source gives far fewer frames than it did, or another rate than was asked."""
    if pace.period_ns is None:
        return
    usual_hz = 1e9 / pace.period_ns
    if asked_hz is not None and not _SLOW < usual_hz / asked_hz < 1 / _SLOW:
        raise DeviceError(
            f"{camera}: fps: asked {asked_hz:g}, found {usual_hz:.1f}",
            hint="long exposures lower the rate; set fps to what the camera gives, or leave it out",
        )
    rate_hz = pace.rate_hz(now_ns)
    if rate_hz is not None and rate_hz < _SLOW * usual_hz:
        raise DeviceError(
            f"{camera}: drops frames: {rate_hz:.1f} a second now, {usual_hz:.1f} at the beginning",
            hint="network or USB bandwidth? choose a smaller size or a lower rate",
        )
