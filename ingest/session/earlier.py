"""What the logs of a scan hold already, so that a recording can go on at what is missing."""

from __future__ import annotations

from collections.abc import Sequence

from ...schemas.document import validate
from ...schemas.errors import ConflictError
from ...schemas.events import Exposure, ScanStart, TurntableAngle
from ...schemas.manifests import ScanSummary
from ...schemas.rig import ScanSettings
from ...store import Archive
from ...store.log_reader import LogFrame
from .order import Earlier
from .plan import Taken


def read_earlier(archive: Archive, logs: Sequence[ScanSummary]) -> tuple[Earlier, ScanSettings]:
    """Frames and angles of ``logs`` (oldest first), and the plan that they follow.

    Raises
    ------
    ConflictError
        They were not recorded, so there is no plan to go on with.
    """
    taken: list[Taken] = []
    reached: dict[tuple[int, ...], float] = {}
    newest = -1
    plan: ScanSettings | None = None
    for summary in logs:
        commanded: float | None = None
        moving: TurntableAngle | None = None
        lit: tuple[int, ...] | None = None
        exposure: Exposure | None = None
        for item in archive.log(summary.scan).items():
            if isinstance(item, ScanStart):
                if item.plan is not None:
                    plan = validate(ScanSettings, item.plan, where=f"{summary.scan}: plan")
            elif isinstance(item, TurntableAngle):
                # Frames since a report of the turning table count when the next one has come.
                if moving is not None and lit is not None:
                    reached[lit] = _value(item)
                    lit = None
                moving = item if item.moving else None
                commanded = item.commanded_rad
            elif isinstance(item, Exposure):
                exposure = item
            elif isinstance(item, LogFrame):
                newest = max(newest, item.frame)
                if moving is not None:
                    lit = item.lasers_on
                elif commanded is not None:
                    taken.append(Taken(commanded, item.lasers_on, _exposure_us(exposure)))
    if plan is None:
        raise ConflictError(
            f"scan {logs[0].scan} was not recorded by turnscan record: it has no plan to go on with",
            hint="record a new scan",
        )
    last = logs[-1]
    earlier = Earlier(
        last.scan, tuple(taken), reached, newest + 1, width_px=last.width_px, height_px=last.height_px
    )
    return earlier, plan


def _value(angle: TurntableAngle) -> float:
    return angle.commanded_rad if angle.reported_rad is None else angle.reported_rad


def _exposure_us(exposure: Exposure | None) -> float | None:
    if exposure is None or exposure.exposure_ns is None:
        return None
    return exposure.exposure_ns / 1000
