"""A network camera against a real MJPEG server: the age of frames, and all ways in which it fails."""

from __future__ import annotations

import itertools
import re
import socket
import time
from collections.abc import Iterator

import pytest

from turnscan.ingest.devices.cameras.live import LiveCamera
from turnscan.ingest.devices.cameras.stream import StreamCapture
from turnscan.ingest.devices.cameras.watch import Limits
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.contracts import Camera
from turnscan.schemas.errors import DeviceError

from .mjpeg_server import HEIGHT, WIDTH, MjpegServer, mark_of

NOTICED_S = 2.0


@pytest.fixture
def server() -> Iterator[MjpegServer]:
    with MjpegServer() as running:
        yield running


@pytest.fixture
def camera(server: MjpegServer) -> Iterator[LiveCamera]:
    made = LiveCamera(StreamCapture(server.url), SystemClock())
    yield made
    made.close()


def fails_in_time(camera: Camera, *, stream: bool = False) -> DeviceError:
    """Ask for frames until the camera notices; it must, within two seconds from now."""
    clock = SystemClock()
    begun = time.monotonic()
    with pytest.raises(DeviceError) as caught:
        if stream:
            for _ in camera.stream():
                assert time.monotonic() - begun < NOTICED_S
        while time.monotonic() - begun < NOTICED_S:
            camera.shoot(clock.now_ns())
    assert time.monotonic() - begun < NOTICED_S
    assert caught.value.hint
    # It stays so, at once, however often one asks.
    again = time.monotonic()
    with pytest.raises(DeviceError):
        camera.shoot(clock.now_ns())
    assert time.monotonic() - again < NOTICED_S / 2
    return caught.value


def test_no_frame_is_older_than_asked(camera: LiveCamera) -> None:
    camera.open()
    clock = SystemClock()
    for pause_s in (0.0, 0.3, 0.01, 0.1):
        time.sleep(pause_s)
        asked_ns = clock.now_ns()
        exposed_ns = mark_of(camera.shoot(asked_ns).image)
        assert exposed_ns >= asked_ns


def test_frames_buffered_while_opening_are_not_given(server: MjpegServer) -> None:
    server.fps = 8
    camera = LiveCamera(StreamCapture(server.url), SystemClock())
    camera.open()
    asked_ns = time.time_ns()
    assert mark_of(camera.shoot(asked_ns).image) >= asked_ns
    camera.close()


@pytest.mark.parametrize("held_s", [0.2, 0.9])
def test_frames_held_back_by_the_network_are_not_given(
    server: MjpegServer, camera: LiveCamera, held_s: float
) -> None:
    # They come all at once: the newest one to arrive is old, and so are those behind it.
    camera.open()
    camera.shoot(time.time_ns())
    server.fault = "late"
    time.sleep(held_s)
    asked_ns = time.time_ns()
    server.fault = None
    assert mark_of(camera.shoot(asked_ns).image) >= asked_ns


def test_times_of_a_stream_are_right_even_after_a_hold(server: MjpegServer, camera: LiveCamera) -> None:
    camera.open()
    shots = camera.stream()
    list(itertools.islice(shots, 5))
    server.fault = "late"
    time.sleep(0.5)
    server.fault = None
    period_ns = 1e9 / server.fps
    for shot in itertools.islice(shots, 30):
        # Made by one clock, read by the other; never stamped more than two periods wrong.
        assert 0 <= shot.t_ns - mark_of(shot.image) < 2 * period_ns


def test_lossy_streams_are_counted(server: MjpegServer, camera: LiveCamera) -> None:
    camera.open()
    shots = camera.stream()
    list(itertools.islice(shots, 20))
    server.fault = "drop"
    time.sleep(0.3)
    server.fault = None
    after = list(itertools.islice(shots, 10))
    # Two of three frames were left out for 18 periods, and the third came out of rhythm.
    assert 10 <= sum(shot.dropped for shot in after) <= 30
    server.fault = None


def test_a_slow_reader_loses_the_oldest_and_is_told(server: MjpegServer, camera: LiveCamera) -> None:
    info = camera.open()
    shots = camera.stream()
    first = next(shots)
    assert camera._drain is not None
    assert camera._drain._queue is not None
    camera._drain._queue._most = 4
    time.sleep(0.5)
    taken = [first, *itertools.islice(shots, 10)]
    assert info.width_px == WIDTH
    assert taken[1].dropped > 10
    for before, after in itertools.pairwise(taken):
        # More only where the source itself came out of rhythm, as under load.
        assert after.dropped >= after.number - before.number - 1


@pytest.mark.parametrize(
    "stream", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["shoot", "stream"]
)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("stall", r"no frame for 1\.\d s"),
        ("drop", r"drops frames: \d\d\.\d a second now, \d\d\.\d at the beginning"),
        ("resize", rf"changed from {WIDTH} x {HEIGHT} mono8 to {2 * WIDTH} x {2 * HEIGHT} mono8"),
        ("grey", rf"changed from {WIDTH} x {HEIGHT} mono8 to {WIDTH} x {HEIGHT} bgr8"),
        ("black", r"turned black"),
        ("hang-up", r"ended: the other side hung up"),
        pytest.param(
            "truncate", r"sends broken JPEGs \(no whole one for 1\.\d s\)", marks=pytest.mark.slow
        ),
    ],
)
def test_faults_are_noticed_within_two_seconds(
    server: MjpegServer, camera: LiveCamera, fault: str, message: str, *, stream: bool
) -> None:
    camera.open()
    camera.shoot(time.time_ns())
    time.sleep(0.3)
    server.fault = fault
    error = fails_in_time(camera, stream=stream)
    assert server.url in error.message
    assert re.search(message, error.message), error.message
    # The camera is well again once it is opened again.
    server.fault = None
    camera.close()
    camera.open()
    camera.shoot(time.time_ns())


def test_faults_while_nobody_asks_are_told_at_the_next_question(
    server: MjpegServer, camera: LiveCamera
) -> None:
    camera.open()
    server.fault = "hang-up"
    time.sleep(0.3)
    begun = time.monotonic()
    with pytest.raises(DeviceError, match="hung up"):
        camera.shoot(time.time_ns())
    assert time.monotonic() - begun < NOTICED_S / 2


def test_dark_rooms_may_be_black(server: MjpegServer) -> None:
    lenient = LiveCamera(StreamCapture(server.url), SystemClock(), limits=Limits(black_s=None))
    strict = LiveCamera(StreamCapture(server.url), SystemClock(), limits=Limits(black_s=0.2))
    lenient.open()
    strict.open()
    strict.shoot(time.time_ns())
    server.fault = "black"
    time.sleep(0.4)
    # One black shot may be a frame without laser; with nothing bright in between, two are not.
    assert strict.shoot(time.time_ns()).image.max() <= 2
    with pytest.raises(DeviceError, match=r"turned black \(at most 2 DN for 0\.2 s\)"):
        strict.shoot(time.time_ns())
    for _ in range(3):
        assert lenient.shoot(time.time_ns()).image.max() <= 2
    lenient.close()
    strict.close()


def test_frames_without_laser_in_a_dark_room(server: MjpegServer) -> None:
    camera = LiveCamera(StreamCapture(server.url), SystemClock(), limits=Limits(black_s=0.2))
    camera.open()
    for _ in range(3):
        server.fault = "black"
        time.sleep(0.4)  # the table turns
        assert camera.shoot(time.time_ns()).image.max() <= 2
        server.fault = None
        assert camera.shoot(time.time_ns() + 100_000_000).image.max() > 100
    camera.close()


def test_an_error_once_told_stays_until_opened_again(server: MjpegServer) -> None:
    camera = LiveCamera(StreamCapture(server.url), SystemClock(), limits=Limits(stall_s=0.3))
    camera.open()
    camera.shoot(time.time_ns())
    server.fault = "stall"
    with pytest.raises(DeviceError, match="no frame for"):
        camera.shoot(time.time_ns() + 10**9)
    server.fault = None
    time.sleep(0.3)
    with pytest.raises(DeviceError, match="no frame for"):
        camera.shoot(time.time_ns())
    camera.open()
    camera.shoot(time.time_ns())
    camera.close()


def test_a_stream_that_never_was_bright_is_not_called_black(server: MjpegServer) -> None:
    server.fault = "black"
    camera = LiveCamera(StreamCapture(server.url), SystemClock(), limits=Limits(black_s=0.3))
    camera.open()
    time.sleep(0.6)
    camera.shoot(time.time_ns())
    camera.close()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("404", "answers 404"),
        ("page", "answers with text/html, not with a stream"),
        ("mute", "no answer within 0.5 s"),
    ],
)
def test_no_stream_at_the_address(server: MjpegServer, fault: str, message: str) -> None:
    server.fault = fault
    camera = LiveCamera(StreamCapture(server.url, open_s=0.5), SystemClock())
    with pytest.raises(DeviceError, match=message):
        camera.open()


def test_nobody_listens() -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
        with pytest.raises(DeviceError, match=r"cannot be reached.*refused"):
            StreamCapture(f"http://127.0.0.1:{port}/").open()


def test_a_password_in_the_address_is_not_told() -> None:
    capture = StreamCapture("http://me:secret@127.0.0.1:9/video?x=1")
    assert capture.name == "stream http://127.0.0.1:9/video?x=1"
    with pytest.raises(DeviceError) as caught:
        capture.open()
    assert "secret" not in caught.value.message


@pytest.mark.parametrize("url", ["rtsp://127.0.0.1/", "/etc/passwd", "file:///etc/passwd"])
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(DeviceError, match="not an address of an HTTP stream"):
        StreamCapture(url).open()


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"encoding": "bgr8"}, "encoding: asked bgr8, found mono8"),
        ({"encoding": "mono16"}, "encoding: asked mono16, found mono8"),
        ({"width_px": 640, "height_px": 480}, f"width_px: asked 640, found {WIDTH}"),
        ({"exposure_us": 5000.0}, "exposure_us: asked 5000, found nothing"),
        ({"gain": 2.0}, "gain: asked 2, found nothing"),
        ({"white_balance": 4000.0}, "white_balance: asked 4000, found nothing"),
    ],
)
def test_what_a_stream_cannot_do_is_refused(
    server: MjpegServer, asked: dict[str, object], message: str
) -> None:
    with pytest.raises(DeviceError, match=message):
        StreamCapture(server.url, **asked).open()  # type: ignore[arg-type]


def test_exposure_cannot_be_changed(camera: LiveCamera) -> None:
    camera.open()
    with pytest.raises(DeviceError, match="exposure_us: asked 2000, found nothing"):
        camera.shoot(time.time_ns(), exposure_us=2000.0)
    # Refusing is no failure of the source.
    camera.shoot(time.time_ns())


@pytest.mark.parametrize("asked_hz", [20.0, 200.0])
def test_another_rate_than_asked_is_measured(server: MjpegServer, asked_hz: float) -> None:
    camera = LiveCamera(StreamCapture(server.url), SystemClock(), fps=asked_hz)
    camera.open()
    begun = time.monotonic()
    with pytest.raises(DeviceError, match=rf"fps: asked {asked_hz:g}, found \d\d"):
        for _ in camera.stream():
            assert time.monotonic() - begun < NOTICED_S
    camera.close()
