"""Recordings as processes: begun, watched and looked at from outside."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import polars as pl
from console import Console, surroundings

from turnscan.store import Archive


def archive_of(console: Console) -> Archive:
    assert console.archive is not None
    return Archive.open(console.archive)


def points_of(archive: Archive, scans: list[str]) -> pl.DataFrame:
    """Points of some logs as one table, without what differs from one recording to the next."""
    marks = ", ".join(f"'{s}'" for s in scans)
    table = archive.points(where=f"scan IN ({marks})").collect()
    columns = ["angle_rad", "laser", "row", "u_px", "x_mm", "y_mm", "z_mm", "amplitude_dn"]
    return table.select(columns).sort(["angle_rad", "laser", "row"])


def begin(console: Console, *words: object) -> subprocess.Popen[str]:
    """A recording in a process and group of its own."""
    return subprocess.Popen(
        console.command("record", *words),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        cwd=console.cwd,
        env=surroundings(),
        start_new_session=True,
    )


def growing(archive: Path) -> list[Path]:
    """Logs that are neither sealed nor salvaged."""
    parts = (archive / "scans").glob("*/scan.mcap.part")
    return sorted(p for p in parts if not p.with_name("salvaged.txt").exists())


def wait_for_frames(archive: Path, count: int, process: subprocess.Popen[str]) -> Path:
    """The growing log, once it holds so many frames."""
    until = time.monotonic() + 60
    while time.monotonic() < until and process.poll() is None:
        for part in growing(archive):
            if frames_on_disk(part.read_bytes()) >= count:
                return part
        time.sleep(0.01)
    raise AssertionError(process.communicate())


def frames_on_disk(part: bytes) -> int:
    """Frames in the whole chunks of a log that was cut off, counted by the format's rules alone."""
    import struct

    import zstandard

    at, frames = 8, 0
    image: set[int] = set()
    while at + 9 <= len(part):
        opcode, length = struct.unpack_from("<BQ", part, at)
        if at + 9 + length > len(part):
            break
        if opcode == 0x06:
            (size,) = struct.unpack_from("<Q", part, at + 9 + 16)
            (name,) = struct.unpack_from("<I", part, at + 9 + 28)
            (stored,) = struct.unpack_from("<Q", part, at + 9 + 32 + name)
            data = part[at + 9 + 40 + name :][:stored]
            inner = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
            i = 0
            while i < len(inner):
                kind, n = struct.unpack_from("<BQ", inner, i)
                (channel,) = struct.unpack_from("<H", inner, i + 9)
                if kind == 0x04 and b"/image" in inner[i : i + 9 + n]:
                    image.add(channel)
                frames += kind == 0x05 and channel in image
                i += 9 + n
        at += 9 + length
    return frames
