"""The rig file (rig.toml): turntable, lasers, camera, how to scan, and what a simulated rig shows.

Angles are in degrees here and on the command line only. Units stand in the names; every number has a
plausible range, so that a value given in another unit is found before anything moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from .document import Model, check_version, parse_toml, validate

FORMAT: Final = "turnscan.rig"
VERSION: Final = 1

Dialect = Literal["turnscan", "horus", "grbl"]
FaultKind = Literal[
    "delay", "garbage", "lost-command", "lost-reply", "nak", "stall", "missed-steps", "hang-up"
]


def _plausible(low: float, high: float, unit: str) -> Callable[[float], float]:
    """A check that a number lies in [low, high], which guesses when it was given in another unit."""

    def check(value: float) -> float:
        if low <= value <= high:
            return value
        text = f"{value:g} {unit} is not plausible; expected {low:g} to {high:g} {unit}"
        for factor, word in ((1000, "1000 times too small"), (0.001, "1000 times too large")):
            if value and low <= value * factor <= high:
                raise ValueError(f"{text}: {word}, was it given in another unit?")
        raise ValueError(text)

    return check


Degrees = Annotated[float, AfterValidator(_plausible(-36000, 36000, "deg"))]
DegreesPerSecond = Annotated[float, AfterValidator(_plausible(0.01, 720, "deg/s"))]
Seconds = Annotated[float, AfterValidator(_plausible(0.05, 120, "s"))]
ExposureUs = Annotated[float, AfterValidator(_plausible(10, 10_000_000, "us"))]
Px = Annotated[int, Field(ge=16, le=16384)]


class TurntableSettings(Model):
    """The turntable, its controller, and the gear between motor and table."""

    driver: Literal["serial", "simulated"] = Field(
        default="serial", description="serial: a real port; simulated: an emulator on its own port"
    )
    dialect: Dialect = Field(default="turnscan", description="what the controller's firmware speaks")
    port: str | None = Field(
        default=None, description="serial port, such as /dev/ttyUSB0; turnscan rig ports lists them"
    )
    baud: Literal[9600, 19200, 38400, 57600, 115200, 230400, 250000, 460800, 921600] = 115200
    timeout_s: Seconds = Field(default=2.0, description="longest wait for a reply")
    steps_per_turn: Annotated[int, Field(ge=4, le=10_000)] = Field(
        default=200, description="full steps of the motor in one turn of the motor"
    )
    microsteps: Annotated[int, Field(ge=1, le=256)] = Field(default=16, description="of a full step")
    gear_ratio: Annotated[float, AfterValidator(_plausible(0.01, 1000, "turns"))] = Field(
        default=1.0, description="turns of the motor for one turn of the table"
    )
    speed_deg_s: DegreesPerSecond = Field(default=30.0, description="of the table, when positioning")
    acceleration_deg_s2: Annotated[float, AfterValidator(_plausible(1, 10_000, "deg/s2"))] = 200.0
    backlash_deg: Annotated[float, AfterValidator(_plausible(0, 20, "deg"))] = Field(
        default=0.0, description="play of the gear; every angle is approached from below by this much"
    )
    settle_ms: Annotated[float, AfterValidator(_plausible(0, 60_000, "ms"))] = Field(
        default=100.0, description="rest after a motion, before the frame"
    )
    min_deg: Degrees = Field(default=-720.0, description="soft limit: the table never turns below it")
    max_deg: Degrees = Field(default=720.0, description="soft limit: the table never turns above it")
    tolerance_deg: Annotated[float, AfterValidator(_plausible(0.0001, 5, "deg"))] = Field(
        default=0.2, description="largest difference between commanded and reported angle"
    )
    watchdog_s: Annotated[float, AfterValidator(_plausible(0.5, 255, "s"))] = Field(
        default=5.0, description="lasers go off by themselves after this silence (firmware permitting)"
    )

    @property
    def microsteps_per_degree(self) -> float:
        """Microsteps of the motor for one degree of the table."""
        return self.steps_per_turn * self.microsteps * self.gear_ratio / 360.0

    @property
    def take_up_deg(self) -> float:
        """How far below its aim a motion begins its last part, so that the play is surely taken up."""
        if self.backlash_deg == 0:
            return 0.0
        return 1.2 * self.backlash_deg + 2.0 / self.microsteps_per_degree

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.driver == "serial" and not self.port:
            raise ValueError('driver = "serial" needs a port; turnscan rig ports lists them')
        if self.driver == "simulated" and self.port:
            raise ValueError('driver = "simulated" opens a port of its own: leave out port')
        if self.min_deg >= self.max_deg:
            raise ValueError(f"min_deg {self.min_deg:g} is not below max_deg {self.max_deg:g}")
        step = 1.0 / self.microsteps_per_degree
        if self.tolerance_deg < step / 2:
            raise ValueError(
                f"tolerance_deg {self.tolerance_deg:g} is below half a microstep ({step / 2:.3g} deg)"
            )
        return self


class LaserSettings(Model):
    """One line laser: its number in the calibration, and the output of the board it hangs on."""

    number: Annotated[int, Field(ge=0, le=255)] = Field(description="as in the calibration")
    output: Annotated[int, Field(ge=1, le=8)] = Field(description="of the board, counted from 1")


class CameraSettings(Model):
    """The camera. What is left out is not set, and then not checked either."""

    driver: Literal["v4l2", "images", "video", "stream", "simulated"]
    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,40}$")] = "0"
    device: int | str | None = Field(
        default=None, description="v4l2: an index, or a stable name as in /dev/v4l/by-id"
    )
    path: str | None = Field(default=None, description="images: folder or pattern; video: file")
    url: str | None = Field(default=None, description="stream: http://...")
    width_px: Px | None = None
    height_px: Px | None = None
    encoding: Literal["mono8", "mono16", "bgr8"] = "mono8"
    exposure_us: ExposureUs | None = Field(default=None, description="fixed exposure time")
    gain: Annotated[float, Field(ge=0, le=10_000)] | None = Field(
        default=None, description="in the camera's own unit"
    )
    white_balance: Annotated[float, AfterValidator(_plausible(1000, 20_000, "K"))] | None = None
    fps: Annotated[float, AfterValidator(_plausible(0.1, 1000, "frames/s"))] | None = None
    timeout_s: Seconds = Field(default=2.0, description="longest wait for a frame")

    @model_validator(mode="after")
    def _check(self) -> Self:
        wanted = {"v4l2": "device", "images": "path", "video": "path", "stream": "url"}
        needed = wanted.get(self.driver)
        for name in ("device", "path", "url"):
            given = getattr(self, name) is not None
            if name == needed and not given:
                raise ValueError(f'driver = "{self.driver}" needs {name}')
            if name != needed and given:
                raise ValueError(f'driver = "{self.driver}" takes no {name}')
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px and height_px go together")
        return self


class ScanSettings(Model):
    """How a scan goes."""

    mode: Literal["step", "continuous"] = Field(
        default="step", description="stop for each frame, or turn while frames are taken"
    )
    from_deg: Degrees = 0.0
    to_deg: Degrees = Field(default=360.0, description="not taken itself, if a whole turn")
    step_deg: Annotated[float, AfterValidator(_plausible(0.001, 90, "deg"))] = Field(
        default=1.0, description="mode = step: from pose to pose"
    )
    speed_deg_s: DegreesPerSecond = Field(default=5.0, description="mode = continuous: of the table")
    off_frame: bool = Field(default=False, description="also a frame with all lasers off, each pose")
    lasers: Literal["one-by-one", "together"] = "one-by-one"
    exposures_us: tuple[ExposureUs, ...] = Field(
        default=(), description="bracketing: a frame with each; empty: the camera's own"
    )
    frames_per_pose: Annotated[int, Field(ge=1, le=1000)] = 1
    retries: Annotated[int, Field(ge=0, le=100)] = Field(default=1, description="of a failed pose")
    on_failure: Literal["skip", "stop"] = Field(
        default="stop", description="what to do with a pose that failed after all retries"
    )
    max_fps: Annotated[float, AfterValidator(_plausible(0.1, 1000, "frames/s"))] | None = Field(
        default=None, description="mode = continuous: frames beyond this rate are not kept"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.from_deg == self.to_deg:
            raise ValueError(f"from_deg and to_deg are both {self.from_deg:g}: nothing to scan")
        if self.mode == "step" and abs(self.to_deg - self.from_deg) < self.step_deg:
            raise ValueError(f"step_deg {self.step_deg:g} is longer than the whole scan")
        if self.mode == "continuous" and self.exposures_us:
            raise ValueError('exposures_us go with mode = "step": the table must stand still')
        return self


class Fault(Model):
    """Something that goes wrong in the simulated controller.

    Counted are the things that the fault can hit, from 1 since the controller was switched on:
    motions for ``stall`` and ``missed-steps``, else command lines of the sort ``on``.
    """

    kind: FaultKind
    on: Literal["any", "move", "laser", "motor", "status"] = Field(
        default="any", description="which command lines are counted and hit"
    )
    at: Annotated[int, Field(ge=1)] = Field(default=1, description="the first one that is hit")
    count: Annotated[int, Field(ge=1)] = Field(default=1, description="how many in a row are hit")
    delay_s: Annotated[float, AfterValidator(_plausible(0.001, 600, "s"))] = Field(
        default=1.0, description="kind = delay: so much later the reply comes"
    )
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        default=100, description="kind = missed-steps: microsteps that the motor does not make"
    )


class Simulated(Model):
    """What stands in for hardware where a driver is ``simulated``."""

    scene: str | dict[str, Any] = Field(
        default="room", description="a built-in scene, the path of a scene.toml, or the table itself"
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=1, description="of all noise")
    light: dict[str, Any] = Field(
        default_factory=dict, description="ambient light and noise of the camera"
    )
    faults: tuple[Fault, ...] = ()
    time_scale: Annotated[float, AfterValidator(_plausible(1, 1000, "times"))] = Field(
        default=1.0, description="the simulated table turns so many times faster than it is told"
    )


class Rig(Model):
    """A whole rig file."""

    format: Literal["turnscan.rig"] = FORMAT
    version: Literal[1] = VERSION
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}$")]
    calibration: str | None = Field(
        default=None, description="calibration document, relative to the rig file"
    )
    turntable: TurntableSettings
    lasers: tuple[LaserSettings, ...] = Field(min_length=1)
    camera: CameraSettings
    scan: ScanSettings = Field(default_factory=ScanSettings)
    simulated: Simulated | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("number", "output"):
            seen = [getattr(laser, name) for laser in self.lasers]
            if len(set(seen)) != len(seen):
                raise ValueError(f"lasers: the same {name} stands twice: {seen}")
        most = {"turnscan": 8, "horus": 2, "grbl": 1}[self.turntable.dialect]
        beyond = [laser.output for laser in self.lasers if laser.output > most]
        if beyond:
            raise ValueError(
                f"lasers: output {beyond[0]}, but {self.turntable.dialect} boards have 1 to {most}"
            )
        simulated = "simulated" in (self.turntable.driver, self.camera.driver)
        if self.simulated is not None and not simulated:
            raise ValueError('[simulated] stands there, but no driver is "simulated"')
        if self.camera.driver == "simulated" and self.turntable.driver != "simulated":
            raise ValueError("a simulated camera looks at a simulated turntable only")
        self._check_range()
        return self

    def _check_range(self) -> None:
        table, scan = self.turntable, self.scan
        low = min(scan.from_deg, scan.to_deg) - table.take_up_deg
        high = max(scan.from_deg, scan.to_deg)
        if low < table.min_deg or high > table.max_deg:
            backlash = " (taking up the backlash included)" if table.backlash_deg else ""
            raise ValueError(
                f"the scan turns from {low:g} to {high:g} deg{backlash}, "
                f"the turntable only from min_deg {table.min_deg:g} to max_deg {table.max_deg:g}"
            )


def parse_rig(data: bytes, *, where: str) -> Rig:
    """A rig file from TOML bytes; DocumentError names the field, what was found and what fits."""
    table = parse_toml(data, where=where)
    check_version(table, name=FORMAT, version=VERSION, where=where)
    return validate(Rig, table, where=where)
