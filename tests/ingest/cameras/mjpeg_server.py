"""A real MJPEG server on the loopback, with faults that a test can switch while it runs.

Every frame carries the time at which it was "exposed" as 64 blocks of 8 x 8 pixels, which survive
JPEG, so that a test can tell how old a frame is whatever anybody stamped on it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]

WIDTH, HEIGHT = 128, 96
_BLOCK = 8


def marked(number: int, *, colour: bool, width: int = WIDTH, height: int = HEIGHT) -> Image:
    """A frame with ``number`` (64 bits) in its upper left blocks, and texture below them."""
    rows, columns = np.indices((height, width))
    image = (40 + 2 * rows + columns).clip(0, 255).astype(np.uint8)
    for bit in range(64):
        row, column = divmod(bit, 16)
        value = 255 if number >> bit & 1 else 0
        top, left = row * _BLOCK, column * _BLOCK
        image[top : top + _BLOCK, left : left + _BLOCK] = value
    if not colour:
        return image
    return np.dstack([image, image, image // 2 + 60]).astype(np.uint8)


def mark_of(image: npt.NDArray[np.generic]) -> int:
    """The number that :func:`marked` put there."""
    plane = image if image.ndim == 2 else image[..., 0]
    out = 0
    for bit in range(64):
        row, column = divmod(bit, 16)
        if plane[row * _BLOCK + 4, column * _BLOCK + 4] > 127:
            out |= 1 << bit
    return out


class _Handler(BaseHTTPRequestHandler):
    server: MjpegServer

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (its name there)
        """Silence."""

    def do_GET(self) -> None:
        with contextlib.suppress(ConnectionError, TimeoutError):
            self._answer()

    def _answer(self) -> None:
        server = self.server
        if server.fault == "mute":
            server.stopping.wait(30)
            return
        if server.fault == "404":
            self.send_error(404)
            return
        if server.fault == "page":
            body = b"<html><body>log in first</body></html>"
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        due = time.monotonic()
        queued: list[bytes] = []
        number = 0
        while not server.stopping.is_set():
            due += 1 / server.fps
            if server.stopping.wait(max(0.0, due - time.monotonic())):
                return
            number += 1
            fault = server.fault
            if fault == "hang-up":
                return
            if fault == "stall" or (fault == "drop" and number % 3):
                continue
            part = server.part(fault)
            if fault == "late":
                # The network holds everything back; then it all comes at once.
                queued.append(part)
                continue
            for data in (*queued, part):
                self.wfile.write(data)
            self.wfile.flush()
            queued.clear()


class MjpegServer(ThreadingHTTPServer):
    """Serves ``url`` from entering the context until leaving it.

    ``fault`` may be changed at any time: None, "stall", "drop" (two frames of three), "late" (held back
    until the fault ends, then all at once), "resize", "black", "hang-up", "truncate", "grey"; and for
    new connections "404", "page" (no stream at all), "mute" (accepts and says nothing).
    """

    daemon_threads = True
    block_on_close = True

    def __init__(self, *, fps: float = 60.0, colour: bool = False) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.fps = fps
        self.colour = colour
        self.fault: str | None = None
        self.stopping = threading.Event()
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02})

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/stream.mjpg"

    def part(self, fault: str | None) -> bytes:
        """One part of the multipart body: a JPEG of this moment."""
        size = (2 * WIDTH, 2 * HEIGHT) if fault == "resize" else (WIDTH, HEIGHT)
        colour = self.colour != (fault == "grey")
        image = marked(time.time_ns(), colour=colour, width=size[0], height=size[1])
        if fault == "black":
            image[:] = 0
        ok, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert ok
        data = bytes(encoded)
        if fault == "truncate":
            data = data[: len(data) // 2]
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
        return head.encode() + data + b"\r\n"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stopping.set()
        self.shutdown()
        self._thread.join()
        self.server_close()
