"""The timeline of ``calibration list``: a line of text a certification, or a picture of them all."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .output import counted
from .places import show_time

if TYPE_CHECKING:
    from ..store.timeline import Entry

_WIDTH = 48
_DAY_NS = 86_400_000_000_000


def entry_row(entry: Entry) -> dict[str, Any]:
    """One certification as data."""
    event = entry.certified
    row: dict[str, Any] = {
        "rig": event.rig,
        "calibration": event.calibration,
        "from": show_time(event.from_ns) if event.from_ns is not None else None,
        "to": show_time(event.to_ns) if event.to_ns is not None else None,
        "from_ns": event.from_ns,
        "to_ns": event.to_ns,
        "state": entry.state,
        "effective": [list(r) for r in entry.effective],
        "certified": show_time(event.t_ns),
        "event": event.id,
        "note": event.note,
    }
    if event.objections:
        row |= {"objections": list(event.objections), "reason": event.reason}
    if entry.withdrawn_ns is not None:
        row |= {"withdrawn": show_time(entry.withdrawn_ns), "withdrawn_note": entry.withdrawn_note}
    return row


def axis_of(entries: list[Entry], scans_ns: list[int]) -> tuple[int, int]:
    """The span of time that a timeline shows: every edge and scan, and some room for open ends."""
    edges = [t for e in entries for t in (e.certified.from_ns, e.certified.to_ns) if t is not None]
    moments = [*edges, *scans_ns] or [time.time_ns()]
    room = max((max(moments) - min(moments)) // 12, _DAY_NS)
    return min(moments) - room, max(moments) + room


def text_timeline(rig: str, entries: list[Entry], scans_ns: list[int]) -> str:
    """A few lines: ``=`` where a certification holds, ``-`` where a newer one does, ``x`` withdrawn."""
    begin, end = axis_of(entries, scans_ns)
    lines = [f"rig {rig}: {show_time(begin)[:10]} to {show_time(end)[:10]}"]
    for entry in entries:
        bar = _bar(entry, begin, end)
        event = entry.certified
        state = entry.state + (", forced" if event.objections else "")
        if entry.withdrawn_ns is not None:
            state += f" {show_time(entry.withdrawn_ns)[:10]}"
        ends = f"{show_time(event.from_ns)} .. {show_time(event.to_ns)}"
        lines.append(f"  {event.calibration}  {bar}  {ends}  {state}")
    if scans_ns:
        marks = [" "] * _WIDTH
        for t_ns in scans_ns:
            marks[_column(t_ns, begin, end)] = "^"
        lines.append(f"  {'scans':<14s}  {''.join(marks)}  {counted(len(scans_ns), 'scan')}")
    return "\n".join(lines) + "\n"


def _column(t_ns: int, begin: int, end: int) -> int:
    return min(_WIDTH - 1, max(0, (t_ns - begin) * _WIDTH // (end - begin)))


def _bar(entry: Entry, begin: int, end: int) -> str:
    cells = [" "] * _WIDTH
    event = entry.certified

    def fill(from_ns: int | None, to_ns: int | None, mark: str) -> None:
        first = 0 if from_ns is None else _column(from_ns, begin, end)
        # The end is no more part of the range, but a short one is still to be seen.
        last = _WIDTH - 1 if to_ns is None else max(first, _column(to_ns - 1, begin, end))
        for i in range(first, last + 1):
            cells[i] = mark

    fill(event.from_ns, event.to_ns, "x" if entry.state == "withdrawn" else "-")
    for some in entry.effective:
        fill(*some, "=")
    if event.from_ns is None:
        cells[0] = "<"
    if event.to_ns is None:
        cells[-1] = ">"
    return "".join(cells)


def draw_timelines(rigs: dict[str, tuple[list[Entry], list[int]]], out: Path) -> None:
    """Write a PNG with one band a rig: bars of certifications, dots for scans."""
    from .timeline_picture import draw

    draw(
        {rig: (entries, scans, axis_of(entries, scans)) for rig, (entries, scans) in rigs.items()}, out
    )
