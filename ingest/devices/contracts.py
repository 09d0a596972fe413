"""What a recording session asks of its devices: clock, turntable, lasers, camera.

Small protocols; a driver is composed of parts (a link, a dialect, a capture) and inherits from nothing.
Every driver passes the contract tests in tests/contracts/. Failures are DeviceError with what was seen
and what to try; no call waits longer than the driver's own timeout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

#: Called with every line that passes a serial link: device, "sent" or "received", the text, its time.
#: The session writes them to /device/serial.
LineHeard = Callable[[str, str, str, int], None]


class Clock(Protocol):
    """Time of a session: integer nanoseconds, UTC epoch, never running backwards."""

    def now_ns(self) -> int:
        """The present time; later calls give equal or later times."""

    def sleep_s(self, duration_s: float) -> None:
        """Wait at least ``duration_s``."""


@dataclass(frozen=True)
class DeviceInfo:
    """What a device says it is: one line for people, and facts for the log."""

    name: str
    facts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Position:
    """Where the device says the turntable stands, when it said so, and whether it still turns.

    ``angle_rad`` counts on beyond a turn, in the commanded sense; gear ratio and steps are applied.
    """

    t_ns: int
    angle_rad: float
    moving: bool


class Turntable(Protocol):
    """One motor-driven axis with an angle."""

    @property
    def reports_position(self) -> bool:
        """Whether :meth:`position` is the device's own report (False: it only echoes commands)."""

    def connect(self) -> DeviceInfo:
        """Open the port, reset or wake the controller, check its banner, set speeds, hold the motor."""

    def move_to(self, angle_rad: float) -> Position:
        """Turn to an angle (backlash taken up from one side) and return when it stands still there.

        The position returned is the device's report after the motion. DeviceError if it stalls, times
        out, reports another angle than commanded beyond its tolerance, or if the angle lies beyond the
        soft limits.
        """

    def start_move(self, angle_rad: float, speed_rad_s: float) -> None:
        """Begin to turn to an angle at a speed and return at once; watch with :meth:`position`."""

    def position(self) -> Position:
        """Ask the device where it stands; also while it turns."""

    def stop(self) -> None:
        """Stop turning now."""

    def release(self) -> None:
        """Cut the motor's holding current. May be called at any time, more than once."""

    def close(self) -> None:
        """Give the port back. May be called more than once, and after any failure."""


class Lasers(Protocol):
    """The line lasers of a rig."""

    def switch(self, laser: int, *, on: bool) -> None:
        """Switch one laser, by its number in the rig file; returns when the device confirmed it."""

    def all_off(self) -> None:
        """Switch every laser off; tries each even when one fails, then raises the first failure."""

    def keep_alive(self) -> None:
        """Reset the firmware's cut-off timer, where there is one. Called at least once a second."""


@dataclass(frozen=True)
class CameraInfo:
    """A camera that is open: its frame size, pixel format, and the settings as read back."""

    name: str
    width_px: int
    height_px: int
    encoding: str
    settings: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Shot:
    """One exposure. ``t_ns`` is when it was taken (its middle, where known); image (H, W) or (H, W, 3).

    ``number`` counts every frame the source gave since it was opened, so that gaps are seen;
    ``dropped`` is how many were lost before this one because nobody fetched them in time.
    """

    t_ns: int
    image: npt.NDArray[np.generic]
    number: int
    exposure_ns: int | None = None
    dropped: int = 0
    #: What a simulated camera knows of this frame, for the /truth channels.
    truth: Any = None


class Camera(Protocol):
    """A source of frames."""

    def open(self) -> CameraInfo:
        """Open it, set what the rig file asks, read it back; a setting refused silently is an error."""

    def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
        """A frame whose exposure began at or after ``after_ns``; older ones are drained.

        ``exposure_us`` changes the exposure time for this frame (bracketing) where the camera can.
        """

    def stream(self) -> Iterator[Shot]:
        """Every frame from now on, as fast as the source gives them; end by closing the iterator."""

    def close(self) -> None:
        """Give the device back. May be called more than once, and after any failure."""
