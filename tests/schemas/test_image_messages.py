"""Our hand-written wire form is the one that the generated protobuf classes read and write."""

from __future__ import annotations

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st

from turnscan.schemas.errors import DamageError
from turnscan.schemas.image_messages import (
    COMPRESSED_IMAGE,
    ENCODINGS,
    RAW_IMAGE,
    compressed_image_head,
    decode_image,
    raw_image_head,
)

times = st.integers(0, 2**62)
cameras = st.text("abc-0", max_size=5)


@given(
    t_ns=times,
    camera=cameras,
    width=st.integers(1, 300),
    height=st.integers(1, 5),
    kind=st.sampled_from([*ENCODINGS]),
    pad=st.integers(0, 3),
)
def test_raw_images(t_ns: int, camera: str, width: int, height: int, kind: str, pad: int) -> None:
    size, channels = ENCODINGS[kind]
    step = width * size * channels + pad
    pixels = bytes(i % 251 for i in range(step * height))
    head = raw_image_head(
        t_ns=t_ns,
        camera=camera,
        width_px=width,
        height_px=height,
        encoding=kind,
        step=step,
        size=len(pixels),
    )
    theirs = RawImage.FromString(head + pixels)
    assert theirs.timestamp.ToNanoseconds() == t_ns
    assert (theirs.frame_id, theirs.encoding, theirs.data) == (camera, kind, pixels)
    assert (theirs.width, theirs.height, theirs.step) == (width, height, step)
    for message in (head + pixels, theirs.SerializeToString()):
        ours = decode_image(RAW_IMAGE, memoryview(message))
        assert (ours.t_ns, ours.camera, ours.encoding) == (t_ns, camera, kind)
        assert (ours.width_px, ours.height_px, ours.step) == (width, height, step)
        assert bytes(ours.data) == pixels


@given(t_ns=times, camera=cameras, data=st.binary(max_size=300))
def test_compressed_images(t_ns: int, camera: str, data: bytes) -> None:
    head = compressed_image_head(t_ns=t_ns, camera=camera, encoding="png", size=len(data))
    theirs = CompressedImage.FromString(head + data)
    assert theirs.timestamp.ToNanoseconds() == t_ns
    assert (theirs.frame_id, theirs.format, theirs.data) == (camera, "png", data)
    for message in (head + data, theirs.SerializeToString()):
        ours = decode_image(COMPRESSED_IMAGE, memoryview(message))
        assert (ours.t_ns, ours.camera, ours.encoding, bytes(ours.data)) == (t_ns, camera, "png", data)


@given(st.binary(max_size=60))
def test_garbage_is_damage_or_an_image_and_never_a_crash(data: bytes) -> None:
    for schema in (RAW_IMAGE, COMPRESSED_IMAGE):
        try:
            decode_image(schema, memoryview(data))
        except DamageError as error:
            assert "image message" in str(error)


def test_sizes_must_fit_the_pixels() -> None:
    head = raw_image_head(
        t_ns=0, camera="0", width_px=4, height_px=3, encoding="mono8", step=4, size=11
    )
    with pytest.raises(DamageError, match="4 x 3 mono8 with step 4 does not fit 11 bytes"):
        decode_image(RAW_IMAGE, memoryview(head + bytes(11)))
    with pytest.raises(DamageError, match="'rgba16' is not one of"):
        head = raw_image_head(
            t_ns=0, camera="0", width_px=1, height_px=1, encoding="rgba16", step=1, size=1
        )
        decode_image(RAW_IMAGE, memoryview(head + b"x"))
    with pytest.raises(DamageError, match="no image message that turnscan knows"):
        decode_image("foxglove.Log", memoryview(b""))
