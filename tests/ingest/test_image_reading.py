"""One image file: what is accepted as it is, and what an archive must refuse."""

from __future__ import annotations

import os
import struct
import tempfile
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turnscan.ingest.image_reading import ImageFile, read_image
from turnscan.schemas.errors import InputError
from turnscan.store.log_reader import decode_image_file

from .images import encoded, oriented, pixels

PACKED = (cv2.IMWRITE_TIFF_COMPRESSION, 1)


def read(folder: Path, data: bytes, suffix: str) -> ImageFile:
    path = folder / f"image{suffix}"
    path.write_bytes(data)
    return read_image(path)


def refused(folder: Path, data: bytes, suffix: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(folder, data, suffix)
    assert f"image{suffix}" in caught.value.message
    assert caught.value.hint


# -- what is accepted -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("suffix", "channels", "dtype", "kind"),
    [
        (".png", 1, "uint8", "64 x 48, grey, 8 bit"),
        (".png", 3, "uint8", "64 x 48, colour, 8 bit"),
        (".png", 4, "uint8", "64 x 48, colour with alpha, 8 bit"),
        (".png", 1, "uint16", "64 x 48, grey, 16 bit"),
        (".png", 3, "uint16", "64 x 48, colour, 16 bit"),
        (".tif", 1, "uint8", "64 x 48, grey, 8 bit"),
        (".tiff", 3, "uint8", "64 x 48, colour, 8 bit"),
        (".TIF", 1, "uint16", "64 x 48, grey, 16 bit"),
        (".tiff", 3, "uint16", "64 x 48, colour, 16 bit"),
        (".bmp", 1, "uint8", "64 x 48, grey, 8 bit"),
        (".bmp", 3, "uint8", "64 x 48, colour, 8 bit"),
    ],
)
def test_lossless_formats(tmp_path: Path, suffix: str, channels: int, dtype: str, kind: str) -> None:
    image = pixels(channels=channels, dtype=dtype)
    data = encoded(image, suffix.lower())
    found = read(tmp_path, data, suffix)
    assert found.kind == kind
    assert found.data == data
    assert np.array_equal(decode_image_file(found.data, where=""), image)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize("restart", [0, 2])
def test_jpeg(tmp_path: Path, channels: int, progressive: int, restart: int) -> None:
    params = (cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_RST_INTERVAL, restart)
    data = encoded(pixels(channels=channels), ".jpg", *params)
    found = read(tmp_path, data, ".jpeg")
    assert (found.width_px, found.height_px, found.channels, found.encoding) == (
        64,
        48,
        channels,
        "jpeg",
    )


def test_flat_images_are_not_taken_for_cut_off(tmp_path: Path) -> None:
    """The fewest bytes that an image can honestly have."""
    for shape in ((2000, 3000), (2000, 3000, 3)):
        for suffix, params in (
            (".jpg", (cv2.IMWRITE_JPEG_QUALITY, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1)),
            (".jpg", (cv2.IMWRITE_JPEG_QUALITY, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
            (".png", (cv2.IMWRITE_PNG_COMPRESSION, 9)),
        ):
            assert read(tmp_path, encoded(np.zeros(shape, np.uint8), suffix, *params), suffix)


def test_what_stands_after_the_end_is_kept(tmp_path: Path) -> None:
    """Some cameras append previews or serial numbers."""
    for suffix in (".jpg", ".png", ".bmp"):
        data = encoded(pixels(), suffix) + b"serial 1234"
        assert read(tmp_path, data, suffix).data == data


def test_content_says_what_the_format_is(tmp_path: Path) -> None:
    assert read(tmp_path, encoded(pixels(), ".jpg"), ".png").encoding == "jpeg"
    assert read(tmp_path, encoded(pixels(), ".tiff"), ".bmp").encoding == "tiff"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_tags_are_ignored(tmp_path: Path, orientation: int) -> None:
    plain = encoded(pixels(channels=3), ".jpg")
    turned = oriented(plain, orientation)
    # The tag is a real one: who asks OpenCV to heed it gets another picture.
    heeded = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)
    stored = decode_image_file(plain, where="")
    assert np.array_equal(heeded, stored) == (orientation == 1)
    found = read(tmp_path, turned, ".jpg")
    assert (found.width_px, found.height_px) == (64, 48)
    assert found.data == turned
    assert np.array_equal(decode_image_file(found.data, where=""), stored)


def bmp(image: np.ndarray, *, height: int, old_head: bool = False) -> bytes:
    """A 24 bit BMP by hand: rows from the bottom, or from the top where height is below zero."""
    rows = image if height < 0 else image[::-1]
    body = b"".join(r.tobytes() + b"\0" * (-r.nbytes % 4) for r in rows)
    if old_head:
        head = struct.pack("<IHHHH", 12, image.shape[1], height, 1, 24)
    else:
        head = struct.pack("<IiiHHIIiiII", 40, image.shape[1], height, 1, 24, 0, 0, 0, 0, 0, 0)
    offset = 14 + len(head)
    return b"BM" + struct.pack("<IHHI", offset + len(body), 0, 0, offset) + head + body


def test_bmp_from_the_top_and_of_the_old_kind(tmp_path: Path) -> None:
    image = pixels(channels=3)[:, :61]
    for data in (bmp(image, height=-48), bmp(image, height=48)):
        assert read(tmp_path, data, ".bmp").kind == "61 x 48, colour, 8 bit"
        assert np.array_equal(decode_image_file(data, where=""), image)
        refused(tmp_path, data[:-1], ".bmp", "cut off")
    old = bmp(image, height=48, old_head=True)
    assert read(tmp_path, old, ".bmp").data == old
    refused(tmp_path, old[:-1], ".bmp", "cut off")


def test_all_real_photographs_are_accepted(test_data: Path) -> None:
    photographs = [
        *sorted((test_data / "srv_turntable" / "scan").glob("*.jpg"))[::8],
        *sorted((test_data / "opencv_left").glob("*.jpg")),
        *sorted((test_data / "ciclop").rglob("*.[jp][pn]g"))[::3],
        *sorted((test_data / "etna").glob("*.png"))[:2],
    ]
    assert len(photographs) > 30
    for path in photographs:
        found = read_image(path)
        assert found.data == path.read_bytes()


@pytest.mark.slow
def test_every_real_frame_is_accepted_and_refused_when_cut(test_data: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for path in sorted((test_data / "srv_turntable" / "scan").glob("*.jpg")):
        data = read_image(path).data
        for at in rng.integers(3, len(data) - 2, 10):
            refused(tmp_path, data[:at], ".jpg", "cut off")


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_cut_anywhere_is_refused(tmp_path: Path, progressive: int) -> None:
    data = oriented(encoded(pixels(), ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, progressive), 6)
    for at in range(3, len(data), 7):
        refused(tmp_path, data[:at], ".jpg", "cut off")
    refused(tmp_path, data[:-1], ".jpg", "cut off")


def test_a_real_jpeg_cut_anywhere_is_refused(tmp_path: Path, test_data: Path) -> None:
    for name in ("opencv_left/left01.jpg", "ciclop/calibration/frame0.jpg"):
        data = (test_data / name).read_bytes()
        for at in np.linspace(3, len(data) - 1, 60).astype(int):
            refused(tmp_path, data[:at], ".jpg", "cut off")


def test_a_jpeg_whose_end_was_never_written_is_refused(tmp_path: Path) -> None:
    """A file of the right size with zeros at its end, as a pulled memory card leaves it."""
    data = encoded(pixels(), ".jpg")
    refused(tmp_path, data[:1500] + bytes(len(data) - 1500), ".jpg", "cut off")


def test_a_jpeg_with_a_preview_inside_is_not_taken_for_whole(tmp_path: Path) -> None:
    """The preview's end marker is not the picture's."""
    data, preview = encoded(pixels(), ".jpg"), encoded(pixels()[:8, :8], ".jpg")
    body = b"Exif\0\0" + preview
    both = data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
    assert read(tmp_path, both, ".jpg").data == both
    refused(tmp_path, both[: len(both) - 400], ".jpg", "cut off")


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize(
    ("suffix", "params"),
    [(".png", ()), (".bmp", ()), (".tiff", ()), (".tiff", PACKED)],
)
def test_lossless_files_cut_anywhere_are_refused(
    tmp_path: Path, suffix: str, params: tuple[int, ...], dtype: str
) -> None:
    if suffix == ".bmp" and dtype == "uint16":
        dtype = "uint8"
    data = encoded(pixels(dtype=dtype), suffix, *params)
    for at in [*range(9, 60), *range(61, len(data), 97), len(data) - 1]:
        refused(tmp_path, data[:at], suffix, r"cut off|cannot be decoded")


def test_flipped_bits_in_a_png_are_refused(tmp_path: Path) -> None:
    data = encoded(pixels(), ".png")
    for at in range(41, len(data) - 12, 101):
        bad = bytearray(data)
        bad[at] ^= 4
        refused(tmp_path, bytes(bad), ".png", "cannot be decoded|cut off")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif"])
def test_what_is_no_image_is_refused(tmp_path: Path, suffix: str) -> None:
    name = {".jpg": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:].upper())
    refused(tmp_path, b"", suffix, "is empty")
    refused(tmp_path, b"<html>404</html>" * 50, suffix, f"is no {name} image")
    refused(tmp_path, bytes(5000), suffix, f"is no {name} image")


def test_several_pages_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "pages.tiff"
    assert cv2.imwritemulti(str(path), [pixels(0), pixels(1)])
    with pytest.raises(InputError, match=r"pages\.tiff: holds several pages"):
        read_image(path)


def test_other_depths_are_refused(tmp_path: Path) -> None:
    data = encoded(np.ones((8, 8), np.float32), ".tiff")
    refused(tmp_path, data, ".tiff", "float32, expected 8 or 16 bit")


# -- heads that lie -------------------------------------------------------------------------------


def png(width: int, height: int, rows: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg_claiming(width: int, height: int) -> bytes:
    data = bytearray(encoded(pixels(), ".jpg"))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def test_absurd_sizes_are_refused_at_once(tmp_path: Path) -> None:
    honest = tmp_path / "honest.png"
    honest.write_bytes(encoded(np.zeros((4000, 4000, 3), np.uint8), ".png"))
    begun = time.process_time()
    assert read_image(honest).width_px == 4000
    decoding = time.process_time() - begun
    begun = time.process_time()
    absurd = "its head says 60000 x 60000 pixels, more than"
    refused(tmp_path, png(60_000, 60_000, zlib.compress(bytes(10**6))), ".png", absurd)
    refused(tmp_path, jpeg_claiming(60_000, 60_000), ".jpg", "cut off")
    refused(tmp_path, jpeg_claiming(8_000, 8_000), ".jpg", "cut off")
    refused(tmp_path, bmp(pixels(channels=3), height=2**31 - 1), ".bmp", "cut off")
    tiff = encoded(pixels(), ".tiff")
    width = struct.pack("<HHI", 256, 3, 1)
    at = tiff.index(width)
    lie = tiff[:at] + struct.pack("<HHII", 256, 4, 1, 2**31) + tiff[at + 12 :]
    refused(tmp_path, lie, ".tiff", "its head says 2147483648 x 48 pixels")
    refused(tmp_path, png(64, 0, b""), ".png", "cannot be decoded")
    # The smallest of these claims has four times the pixels.
    assert time.process_time() - begun < 4 * decoding


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from([".jpg", ".png", ".bmp", ".tiff"]),
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=4),
    st.booleans(),
)
def test_any_damage_is_an_error_or_an_image(
    suffix: str, changes: list[tuple[int, int]], in_head: bool
) -> None:
    """Never a crash: the walkers read only what is there."""
    data = bytearray(encoded(pixels(), suffix))
    for at, value in changes:
        data[at % (60 if in_head else len(data))] = value
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = read(Path(folder), bytes(data), suffix)
        except InputError as error:
            assert f"image{suffix}" in error.message
        else:
            shape = decode_image_file(bytes(data), where="").shape
            assert (found.height_px, found.width_px) == shape[:2]


# -- files that cannot be read --------------------------------------------------------------------


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.png: cannot be read \(No such file"):
        read_image(tmp_path / "gone.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match=r"folder\.png: cannot be read \(Is a directory"):
        read_image(tmp_path / "folder.png")


def test_a_file_without_permission() -> None:
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        path = Path(name) / "secret.png"
        path.write_bytes(encoded(pixels(), ".png"))
        path.chmod(0)
        root = os.geteuid() == 0
        if root:
            os.seteuid(65534)
        try:
            with pytest.raises(InputError, match=r"secret\.png: cannot be read \(Permission denied\)"):
                read_image(path)
        finally:
            if root:
                os.seteuid(0)
