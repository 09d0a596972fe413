"""A small simulated rig with a real controller emulator behind it, and a call that records with it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from turnscan.ingest.devices.building import Devices as Built
from turnscan.ingest.devices.building import build_devices
from turnscan.ingest.session.interrupts import Interrupts
from turnscan.ingest.session.order import Devices, Earlier, Order, Progress, Recorded
from turnscan.ingest.session.session import SerialLines, record
from turnscan.schemas.calibration import Calibration, LaserPlane, PaperCalibration
from turnscan.schemas.document import dump_json
from turnscan.schemas.rig import Rig
from turnscan.store import Archive
from turnscan.store.log_reader import LogFrame

WIDTH, HEIGHT = 160, 120

#: A camera without noise: what is recorded again is the same to the last bit.
NO_NOISE = {"exposure_us": 1000.0, "noise_dn": 0.0, "shot_dn_per_dn": 0.0}


def calibration(lasers: int = 1) -> Calibration:
    """A rig in the middle of a room; further lasers lie in planes turned a little."""
    made = PaperCalibration(
        rig="sim",
        width_px=WIDTH,
        height_px=HEIGHT,
        f_px=190.0,
        cx_px=80.0,
        cy_px=60.0,
        L_mm=300.0,
        D_mm=150.0,
        theta_rad=math.atan2(1.0, 0.4),
        c_mm=40.0,
    ).calibration()
    planes = list(made.lasers)
    for n in range(1, lasers):
        theta = math.atan2(1.0, 0.4 + 0.15 * n)
        normal = (math.sin(theta), 0.0, math.cos(theta))
        planes.append(LaserPlane(laser=n, normal=normal, distance_mm=300.0 * math.sin(theta)))
    return made.model_copy(update={"lasers": tuple(planes)})


def rig(
    folder: Path,
    *,
    lasers: int = 1,
    dialect: str = "turnscan",
    faults: tuple[dict[str, Any], ...] = (),
    turntable: dict[str, Any] | None = None,
    camera: dict[str, Any] | None = None,
    simulated: dict[str, Any] | None = None,
    **scan: Any,
) -> Rig:
    """The rig document; ``folder`` takes its calibration."""
    path = folder / "calibration.json"
    path.write_bytes(dump_json(calibration(lasers).plain()))
    return Rig.model_validate(
        {
            "name": "sim",
            "calibration": str(path),
            "turntable": {
                "driver": "simulated",
                "dialect": dialect,
                "settle_ms": 0,
                "speed_deg_s": 180,
                "acceleration_deg_s2": 2000,
                "gear_ratio": 10,
                "timeout_s": 0.4,
                **(turntable or {}),
            },
            "lasers": [{"number": n, "output": n + 1} for n in range(lasers)],
            "camera": {"driver": "simulated", "timeout_s": 1.0, "exposure_us": 1000, **(camera or {})},
            "scan": {"to_deg": 30, "step_deg": 10, **scan},
            "simulated": {
                "time_scale": 5,
                "light": NO_NOISE,
                "faults": list(faults),
                **(simulated or {}),
            },
        }
    )


@dataclass
class Ran:
    """What a session did, and what its controller was left in."""

    archive: Archive
    built: Built
    result: Recorded | None = None
    error: BaseException | None = None
    shown: list[Progress] = field(default_factory=list)

    def frames(self) -> list[LogFrame]:
        assert self.result is not None
        assert self.result.scan is not None
        return list(self.archive.log(self.result.scan.scan).frames())

    def items(self) -> list[Any]:
        assert self.result is not None
        assert self.result.scan is not None
        return list(self.archive.log(self.result.scan.scan).items())

    def assert_at_rest(self, cable_off_s: float | None) -> None:
        emulator = self.built.emulator
        assert emulator is not None
        if cable_off_s is not None:
            until = time.monotonic() + cable_off_s
            while emulator.body.lit and time.monotonic() < until:
                time.sleep(0.01)
            assert emulator.body.lit == frozenset(), "the watchdog left a laser on"
            return
        assert emulator.body.lit == frozenset(), "a laser was left on"
        assert not emulator.body.held, "the motor was left on"
        assert not emulator.body.moving, "the table was left turning"


def order_of(document: Rig, *, earlier: Earlier | None = None, label: str = "") -> Order:
    return Order(
        rig=document.name,
        lasers=tuple(laser.number for laser in document.lasers),
        scan=document.scan,
        source="simulated",
        calibration=calibration(len(document.lasers)),
        earlier=earlier,
        label=label,
        stall_s=document.camera.timeout_s,
        at_zero=True,
    )


def run(
    archive: Archive,
    document: Rig,
    *,
    order: Order | None = None,
    wrap: Callable[[Devices], Devices] = lambda d: d,
    show_also: Callable[[Progress], None] = lambda _: None,
    cable_off_s: float | None = None,
    **more: Any,
) -> Ran:
    """Record with the real driver, emulator and simulated camera; errors end up in the result."""
    lines = SerialLines()
    built = build_devices(document, heard=lines)
    ran = Ran(archive, built)

    def show(progress: Progress) -> None:
        ran.shown.append(progress)
        show_also(progress)

    try:
        devices = wrap(Devices(built.clock, built.controller, built.controller, built.camera))
        with Interrupts() as interrupts:
            ran.result = record(
                archive,
                order or order_of(document),
                devices,
                lines,
                interrupts=interrupts,
                show=show,
                **more,
            )
    except BaseException as error:  # noqa: BLE001 - the test looks at it
        ran.error = error
    finally:
        # The session must have put everything to rest by itself: looked at before the drivers close.
        ran.assert_at_rest(cable_off_s)
        built.close()
    return ran
