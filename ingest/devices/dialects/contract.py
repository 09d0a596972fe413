"""What a dialect does for the controller driver: the table in degrees, lasers by output."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

from ....schemas.errors import DeviceError
from ..contracts import DeviceInfo
from ..serial_link import SerialLink


@dataclass(frozen=True)
class Setup:
    """What the rig file says of the table, as the dialects need it."""

    microsteps_per_degree: float
    speed_deg_s: float
    acceleration_deg_s2: float
    min_deg: float
    max_deg: float
    watchdog_s: float
    outputs: tuple[int, ...]


@dataclass(frozen=True)
class Status:
    """What the controller says of itself at ``t_ns`` (the middle of question and answer)."""

    t_ns: int
    angle_deg: float
    moving: bool


class Dialect(Protocol):
    """One way to talk to a controller. Every method may raise DeviceError, and none waits longer than
    twice the link's timeout (the second time to be in step again after an earlier failure).
    """

    @property
    def sees_missed_steps(self) -> bool:
        """Whether missed steps show in the position report (an encoder), or nothing can tell."""

    def wake(self) -> DeviceInfo:
        """Reset, check the banner, set what the rig file says, hold the motor."""

    def hold(self) -> None:
        """Give the motor its holding current, if it has not."""

    def release(self) -> None:
        """Cut the motor's current; a motion is stopped first."""

    def start(self, angle_deg: float, speed_deg_s: float) -> None:
        """Begin a motion to an absolute angle."""

    def status(self, *, waiting: bool = False) -> Status:
        """Position and whether the motion that was begun last still goes on.

        ``waiting``: while it moves, a report that may be older than the question will do.
        """

    def stop(self) -> None:
        """Brake and forget the motion; returns when the table stands."""

    def laser(self, output: int, *, on: bool) -> None:
        """Switch one laser; confirmed by the board."""

    def dark(self) -> None:
        """Every laser off by the surest means there is (a reset); confirmed by the board."""

    def keep_alive(self) -> None:
        """Keep the board's cut-off timer from ending a scan."""


_FIRMWARE = (
    ("horus", re.compile(r"^Horus (\S+)")),
    ("grbl", re.compile(r"^Grbl (\S+)")),
    ("turnscan", re.compile(r"^!0000 READY turnscan proto=(\d+) ")),
)


def no_banner(link: SerialLink, wanted: str, lines: list[str]) -> DeviceError:
    """The error for a controller that did not present itself as ``wanted``."""
    start = f"{link.port} at {link.baud} baud: "
    for name, pattern in _FIRMWARE:
        for line in lines:
            match = pattern.match(line)
            if match and name != wanted.split(maxsplit=1)[0].lower():
                return DeviceError(
                    f"{start}expected {wanted}, found other firmware: {line!r}",
                    hint=f'set dialect = "{name}" in [turntable], or give the port of another board',
                )
            if match and match[1] not in wanted:
                return DeviceError(
                    f"{start}expected {wanted}, found another version: {line!r}",
                    hint="install the firmware that docs/controllers.md names",
                )
    seen = "; ".join(lines[:3]) or link.partial()
    if "\\x" in seen:
        return DeviceError(
            f"{start}garbage instead of {wanted}: {seen[:80]!r}",
            hint="probably the wrong baud: set baud in [turntable] to the firmware's",
        )
    if seen:
        return DeviceError(
            f"{start}expected {wanted}, found {seen[:80]!r}",
            hint="is it the right port and the right dialect? turnscan rig ports lists ports",
        )
    return DeviceError(
        f"{start}no answer; expected {wanted}",
        hint="is it switched on, is it the right port and baud? turnscan rig ports lists ports",
    )
