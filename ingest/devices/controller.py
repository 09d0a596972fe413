"""The serial controller: Turntable and Lasers of the contracts, composed of a link and a dialect.

Whatever happens, lasers go dark and the motor is let go: on close, when the program ends, and by the
surest means the dialect has (a reset) where a plain command fails.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence

from ...schemas.errors import DeviceError
from ...schemas.rig import LaserSettings, TurntableSettings
from .contracts import DeviceInfo, Position
from .dialects.contract import Dialect, Setup, Status
from .serial_link import SerialLink

_POLL_S = 0.01
_log = logging.getLogger("turnscan")


def setup_of(settings: TurntableSettings, lasers: Sequence[LaserSettings]) -> Setup:
    """What the dialects need of the rig file."""
    return Setup(
        microsteps_per_degree=settings.microsteps_per_degree,
        speed_deg_s=settings.speed_deg_s,
        acceleration_deg_s2=settings.acceleration_deg_s2,
        min_deg=settings.min_deg,
        max_deg=settings.max_deg,
        watchdog_s=settings.watchdog_s,
        outputs=tuple(laser.output for laser in lasers),
    )


class Controller:
    """Turntable and lasers on one serial port. Methods may be called from several threads."""

    def __init__(
        self,
        settings: TurntableSettings,
        lasers: Sequence[LaserSettings],
        link: SerialLink,
        dialect: Dialect,
    ) -> None:
        self._settings = settings
        self._outputs = {laser.number: laser.output for laser in lasers}
        self._link = link
        self._dialect = dialect
        self._lock = threading.RLock()
        self._lit: set[int] = set()
        self._awake = False
        self._held = False
        #: Where the motor was last sent, if it came from below, so that the gear's play is taken up.
        self._from_below_deg: float | None = None

    # -- turntable ----------------------------------------------------------------------------------

    @property
    def reports_position(self) -> bool:
        """All dialects report the controller's own count, or its encoder."""
        return True

    def connect(self) -> DeviceInfo:
        """Open the port, reset the controller, check its banner, set it up; lasers off, motor held."""
        with self._lock:
            self._link.open()
            atexit.register(self.close)
            self._from_below_deg = None
            try:
                with self._telling("connecting"):
                    info = self._dialect.wake()
                self._lit.clear()
            except BaseException:
                # Not close(): a controller that does not answer is not asked to switch anything off.
                atexit.unregister(self.close)
                self._link.close()
                raise
            self._awake = self._held = True
            seen = "seen" if self._dialect.sees_missed_steps else "not seen"
            facts = {
                "dialect": self._settings.dialect,
                "port": self._link.port,
                "baud": str(self._link.baud),
                **info.facts,
                "missed_steps": seen,
            }
            return DeviceInfo(info.name, facts)

    def move_to(self, angle_rad: float) -> Position:
        """Turn there, from below if the gear has play, and report where it stands."""
        angle = self._inside(math.degrees(angle_rad))
        play = self._settings.take_up_deg
        if play > 0 and (self._from_below_deg is None or angle < self._from_below_deg):
            self._turn(self._inside(angle - play))
        status = self._turn(angle)
        self._from_below_deg = angle
        return _position(status)

    def start_move(self, angle_rad: float, speed_rad_s: float) -> None:
        """Begin to turn at a speed; see position()."""
        angle = self._inside(math.degrees(angle_rad))
        speed = abs(math.degrees(speed_rad_s))
        if not 0 < speed < math.inf:
            raise DeviceError(f"a table cannot turn at {speed:g} deg/s", hint="give a speed above 0")
        with self._telling("starting to turn"):
            self._from_below_deg = None
            self._held = True
            self._dialect.start(angle, speed)

    def position(self) -> Position:
        """What the controller (its encoder, where there is one) says now."""
        with self._telling("asking for the position"):
            return _position(self._dialect.status())

    def stop(self) -> None:
        """Brake; returns when the table stands."""
        with self._telling("stopping"):
            self._from_below_deg = None
            self._dialect.stop()

    def release(self) -> None:
        """Let the motor go; nothing to do before connect() or after close()."""
        if not self._awake:
            return
        with self._telling("releasing the motor"):
            self._from_below_deg = None
            try:
                self._dialect.release()
            except DeviceError:
                self._dialect.dark()
                self._dialect.release()
            self._held = False

    def close(self) -> None:
        """Lasers off, motor released, port given back. Never fails: what failed is said in the log."""
        atexit.unregister(self.close)
        with self._lock:
            if self._link.is_open and self._lit:
                self._try("switching the lasers off", self.all_off)
            if self._link.is_open and self._held:
                self._try("releasing the motor", self.release)
            self._awake = self._held = False
            self._link.close()

    def _try(self, what: str, act: Callable[[], None]) -> None:
        try:
            act()
        except DeviceError as error:
            _log.warning("%s failed while closing: %s", what, error)

    # -- lasers -------------------------------------------------------------------------------------

    def switch(self, laser: int, *, on: bool) -> None:
        """Switch one laser, by its number in the rig file; the board confirmed it."""
        output = self._outputs.get(laser)
        if output is None:
            known = ", ".join(map(str, self._outputs))
            raise DeviceError(
                f"no laser {laser} in the rig file; there is {known}",
                hint="add a [[lasers]] table with its number and output",
            )
        with self._telling(f"switching laser {laser} {'on' if on else 'off'}"):
            if on:
                self._lit.add(laser)  # before: it may be lit even if no confirmation comes
            self._dialect.laser(output, on=on)
            if not on:
                self._lit.discard(laser)

    def all_off(self) -> None:
        """Every laser off. Where a command fails, a reset does it, and the first failure is raised."""
        if not self._awake and not self._lit:
            return
        with self._lock:
            first: DeviceError | None = None
            for laser in self._outputs:
                try:
                    self.switch(laser, on=False)
                except DeviceError as error:
                    first = first or error
            if first is None:
                self._lit.clear()
                return
            self._from_below_deg = None
            try:
                self._dialect.dark()
                self._lit.clear()
            except DeviceError as error:
                raise DeviceError(
                    f"{first}; and a reset failed: {error}. A LASER MAY BE LIT",
                    hint="switch the lasers' power off",
                ) from first
            raise DeviceError(
                f"{first} (then the controller was reset, and the lasers are off)", hint=first.hint
            )

    def keep_alive(self) -> None:
        """Restart the firmware's cut-off timer, where there is one."""
        with self._telling("keeping the lasers on"):
            self._dialect.keep_alive()

    # -- inside -------------------------------------------------------------------------------------

    def _inside(self, angle_deg: float) -> float:
        s = self._settings
        if not s.min_deg - 1e-9 <= angle_deg <= s.max_deg + 1e-9:  # NaN is refused, too
            raise DeviceError(
                f"{angle_deg:g} deg lies beyond the soft limits {s.min_deg:g} to {s.max_deg:g} deg",
                hint="min_deg and max_deg in [turntable] set them (backlash is taken up below)",
            )
        return angle_deg

    def _turn(self, angle_deg: float) -> Status:
        """One motion, watched to its end; after a failure the table has been told to stop."""
        with self._telling(f"turning to {angle_deg:g} deg"):
            self._held = True
            self._from_below_deg = None
            started = False
            try:
                before = self._dialect.status()
                self._dialect.start(angle_deg, self._settings.speed_deg_s)
                started = True
                status = self._watch(angle_deg, before.angle_deg)
            except BaseException:
                if started and self._link.is_open:
                    with contextlib.suppress(DeviceError):
                        self._dialect.stop()
                raise
            off = status.angle_deg - angle_deg
            if abs(off) > self._settings.tolerance_deg:
                raise DeviceError(
                    f"sent to {angle_deg:g} deg, but the controller reports {status.angle_deg:.3f} deg",
                    hint="steps were missed: turn slower, accelerate less, check what blocks the table",
                )
            return status

    def _watch(self, angle_deg: float, from_deg: float) -> Status:
        s = self._settings
        timeout = s.timeout_s
        way = abs(angle_deg - from_deg)
        now = time.monotonic()
        latest = now + 1.5 * (way / s.speed_deg_s + s.speed_deg_s / s.acceleration_deg_s2) + timeout
        seen_deg, progressed = from_deg, now
        while True:
            status = self._dialect.status(waiting=True)
            now = time.monotonic()
            if not status.moving:
                return status
            if status.angle_deg != seen_deg:
                seen_deg, progressed = status.angle_deg, now
            if now - progressed > timeout:
                raise DeviceError(
                    f"on the way to {angle_deg:g} deg the table stands at {status.angle_deg:.3f} deg "
                    f"for {timeout:g} s, and its motion has not ended",
                    hint="is it blocked? is the motor's supply on?",
                )
            if now > latest:
                raise DeviceError(
                    f"the motion to {angle_deg:g} deg takes too long, it is at {status.angle_deg:.3f}",
                    hint="does it turn at speed_deg_s? check it and the gear in [turntable]",
                )
            time.sleep(_POLL_S)

    @contextlib.contextmanager
    def _telling(self, what: str) -> Iterator[None]:
        """Hold the lock, and say in errors what was being done."""
        with self._lock:
            try:
                self._link.check_open()
                yield
            except DeviceError as error:
                if str(error).startswith("turntable"):
                    raise
                raise DeviceError(f"turntable, {what}: {error}", hint=error.hint) from error


def _position(status: Status) -> Position:
    return Position(status.t_ns, math.radians(status.angle_deg), status.moving)
