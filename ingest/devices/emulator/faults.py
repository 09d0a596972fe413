"""Which command lines of an emulated controller go wrong, and how."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from ....schemas.rig import Fault, FaultKind


@dataclass
class Command:
    """One command line (or real-time byte) as the firmware hears it, with what goes wrong with it."""

    text: str
    #: "move", "laser", "motor", "status", or "other": what rig files select faults by.
    sort: str
    faults: tuple[Fault, ...] = field(default=())

    def fault(self, kind: FaultKind) -> Fault | None:
        """The fault of this kind that hits this command."""
        return next((f for f in self.faults if f.kind == kind), None)


class FaultPlan:
    """Counts commands and picks the faults that hit each."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self.faults = faults
        self._seen: Counter[str] = Counter()
        #: Faults that have hit something, in order: for tests and for the log.
        self.struck: list[tuple[Fault, str]] = []

    def meet(self, command: Command) -> None:
        """Count ``command`` and note on it what goes wrong."""
        self._seen["any"] += 1
        self._seen[command.sort] += 1
        hit = tuple(f for f in self.faults if self._hits(f, command))
        command.faults = hit
        self.struck += [(f, command.text) for f in hit]

    def _hits(self, fault: Fault, command: Command) -> bool:
        on = "move" if fault.kind in ("stall", "missed-steps") else fault.on
        if on not in ("any", command.sort):
            return False
        return fault.at <= self._seen[on] < fault.at + fault.count
