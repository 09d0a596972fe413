"""The scan log, against writing the same bytes plainly and against bare zstd."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard
from bench import best_cpu, frames, show, write_log, write_raw

from turnscan.store import log_chunk
from turnscan.store.log_reader import ScanLog

pytestmark = pytest.mark.benchmark

WIDTH, HEIGHT = 1280, 1024
ROUNDS = 20
CHUNK = 0x06


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """Forty frames, half of them distinct: 52 MB, more than caches hold."""
    return frames(20, WIDTH, HEIGHT) * 2


def chunks_of(path: Path) -> list[tuple[bytes, int]]:
    """(compressed bytes, size of the content) of every chunk in a log."""
    data, at, out = path.read_bytes(), 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == CHUNK:
            (size,) = struct.unpack_from("<Q", data, at + 9 + 16)
            (name,) = struct.unpack_from("<I", data, at + 9 + 28)
            (stored,) = struct.unpack_from("<Q", data, at + 9 + 32 + name)
            begin = at + 9 + 40 + name
            out.append((data[begin : begin + stored], size))
        at += 9 + length
    return out


def test_writing_against_the_same_raw_bytes(tmp_path: Path, images: list[np.ndarray]) -> None:
    path = tmp_path / "file"
    compressor = zstandard.ZstdCompressor(compression_params=log_chunk._PARAMETERS)

    def afresh() -> None:
        path.unlink(missing_ok=True)
        os.sync()

    took = best_cpu(
        {
            "raw": lambda: write_raw(path, images),
            "zstd": lambda: [compressor.compress(image.data.cast("B")) for image in images],
            "log": lambda: write_log(path, images),
        },
        ROUNDS,
        afresh,
    )
    each = 1e3 / len(images)
    print(f"\nlog of {WIDTH} x {HEIGHT} mono8; raw write {took['raw'] * each:.2f} ms a frame")
    show("write log / write raw bytes (both with fsync)", took["log"] / took["raw"], 5.0)
    show("  of which bare zstd of the pixels alone", took["zstd"] / took["raw"])
    show("  write log / bare zstd of the pixels", took["log"] / took["zstd"])
    size = path.stat().st_size / sum(image.nbytes for image in images)
    show("size of the log / size of the pixels", size, 0.43)
    assert size <= 0.43  # The size does not depend on the machine.


def test_reading_against_bare_decompression(tmp_path: Path, images: list[np.ndarray]) -> None:
    path = tmp_path / "log"
    write_log(path, images)
    chunks = chunks_of(path)

    def bare() -> None:
        decompressor = zstandard.ZstdDecompressor()
        for data, size in chunks:
            decompressor.decompress(data, max_output_size=size)

    def read() -> None:
        n = sum(frame.decode().size for frame in ScanLog(path).frames())
        assert n == sum(image.size for image in images)

    took = best_cpu({"bare": bare, "read": read}, ROUNDS)
    print(f"\nreading it; bare zstd {took['bare'] * 1e3 / len(images):.2f} ms a frame")
    show("frames() and decode, every CRC / bare decompression", took["read"] / took["bare"], 1.3)
