"""The form of a line of the ``turnscan`` protocol: sequence number, words, CRC-16.

``>0001 MOVE 1600*....`` is a request, ``<0001 OK*....`` its reply, ``!0000 READY ...*....`` an event
that nobody asked for. The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF, no reflection,
no final XOR; "123456789" gives 0x29B1), over all characters before the ``*``: see docs/controllers.md.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

PROTOCOL = 1
LONGEST = 120
RESET = "\x18"

_LINE = re.compile(r"^([><!])([0-9A-F]{4}) ([ -)+-~]{1,104})\*([0-9A-F]{4})$")


def crc16(text: str) -> int:
    """CRC-16/CCITT-FALSE of ASCII text."""
    crc = 0xFFFF
    for byte in text.encode("ascii"):
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


@dataclass(frozen=True)
class Line:
    """One good line: its mark (``>``, ``<`` or ``!``), number and words."""

    mark: str
    number: int
    words: tuple[str, ...]

    def text(self) -> str:
        """The line as it goes over the wire, without its end."""
        body = f"{self.mark}{self.number:04X} {' '.join(self.words)}"
        return f"{body}*{crc16(body):04X}"

    def values(self) -> dict[str, str]:
        """The words of the form ``name=value``."""
        return dict(w.split("=", 1) for w in self.words if "=" in w)


def parse_line(text: str) -> Line | None:
    """The line that ``text`` is, or None if it is damaged in any way."""
    match = _LINE.match(text)
    if match is None or len(text) > LONGEST:
        return None
    mark, number, body, crc = match.groups()
    if crc16(f"{mark}{number} {body}") != int(crc, 16):
        return None
    return Line(mark, int(number, 16), tuple(body.split()))
