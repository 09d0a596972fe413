"""From a rig file to drivers: which driver name is which class, and what they need to be made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from ...schemas.errors import StorageError
from ...schemas.rig import Fault, LaserSettings, Rig, Simulated, TurntableSettings, parse_rig
from .clock import SystemClock
from .contracts import Camera, Clock, LineHeard
from .controller import Controller, setup_of
from .dialects.contract import Dialect, Setup
from .dialects.grbl import GrblDialect
from .dialects.horus import HorusDialect
from .dialects.turnscan import TurnscanDialect
from .emulator.body import Body
from .emulator.grbl import GrblFirmware
from .emulator.horus import HorusFirmware
from .emulator.port import Emit, Emulator, Firmware
from .emulator.turnscan import TurnscanFirmware
from .serial_link import SerialLink

DIALECTS: dict[str, Callable[[SerialLink, Setup], Dialect]] = {
    "turnscan": TurnscanDialect,
    "horus": HorusDialect,
    "grbl": GrblDialect,
}
FIRMWARES: dict[str, Callable[[Body, Emit], Firmware]] = {
    "turnscan": TurnscanFirmware,
    "horus": HorusFirmware,
    "grbl": GrblFirmware,
}


def read_rig(path: Path) -> Rig:
    """The rig file at ``path``, with the paths in it made absolute."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise StorageError(
            f"cannot read the rig file {path}: {error.strerror}",
            hint="turnscan rig new > rig.toml makes one to start from",
        ) from error
    return _with_absolute_paths(parse_rig(data, where=str(path)), path.resolve().parent)


def _with_absolute_paths(rig: Rig, folder: Path) -> Rig:
    """Relative paths in a rig file are relative to its folder."""
    changes: dict[str, object] = {}
    if rig.calibration is not None:
        changes["calibration"] = str(folder / rig.calibration)
    if rig.camera.path is not None:
        changes["camera"] = rig.camera.model_copy(update={"path": str(folder / rig.camera.path)})
    simulated = rig.simulated
    if simulated is not None and isinstance(simulated.scene, str) and simulated.scene.endswith(".toml"):
        changes["simulated"] = simulated.model_copy(update={"scene": str(folder / simulated.scene)})
    return rig.model_copy(update=changes)


def build_emulator(
    settings: TurntableSettings,
    clock: Clock,
    *,
    faults: tuple[Fault, ...] = (),
    time_scale: float = 1.0,
    seed: int = 1,
) -> Emulator:
    """An emulated controller of the settings' dialect and gear, not started yet."""
    body = Body(
        clock,
        microsteps_per_degree=settings.microsteps_per_degree,
        play_deg=settings.backlash_deg,
        time_scale=time_scale,
    )
    return Emulator(FIRMWARES[settings.dialect], body, faults, seed=seed)


def build_controller(
    settings: TurntableSettings,
    lasers: tuple[LaserSettings, ...],
    clock: Clock,
    *,
    port: str | None = None,
    heard: LineHeard | None = None,
) -> Controller:
    """The driver for a controller on ``port`` (default: the settings' own)."""
    name = port or settings.port
    assert name, "the rig document checks this"
    link = SerialLink(name, settings.baud, timeout_s=settings.timeout_s, clock=clock, heard=heard)
    return Controller(
        settings, lasers, link, DIALECTS[settings.dialect](link, setup_of(settings, lasers))
    )


@dataclass
class Devices:
    """Drivers of one rig, not connected yet. A context manager that closes all of them."""

    rig: Rig
    clock: Clock
    controller: Controller
    camera: Camera
    #: The emulated controller, already running, where the turntable is simulated.
    emulator: Emulator | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Lasers off, motor released, camera and port given back; more than once is fine."""
        try:
            self.controller.close()
        finally:
            try:
                self.camera.close()
            finally:
                if self.emulator is not None:
                    self.emulator.stop()


def build_devices(rig: Rig, *, clock: Clock | None = None, heard: LineHeard | None = None) -> Devices:
    """Drivers for everything that ``rig`` names; a simulated controller is started."""
    clock = clock or SystemClock()
    emulator = None
    if rig.turntable.driver == "simulated":
        simulated = rig.simulated or Simulated()
        emulator = build_emulator(
            rig.turntable,
            clock,
            faults=simulated.faults,
            time_scale=simulated.time_scale,
            seed=simulated.seed,
        ).start()
    try:
        camera = build_camera(rig, clock, emulator)
        controller = build_controller(
            rig.turntable,
            rig.lasers,
            clock,
            port=emulator.port if emulator else None,
            heard=heard,
        )
    except BaseException:
        if emulator is not None:
            emulator.stop()
        raise
    return Devices(rig, clock, controller, camera, emulator)


def build_camera(rig: Rig, clock: Clock, emulator: Emulator | None = None) -> Camera:
    """The camera driver that ``rig`` names. Imported late: they load OpenCV and Numba."""
    if rig.camera.driver == "simulated":
        from ..room.opening import simulated_camera

        assert emulator is not None, "the rig document checks this"
        body = emulator.body
        numbers = {laser.output: laser.number for laser in rig.lasers}
        return simulated_camera(
            rig,
            clock,
            actual_angle_rad=lambda t_ns: body.state(t_ns).angle_rad,
            lasers_lit=lambda t_ns: [
                numbers[n] for n in sorted(body.state(t_ns).outputs_lit) if n in numbers
            ],
            folder=Path(),
            where=f"rig {rig.name}",
        )
    from .cameras.building import camera_of

    return camera_of(rig.camera, clock, folder=Path())
