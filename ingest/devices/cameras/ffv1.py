"""Checksums of FFV1 slices, which FFmpeg checks but does not tell: it shows older pixels instead.

RFC 9043, section 4.9: a frame is a row of slices; each ends with slice_size (24 bit, big-endian, not
counting this footer), error_status (8 bit) and slice_crc_parity (32 bit), chosen so that the CRC
(polynomial 0x04C11DB7, first bit highest, starting at 0) over the whole slice is 0.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from .opencv import open_video

if TYPE_CHECKING:
    import cv2

_FOOTER_BYTES: Final = 8
# zlib computes the same CRC with the bits of every byte, and of the sum, turned round.
_TURNED: Final = bytes(int(f"{b:08b}"[::-1], 2) for b in range(256))


def slices_sound(packet: bytes) -> bool:
    """Whether the slices of one FFV1 frame (version 3, ec = 1) fill it exactly, each with its CRC."""
    end = len(packet)
    while end > 0:
        if end < _FOOTER_BYTES:
            return False
        start = end - _FOOTER_BYTES - int.from_bytes(packet[end - 8 : end - 5], "big")
        if start < 0 or packet[end - 5] != 0:
            return False
        # Starting value and result are inverted by zlib: all ones stand for 0.
        if zlib.crc32(packet[start:end].translate(_TURNED), 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        end = start
    return len(packet) > 0


class SliceCheck:
    """Walks the packets of one FFV1 file beside its decoding."""

    def __init__(self, packets: cv2.VideoCapture) -> None:
        self._packets = packets

    @classmethod
    def of(cls, path: Path) -> Self | None:
        """A check of this file; None where its first frames bear no checksums (FFV1 with ec = 0)."""
        import cv2

        raw = [cv2.CAP_PROP_FORMAT, -1]
        trial = open_video(str(path), cv2.CAP_FFMPEG, raw)
        if trial is None:
            return None
        try:
            check = cls(trial)
            # One damaged frame at the beginning must not pass for a file without checksums.
            if not any(check.next_is_sound() for _ in range(5)):
                return None
        finally:
            trial.release()
        again = open_video(str(path), cv2.CAP_FFMPEG, raw)
        return None if again is None else cls(again)

    def next_is_sound(self) -> bool:
        """Whether the next packet is there and every slice in it has its checksum."""
        ok, packet = self._packets.read()
        return bool(ok) and slices_sound(packet.tobytes())

    def close(self) -> None:
        """Close the file."""
        self._packets.release()
