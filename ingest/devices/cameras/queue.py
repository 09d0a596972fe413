"""Shots that wait for a slow reader: bounded, the oldest goes first, and the next one says so."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Final

from ..contracts import CameraInfo, Shot

_MOST_BYTES: Final = 128 << 20
_LEAST: Final = 4


class ShotQueue:
    """Shots taken since ``from_ns``. Not guarded: whoever shares it holds a lock."""

    def __init__(self, info: CameraInfo, from_ns: int) -> None:
        pixel_bytes = {"mono8": 1, "mono16": 2, "bgr8": 3}[info.encoding]
        self._most = max(_LEAST, _MOST_BYTES // (info.width_px * info.height_px * pixel_bytes))
        self._from_ns = from_ns
        self._shots: deque[Shot] = deque()
        self._lost = 0

    def lose(self, count: int) -> None:
        """Frames that never came or cannot be used; told by the next shot."""
        self._lost += count

    def push(self, shot: Shot) -> None:
        """Keep a shot, unless it was taken before the queue began."""
        if shot.t_ns < self._from_ns:
            self._lost = 0
            return
        lost, self._lost = self._lost, 0
        self._shots.append(replace(shot, dropped=lost))
        if len(self._shots) > self._most:
            gone, following = self._shots.popleft(), self._shots.popleft()
            self._shots.appendleft(replace(following, dropped=following.dropped + gone.dropped + 1))

    def pop(self) -> Shot | None:
        """The oldest shot; None if there is none yet."""
        return self._shots.popleft() if self._shots else None
