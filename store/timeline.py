"""Which calibration holds when: the certifications of an archive in time, withdrawn ones included.

Pure functions over events. All ranges are half-open, in ns; None is an open end.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from ..schemas.archive_events import AnyArchiveEvent, Certified, Withdrawn
from .fold import in_order, standing_certifications

Range = tuple[int | None, int | None]
State = Literal["holds", "holds in part", "replaced", "withdrawn"]


@dataclass(frozen=True)
class Entry:
    """One certification: what it claims, and for which times it is the one that holds.

    ``state``: ``holds`` for all of its range, ``holds in part``, ``replaced`` by newer ones altogether,
    or ``withdrawn`` (``withdrawn_note`` says why).
    """

    certified: Certified
    state: State
    effective: tuple[Range, ...]
    withdrawn_ns: int | None = None
    withdrawn_note: str = ""


def effective_ranges(standing: Sequence[Certified], rig: str) -> list[tuple[Range, Certified | None]]:
    """Consecutive ranges that cover all time, each with the certification that holds (or None).

    ``standing`` is in the order of events: the newest that covers a moment holds.
    """
    mine = [e for e in standing if e.rig == rig]
    edges = sorted({t for e in mine for t in (e.from_ns, e.to_ns) if t is not None})
    bounds: list[int | None] = [None, *edges, None]
    out: list[tuple[Range, Certified | None]] = []
    for begin, end in pairwise(bounds):
        # No edge lies inside, so any moment of the range stands for all of it.
        moment = begin if begin is not None else (end - 1 if end is not None else 0)
        holds = next((e for e in reversed(mine) if e.covers(moment)), None)
        if out and out[-1][1] is holds:
            out[-1] = ((out[-1][0][0], end), holds)
        else:
            out.append(((begin, end), holds))
    return out


def timeline(events: Iterable[AnyArchiveEvent]) -> dict[str, list[Entry]]:
    """Rig -> its certifications, in the order in which they were made."""
    ordered = in_order(events)
    standing = standing_certifications(ordered)
    taken_back = {e.after: e for e in ordered if isinstance(e, Withdrawn)}
    out: dict[str, list[Entry]] = {}
    certified = [e for e in ordered if isinstance(e, Certified)]
    for rig in sorted({e.rig for e in certified}):
        ranges = effective_ranges(standing, rig)
        out[rig] = []
        for event in certified:
            if event.rig != rig:
                continue
            back = taken_back.get(event.id)
            if back is not None:
                out[rig].append(Entry(event, "withdrawn", (), back.t_ns, back.note))
                continue
            mine = tuple(r for r, holds in ranges if holds is event)
            whole = mine == ((event.from_ns, event.to_ns),)
            state: State = "holds" if whole else "holds in part" if mine else "replaced"
            out[rig].append(Entry(event, state, mine))
    return out
