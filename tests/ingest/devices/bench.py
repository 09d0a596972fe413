"""A driver and the emulated controller behind it, as tests want them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from turnscan.ingest.devices.building import build_controller, build_emulator
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.controller import Controller
from turnscan.ingest.devices.emulator.port import Emulator
from turnscan.schemas.rig import Fault, LaserSettings, TurntableSettings

DIALECTS = ("turnscan", "horus", "grbl")
TIMEOUT_S = 0.4


@dataclass
class Bench:
    """``controller`` drives ``emulator``; ``lines`` is what passed between them."""

    settings: TurntableSettings
    emulator: Emulator
    controller: Controller
    lines: list[tuple[str, str, str, int]] = field(default_factory=list)

    @property
    def microstep_deg(self) -> float:
        return 1 / self.settings.microsteps_per_degree

    def sent(self) -> list[str]:
        return [text for _, direction, text, _ in self.lines if direction == "sent"]


@contextlib.contextmanager
def bench(
    dialect: str,
    *,
    faults: tuple[Fault, ...] = (),
    time_scale: float = 20.0,
    lasers: int = 1,
    **settings: Any,
) -> Iterator[Bench]:
    """A running emulator and a driver that is not connected yet."""
    values: dict[str, Any] = {
        "driver": "simulated",
        "dialect": dialect,
        "timeout_s": TIMEOUT_S,
        "speed_deg_s": 60.0,
        "acceleration_deg_s2": 600.0,
        "gear_ratio": 4.0,
        "watchdog_s": 0.5,
        "min_deg": -100.0,
        "max_deg": 400.0,
    }
    made = TurntableSettings(**{**values, **settings})
    clock = SystemClock()
    lines: list[tuple[str, str, str, int]] = []
    with build_emulator(made, clock, faults=faults, time_scale=time_scale) as emulator:
        controller = build_controller(
            made,
            tuple(LaserSettings(number=n, output=n + 1) for n in range(lasers)),
            clock,
            port=emulator.port,
            heard=lambda *heard: lines.append(heard),
        )
        try:
            yield Bench(made, emulator, controller, lines)
        finally:
            controller.close()
        assert emulator.failure is None, emulator.failure
