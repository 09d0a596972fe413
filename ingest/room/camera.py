"""The simulated camera: a Camera of the device contracts that renders what the rig's true state shows.

It asks for the true angle and the lasers lit at the middle of each exposure, once the exposure is over,
so its frames show what was, not what the controller believes or reports.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field

from ...schemas.errors import DeviceError
from ...schemas.events import StripeTruth
from ...schemas.scene import Light, Sensor
from ...schemas.truth import packed_truth
from ..devices.contracts import CameraInfo, Clock, Shot
from .render import Encoding, Rendered, Truth, render
from .rig import SimulatedRig
from .scene import Scene

#: Frames that wait for a slow reader, as many as drivers usually hold.
QUEUE_FRAMES = 4


@dataclass(frozen=True)
class FrameTruth:
    """What the camera knows of a frame: the turntable's true angle, and each lit laser's stripe."""

    angle_rad: float
    lasers: dict[int, Truth]

    def events(self, *, t_ns: int, frame: int, camera: str = "0") -> list[StripeTruth]:
        """The ``/truth/<laser>`` messages of this frame, for the log."""
        return [
            packed_truth(
                {
                    "row": truth.row,
                    "u_px": truth.u_px,
                    "x_mm": truth.points_mm[:, 0],
                    "y_mm": truth.points_mm[:, 1],
                    "z_mm": truth.points_mm[:, 2],
                    "range_mm": truth.range_mm,
                    "amplitude_dn": truth.amplitude_dn,
                    "width_px": truth.width_px,
                    "surface": truth.surface,
                },
                t_ns=t_ns,
                frame=frame,
                laser=laser,
                stripe=truth.stripe,
                angle_rad=self.angle_rad,
                camera=camera,
            )
            for laser, truth in sorted(self.lasers.items())
        ]


@dataclass(frozen=True)
class Look:
    """How the simulated camera sees: the scene, its light, the sensor, and the seed of all noise."""

    scene: Scene
    rig: SimulatedRig
    light: Light = field(default_factory=Light)
    sensor: Sensor = field(default_factory=Sensor)
    encoding: Encoding = "mono8"
    seed: int = 1


class SimulatedCamera:
    """A camera before a simulated scene.

    Parameters
    ----------
    look
        What is seen, and how.
    clock
        Of the session; exposures take the time that they say by it.
    actual_angle_rad, lasers_lit
        The true angle, and the numbers (as in the calibration) of the lasers that are lit, at a time
        (``t_ns``) that is now or past.
    exposure_us
        Exposure time; None: the nominal one of the light.
    fps
        The source exposes so many frames a second from :meth:`open` on, whether anybody fetches them or
        not; None: it exposes when asked (a trigger), so equal calls give equal frames.
    timeout_s
        Longest wait for a frame.
    """

    def __init__(
        self,
        look: Look,
        clock: Clock,
        *,
        actual_angle_rad: Callable[[int], float],
        lasers_lit: Callable[[int], Collection[int]],
        exposure_us: float | None = None,
        fps: float | None = None,
        timeout_s: float = 5.0,
    ) -> None:
        self.look = look
        self._clock = clock
        self._angle_rad = actual_angle_rad
        self._lit = lasers_lit
        self._exposure_us = look.light.exposure_us if exposure_us is None else exposure_us
        self._period_ns = None if fps is None else round(1e9 / fps)
        self._timeout_s = timeout_s
        self._opened_ns: int | None = None
        self._next = 0

    def open(self) -> CameraInfo:
        """Start the source; frames count from 0 again."""
        # The first frame compiles the renderer or loads it from disk, which no exposure may wait for.
        self._render(0.0, list(self.look.rig.fans), 0, self._exposure_us)
        self._opened_ns = self._clock.now_ns()
        self._next = 0
        settings: dict[str, float | str] = {
            "exposure_us": self._exposure_us,
            "seed": float(self.look.seed),
        }
        if self._period_ns is not None:
            settings["fps"] = 1e9 / self._period_ns
        camera = self.look.rig.camera
        return CameraInfo(
            "simulated camera", camera.width_px, camera.height_px, self.look.encoding, settings
        )

    def close(self) -> None:
        """Stop the source."""
        self._opened_ns = None

    def shoot(self, after_ns: int, exposure_us: float | None = None) -> Shot:
        """The first frame whose exposure begins at or after ``after_ns`` and now; see the contract."""
        opened = self._opened_or_fail()
        now = self._clock.now_ns()
        begin = max(after_ns, now)
        if begin - now > self._timeout_s * 1e9:
            raise DeviceError(
                f"simulated camera: a frame was asked for in {(begin - now) / 1e9:.1f} s, "
                f"the longest wait is {self._timeout_s:g} s",
                hint="ask for frames when they are due, or give the camera a longer timeout_s",
            )
        if self._period_ns is not None:
            self._next = max(self._next, -(-(begin - opened) // self._period_ns))
            begin = opened + self._next * self._period_ns
        number, self._next = self._next, self._next + 1
        return self._expose(number, begin, exposure_us or self._exposure_us)

    def stream(self) -> Iterator[Shot]:
        """Every frame from now on. A source with ``fps`` drops what nobody fetches, and counts it."""
        opened = self._opened_or_fail()
        if self._period_ns is None:
            while self._opened_ns is not None:
                yield self.shoot(self._clock.now_ns())
            return
        first = max(self._next, -(-(self._clock.now_ns() - opened) // self._period_ns))
        source = _FreeRun(self._clock, self._at_grid, first, opened, self._period_ns)
        try:
            while self._opened_ns is not None:
                shot = source.fetch(self._timeout_s)
                self._next = shot.number + 1
                yield shot
        finally:
            source.stop()

    def _at_grid(self, number: int, begin_ns: int) -> Shot:
        return self._expose(number, begin_ns, self._exposure_us)

    def _expose(self, number: int, begin_ns: int, exposure_us: float) -> Shot:
        """Wait until the exposure is over, and render what its middle saw."""
        exposure_ns = round(exposure_us * 1000)
        while (left := begin_ns + exposure_ns - self._clock.now_ns()) > 0:
            self._clock.sleep_s(left / 1e9)
        middle = begin_ns + exposure_ns // 2
        angle = self._angle_rad(middle)
        made = self._render(angle, self._lit(middle), number, exposure_us)
        return Shot(
            t_ns=middle,
            image=made.image,
            number=number,
            exposure_ns=exposure_ns,
            truth=FrameTruth(angle, made.truth),
        )

    def _render(
        self, angle_rad: float, lasers: Collection[int], number: int, exposure_us: float
    ) -> Rendered:
        look = self.look
        return render(
            look.scene,
            look.rig,
            angle_rad,
            seed=look.seed,
            frame=number,
            lasers=lasers,
            exposure_us=exposure_us,
            light=look.light,
            sensor=look.sensor,
            encoding=look.encoding,
        )

    def _opened_or_fail(self) -> int:
        if self._opened_ns is None:
            raise DeviceError("simulated camera: it is not open", hint="open the camera first")
        return self._opened_ns


class _FreeRun:
    """A thread that exposes at a fixed rate and waits for nobody.

    A frame is lost when the queue is full as it comes (as V4L2 drivers lose them), or when rendering
    took longer than the time between frames. The next frame that is kept says how many were lost.
    """

    def __init__(
        self,
        clock: Clock,
        expose: Callable[[int, int], Shot],
        first: int,
        opened_ns: int,
        period_ns: int,
    ) -> None:
        self._clock = clock
        self._expose = expose
        self._number, self._opened_ns, self._period_ns = first, opened_ns, period_ns
        self._shots: deque[Shot] = deque()
        self._changed = threading.Condition()
        self._failure: BaseException | None = None
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="simulated camera", daemon=True)
        self._thread.start()

    def fetch(self, timeout_s: float) -> Shot:
        """The oldest frame that waits, or the next one."""
        with self._changed:
            ready = self._changed.wait_for(lambda: self._shots or self._failure, timeout_s)
            if self._failure is not None and not self._shots:
                raise self._failure
            if not ready:
                raise DeviceError(
                    f"simulated camera: no frame within {timeout_s:g} s",
                    hint="a lower fps, or a longer timeout_s in [camera]",
                )
            return self._shots.popleft()

    def stop(self) -> None:
        """End the thread; returns when it has ended."""
        with self._changed:
            self._stopped = True
        self._thread.join()

    def _run(self) -> None:
        expected = self._number
        try:
            while not self._stopped:
                shot = self._expose(self._number, self._opened_ns + self._number * self._period_ns)
                with self._changed:
                    if len(self._shots) < QUEUE_FRAMES:
                        lost = self._number - expected
                        self._shots.append(
                            Shot(shot.t_ns, shot.image, shot.number, shot.exposure_ns, lost, shot.truth)
                        )
                        expected = self._number + 1
                        self._changed.notify()
                since = self._clock.now_ns() - self._opened_ns
                # The frame being exposed just now is the next one that can be had.
                self._number = max(self._number + 1, since // self._period_ns)
        except BaseException as error:  # noqa: BLE001 - whatever it is, the reader gets it
            with self._changed:
                self._failure = error
                self._changed.notify()
