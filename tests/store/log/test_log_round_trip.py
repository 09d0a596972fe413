"""What is written is read back, by our reader and by the mcap package's own, CRCs on."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logs import images, write_log
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from turnscan.schemas.channels import TOPICS, topic_of
from turnscan.schemas.errors import ConflictError, InputError
from turnscan.schemas.events import CalibrationSnapshot, Exposure, ScanEnd, TurntableAngle
from turnscan.store.log_digest import digest_log
from turnscan.store.log_reader import LogFrame, ScanLog
from turnscan.store.log_writer import LogWriter


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    height=st.integers(1, 20),
    width=st.integers(1, 20),
    kind=st.sampled_from(["u1", "u2", ">u2", "bgr"]),
    count=st.integers(1, 6),
    chunk_bytes=st.sampled_from([1, 200, 1 << 20]),
)
def test_frames_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory,
    height: int,
    width: int,
    kind: str,
    count: int,
    chunk_bytes: int,
) -> None:
    shape = (height, width, 3) if kind == "bgr" else (height, width)
    given_frames = images(count, shape, "u1" if kind == "bgr" else kind)
    path = write_log(
        tmp_path_factory.mktemp("log") / "scan.mcap", given_frames, chunk_bytes=chunk_bytes
    )
    frames = list(ScanLog(path).frames())
    assert [f.frame for f in frames] == list(range(count))
    for frame, image in zip(frames, given_frames, strict=True):
        assert np.array_equal(frame.decode(), image)
        assert frame.t_ns == 1001 + 10 * frame.frame
        assert frame.lasers_on == (0,)


def test_a_view_with_gaps_is_written_as_it_looks(tmp_path: Path) -> None:
    image = images(1, (10, 12))[0][::2, ::3]
    path = write_log(tmp_path / "scan.mcap", [image])
    assert np.array_equal(next(ScanLog(path).frames()).decode(), image)


def test_raw_frames_are_views_not_copies(tmp_path: Path) -> None:
    path = write_log(tmp_path / "scan.mcap", images(1))
    pixels = next(ScanLog(path).frames()).decode()
    assert not pixels.flags.owndata
    with pytest.raises(ValueError, match="read-only"):
        pixels[0, 0] = 1


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp"])
def test_imported_files_keep_their_bytes(tmp_path: Path, suffix: str) -> None:
    data = cv2.imencode(suffix, images(1, (20, 30))[0])[1].tobytes()
    path = tmp_path / "scan.mcap"
    encoding = {".jpg": "jpeg"}.get(suffix, suffix[1:])
    with LogWriter(path) as writer:
        exposure = Exposure(t_ns=5, frame=0, lasers_on=(), file=f"a{suffix}")
        writer.write_image(exposure, data=data, encoding=encoding)
    frame = next(ScanLog(path).frames())
    assert bytes(frame.image.data) == data
    assert frame.image.encoding == encoding
    assert frame.file == f"a{suffix}"
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(frame.decode(), decoded)


def test_events_come_typed_and_in_order(tmp_path: Path) -> None:
    path = write_log(tmp_path / "scan.mcap", images(2))
    kinds = [type(i).__name__ for i in ScanLog(path).items()]
    assert kinds == [
        *("ScanStart", "LaserState"),
        *("TurntableAngle", "Exposure", "LogFrame") * 2,
        "ScanEnd",
    ]
    angles = [i for i in ScanLog(path).items() if isinstance(i, TurntableAngle)]
    assert [a.commanded_rad for a in angles] == [0.0, 0.01]
    assert ScanLog(path).start().rig == "r"


@pytest.mark.parametrize("chunk_bytes", [1, 1 << 20])
def test_the_mcap_package_reads_our_logs_with_crcs_on(tmp_path: Path, chunk_bytes: int) -> None:
    frames = images(3, (16, 16))
    path = write_log(tmp_path / "scan.mcap", frames, chunk_bytes=chunk_bytes)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        assert header.profile == "turnscan"
        assert header.library.startswith("turnscan ")
        assert summary is not None
        assert summary.statistics is not None
        found = list(reader.iter_messages())
        assert summary.statistics.message_count == len(found) == 12
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        for schema, channel, message in found:
            known = topic_of(channel.topic)
            assert known is not None
            assert schema is not None
            assert schema.name in known.schemas
            if channel.message_encoding == "json":
                assert json.loads(message.data)["t_ns"] == message.log_time
    with path.open("rb") as file:
        assert len(list(StreamReader(file, validate_crcs=True).records)) > 12


def test_foxglove_reads_our_protobuf(tmp_path: Path) -> None:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    from turnscan.schemas.calibration import Calibration, Intrinsics, TurntableAxis

    image = images(1, (5, 7), "u2")[0]
    calibration = Calibration(
        rig="r",
        camera=Intrinsics(
            width_px=7,
            height_px=5,
            fx_px=9,
            fy_px=8,
            cx_px=3,
            cy_px=2,
            skew=0.5,
            distortion=(1, 2, 3, 4, 5),
        ),
        turntable=TurntableAxis(point_mm=(10, 20, 300), direction=(0, -1, 0)),
    )
    path = tmp_path / "scan.mcap"
    with LogWriter(path) as writer:
        writer.write_calibration(calibration, 7)
        writer.write_image(Exposure(t_ns=2_000_000_003, frame=0, lasers_on=(0,)), image)
    messages = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            messages[channel.topic] = message.data
            assert schema is not None
            if schema.encoding == "protobuf":
                assert FileDescriptorSet.FromString(schema.data).file
    raw = RawImage.FromString(messages["/camera/0/image"])
    assert (raw.width, raw.height, raw.step, raw.encoding) == (7, 5, 14, "mono16")
    assert (raw.timestamp.seconds, raw.timestamp.nanos) == (2, 3)
    assert raw.data == image.tobytes()
    camera = CameraCalibration.FromString(messages["/camera/0/calibration"])
    assert list(camera.D) == [1, 2, 3, 4, 5]
    assert list(camera.K) == [9, 4.5, 3, 0, 8, 2, 0, 0, 1]
    transform = FrameTransform.FromString(messages["/tf"])
    assert (transform.translation.x, transform.translation.z) == (0.01, 0.3)
    q = transform.rotation
    # z of turntable space is -Y of the camera: a quarter turn about X.
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0.5**0.5, 0, 0, 0.5**0.5))
    snapshot = [i for i in ScanLog(path).items() if isinstance(i, CalibrationSnapshot)]
    assert snapshot[0].calibration == calibration.calibration_id()


def test_schemas_and_channels_stand_in_each_chunk(tmp_path: Path) -> None:
    from mcap.records import Channel, Chunk, Schema
    from mcap.stream_reader import breakup_chunk

    path = write_log(tmp_path / "scan.mcap", images(3), chunk_bytes=1)
    with path.open("rb") as file:
        chunks = [
            r
            for r in StreamReader(file, emit_chunks=True, validate_crcs=True).records
            if isinstance(r, Chunk)
        ]
    assert len(chunks) == 12
    for chunk in chunks:
        kinds = [type(r) for r in breakup_chunk(chunk, validate_crc=True)]
        assert kinds[:2] == [Schema, Channel]
        assert chunk.compression == "zstd"


def test_time_never_steps_back(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a") as writer:
        writer.write_event(TurntableAngle(t_ns=10, commanded_rad=0))
        with pytest.raises(InputError, match="at t_ns 9 comes after 10"):
            writer.write_event(TurntableAngle(t_ns=9, commanded_rad=0))


def test_a_log_is_never_written_over(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a", images(1))
    before = path.read_bytes()
    with pytest.raises(ConflictError, match="exists already"):
        LogWriter(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((2, 2)),
        np.zeros((2, 2, 4), np.uint8),
        np.zeros((0, 3), np.uint8),
        np.zeros(4, np.uint8),
    ],
)
def test_images_that_no_channel_can_hold_are_refused(tmp_path: Path, image: np.ndarray) -> None:
    with (
        LogWriter(tmp_path / "a") as writer,
        pytest.raises(InputError, match="frame 3: an image of shape"),
    ):
        writer.write_image(Exposure(t_ns=1, frame=3, lasers_on=()), image)


def test_nothing_is_added_after_the_end(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a") as writer:
        writer.finish()
        with pytest.raises(InputError, match="is finished"):
            writer.write_event(ScanEnd(t_ns=1, ended="complete", frames=0))


def test_digests_cover_content_and_not_chunks(tmp_path: Path) -> None:
    frames = images(3)
    a = digest_log(ScanLog(write_log(tmp_path / "a", frames, chunk_bytes=1)))
    b = digest_log(ScanLog(write_log(tmp_path / "b", frames)))
    assert a == b
    changed = [f.copy() for f in frames]
    changed[1][0, 0] ^= 1
    c = digest_log(ScanLog(write_log(tmp_path / "c", changed)))
    assert c.content_sha256 != a.content_sha256
    assert c.frames_sha256 != a.frames_sha256
    assert (a.frames, a.width_px, a.height_px, a.ended) == (3, 6, 4, "complete")
    assert (a.angle_min_rad, a.angle_max_rad) == (0.0, 0.02)


def test_a_log_without_frames_is_no_scan(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no frame"):
        digest_log(ScanLog(write_log(tmp_path / "a", [])))


def test_every_topic_has_a_schema_that_both_sides_know() -> None:
    from turnscan.schemas.channels import schema_bytes

    for topic in TOPICS.values():
        for name in topic.schemas:
            encoding, data = schema_bytes(name)
            assert data
            assert encoding == ("protobuf" if topic.event is None else "jsonschema")


def test_frames_know_their_log(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a", images(1))
    frame = next(ScanLog(path).frames())
    assert isinstance(frame, LogFrame)
    assert frame.path == path
