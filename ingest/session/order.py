"""What a session is asked to do, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ...schemas.calibration import Calibration
from ...schemas.errors import TurnscanError
from ...schemas.events import LogEvent
from ...schemas.manifests import ScanSummary
from ...schemas.rig import ScanSettings
from ..devices.contracts import Camera, CameraInfo, Clock, Lasers, Turntable
from .plan import Taken


@dataclass(frozen=True)
class Devices:
    """The devices of a rig, not connected yet."""

    clock: Clock
    turntable: Turntable
    lasers: Lasers
    camera: Camera


@dataclass(frozen=True)
class Earlier:
    """What earlier logs of the same scan hold: the last of them, its frames, how far each sweep got."""

    scan: str
    taken: tuple[Taken, ...]
    reached: Mapping[tuple[int, ...], float]
    next_frame: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class Order:
    """One recording: the rig as far as the session must know it, and what is said of the scan."""

    rig: str
    lasers: tuple[int, ...]
    scan: ScanSettings
    camera_id: str = "0"
    source: str = "recorded"
    label: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    calibration: Calibration | None = None
    earlier: Earlier | None = None
    #: The table stands at its zero, or is known to: a resumed scan may trust the controller's count.
    at_zero: bool = False
    #: Seconds without a frame or a change of the angle, after which a device counts as stalled.
    stall_s: float = 2.0


@dataclass(frozen=True)
class Progress:
    """What a session shows of itself while it runs."""

    angle_rad: float
    done: float
    total: float
    frames: int
    frames_per_s: float
    dropped: int
    failed_poses: int
    backlog_bytes: int
    left_s: float | None


@dataclass(frozen=True)
class Missed:
    """A pose that could not be taken, and why."""

    angle_rad: float
    why: str


@dataclass
class Recorded:
    """What came of a session. ``error`` ended it early; what was taken until then is in the scan."""

    scan: ScanSummary | None = None
    frames: int = 0
    dropped: int = 0
    missed: list[Missed] = field(default_factory=list)
    retried: int = 0
    interrupted: bool = False
    error: TurnscanError | None = None
    #: Devices that could not be put to rest: the user must know.
    unsafe: list[str] = field(default_factory=list)
    #: Where the unsealed log lies, if it could not be sealed.
    part: Path | None = None


class Beside(Protocol):
    """What runs beside a recording and reads its log: see process/live.py. It never raises."""

    def begin(self, part: Path) -> None:
        """Start following the growing log."""

    def ready(self) -> None:
        """Wait until it can keep up with the camera."""

    def finish(self) -> tuple[Any, str] | None:
        """The log is whole: its facts and SHA-256 (None if that failed)."""

    def stop(self) -> None:
        """End at once."""


@dataclass(frozen=True)
class Begun:
    """What is known of a scan when its recording begins; ``calibration`` is the id of one."""

    scan: str
    rig: str
    started_ns: int
    calibration: str | None
    camera_id: str
    camera: CameraInfo


MakeBeside = Callable[[Begun], Beside | None]
Show = Callable[[Progress], None]


class Truth(Protocol):
    """What a simulated camera puts into :attr:`..devices.contracts.Shot.truth`."""

    def events(self, *, t_ns: int, frame: int, camera: str = "0") -> Sequence[LogEvent]:
        """The /truth messages of the frame."""
