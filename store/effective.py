"""Which calibration holds for a scan: one that is named, the recorded one, or the current one.

``current`` is the newest certification of the scan's rig that covers the scan's start and was not
withdrawn, else the snapshot in the log. ``recorded`` is that snapshot.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..schemas.archive_events import Certified
from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError
from ..schemas.manifests import ScanSummary


@dataclass(frozen=True)
class Effective:
    """A calibration and why it is the one."""

    calibration: Calibration
    why: str


def certified_for(scan: ScanSummary, standing: list[Certified]) -> Certified | None:
    """The newest of ``standing`` (oldest first) that holds for the rig at the scan's start."""
    fitting = [e for e in standing if e.rig == scan.rig and e.covers(scan.started_ns)]
    return fitting[-1] if fitting else None


def none_holds(scan: ScanSummary, choice: str) -> CalibrationError:
    """The error for a scan that no calibration holds for."""
    if choice == "recorded":
        return CalibrationError(
            f"scan {scan.scan} was recorded without a calibration",
            hint="use --calibration current or name one (turnscan calibration list)",
        )
    return CalibrationError(
        f"no calibration holds for scan {scan.scan} of rig {scan.rig!r}",
        hint=f"turnscan calibration add FILE --certify --rig {scan.rig}, or process --calibration ID",
    )
