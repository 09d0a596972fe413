"""State of an archive as a fold over its events: tags, labels, what is retired, what is certified.

Events are taken in the order of their ULIDs, except that one that names another in ``after`` counts
after it, whatever the clocks said.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ..schemas.archive_events import (
    AnyArchiveEvent,
    Certified,
    Restored,
    Retired,
    Tagged,
    Withdrawn,
)


@dataclass(frozen=True)
class ScanState:
    """What events say of a scan, on top of its summary."""

    label: str
    tags: dict[str, str]
    retired: bool


def in_order(events: Iterable[AnyArchiveEvent]) -> list[AnyArchiveEvent]:
    """Events by ULID, with each one after the event that it names in ``after``."""
    by_id = {e.id: e for e in events}
    done: dict[str, AnyArchiveEvent] = {}
    for start in sorted(by_id):
        # Walk back over predecessors first; a loop of `after` falls back to ULID order.
        chain: list[str] = []
        at: str | None = start
        while at is not None and at in by_id and at not in done and at not in chain:
            chain.append(at)
            at = by_id[at].after
        for name in reversed(chain):
            done[name] = by_id[name]
    return list(done.values())


def scan_states(
    events: Iterable[AnyArchiveEvent], recorded: dict[str, tuple[str, dict[str, str]]]
) -> dict[str, ScanState]:
    """Scan -> state; ``recorded`` gives each scan's label and tags as recorded."""
    labels = {scan: label for scan, (label, _) in recorded.items()}
    tags = {scan: dict(t) for scan, (_, t) in recorded.items()}
    retired: set[str] = set()
    for event in in_order(events):
        if isinstance(event, Tagged) and event.scan in tags:
            if event.label is not None:
                labels[event.scan] = event.label
            for key, value in event.tags.items():
                if value:
                    tags[event.scan][key] = value
                else:
                    tags[event.scan].pop(key, None)
        elif isinstance(event, Retired):
            retired.add(event.scan)
        elif isinstance(event, Restored):
            retired.discard(event.scan)
    return {s: ScanState(labels[s], tags[s], s in retired) for s in recorded}


def standing_certifications(events: Iterable[AnyArchiveEvent]) -> list[Certified]:
    """Certifications that were not withdrawn, oldest first."""
    ordered = in_order(events)
    withdrawn = {e.after for e in ordered if isinstance(e, Withdrawn)}
    return [e for e in ordered if isinstance(e, Certified) and e.id not in withdrawn]
