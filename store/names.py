"""What the user may call a scan or a calibration, and what to say if that fits none or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..schemas.errors import NotFoundError

_SHOWN = 5


def scan_word(word: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The row that ``word`` names: an id, a label, a unique prefix (s- may be left out), ``latest``."""
    if word == "latest":
        living = [r for r in rows if not r["retired"]]
        if not living:
            raise NotFoundError("the archive holds no scan", hint="turnscan import images --help")
        return max(living, key=lambda r: str(r["scan"]))
    prefixes = (word, f"s-{word.upper()}")
    for found in (
        [r for r in rows if r["scan"] == word],
        [r for r in rows if word and r["label"] == word],
        [r for r in rows if word and r["scan"].startswith(prefixes)],
    ):
        if len(found) == 1:
            return found[0]
        # A label is shared by the logs of a scan that was resumed: its first one stands for it.
        if found and {r["scan"] for r in found} <= set(chain_of(found[0]["scan"], rows)):
            return min(found, key=lambda r: str(r["scan"]))
        if found:
            raise _several("scan", word, [r["scan"] for r in found])
    raise NotFoundError(f"no scan {word!r}", hint="turnscan scan list shows all")


def chain_of(scan: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Ids of the logs that ``scan`` continues, itself, and those that continue it, oldest first.

    ``rows`` have ``scan`` and ``continues``. A log that two others continue leads to both.
    """
    before = {str(r["scan"]): r["continues"] for r in rows if r["continues"]}
    first = scan
    seen = {scan}
    while before.get(first) and before[first] not in seen:
        first = str(before[first])
        seen.add(first)
    known = {str(r["scan"]) for r in rows}
    after: dict[str, list[str]] = {}
    for name, earlier in before.items():
        after.setdefault(str(earlier), []).append(name)
    out: list[str] = []
    waiting = [first]
    while waiting:
        name = waiting.pop(0)
        if name not in out:
            out.append(name)
            waiting += sorted(after.get(name, []))
    return [n for n in out if n in known]


def calibration_word(word: str, rows: Sequence[dict[str, Any]]) -> str:
    """The id that ``word`` names: an id or a unique prefix (c- may be left out)."""
    names = [str(r["calibration"]) for r in rows]
    found = [n for n in names if n == word] or [
        n for n in names if word and (n.startswith((word, f"c-{word}")))
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise _several("calibration", word, found)
    raise NotFoundError(
        f"no calibration {word!r} in the archive",
        hint="turnscan calibration list shows all; turnscan calibration add FILE adds one",
    )


def _several(what: str, word: str, found: list[str]) -> NotFoundError:
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return NotFoundError(
        f"{word!r} fits {len(found)} {what}s: {', '.join(found[:_SHOWN])}{more}",
        hint="give more of the id",
    )
