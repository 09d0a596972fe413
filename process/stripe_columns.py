"""Stripe points of many frames, turned into columns of STRIPES in the table's own types.

Of each frame only its points are copied while it is at hand; the columns are made of all of them
together, since going to eleven columns anew takes longer than filling them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.tables import STRIPES
from .batches import BATCH_ROWS
from .extract import STRIPE_DTYPE

Points = npt.NDArray[Any]
Columns = dict[str, npt.NDArray[Any]]

#: A point as plain bytes: copied as such, not field by field.
_BYTES = np.dtype((np.void, STRIPE_DTYPE.itemsize))
#: What all points of a frame share.
_OF_FRAME = ("frame", "t_ns", "angle_rad")


class StripeColumns:
    """Room for :data:`BATCH_ROWS` stripe points, emptied into columns whenever it is full."""

    def __init__(self) -> None:
        self._points = np.empty(BATCH_ROWS, STRIPE_DTYPE)
        self._bytes = self._points.view(_BYTES)
        self._rows = 0
        #: Of every frame: how many of its points are held, frame, t_ns, angle_rad; and the lasers.
        self._frames: list[tuple[int, int, int, float]] = []
        self._lasers: list[int | npt.NDArray[Any]] = []

    def add(
        self, points: Points, *, frame: int, t_ns: int, angle_rad: float, laser: int | npt.NDArray[Any]
    ) -> list[Columns]:
        """Add the points of a frame, in the order of rows; returns the columns that became full."""
        full = []
        done, count = 0, len(points)
        while done < count:
            some = min(count - done, len(self._bytes) - self._rows)
            self._bytes[self._rows : self._rows + some] = points[done : done + some].view(_BYTES)
            self._rows += some
            self._frames.append((some, frame, t_ns, angle_rad))
            self._lasers.append(laser if isinstance(laser, int) else laser[done : done + some])
            done += some
            if self._rows == len(self._bytes):
                full += self.rest()
        return full

    def rest(self) -> list[Columns]:
        """What is held, if anything is; it begins anew."""
        if not self._rows:
            return []
        counts, *shared = zip(*self._frames, strict=True)
        of_frame = dict(zip(_OF_FRAME, shared, strict=True))
        lasers = self._lasers
        if all(isinstance(laser, int) for laser in lasers):
            of_frame["laser"] = tuple(lasers)
        made: Columns = {}
        for column in STRIPES.columns:
            if column.name in of_frame:
                made[column.name] = np.repeat(np.array(of_frame[column.name], column.type), counts)
            elif column.name == "laser":
                each = [np.broadcast_to(a, n) for a, n in zip(lasers, counts, strict=True)]
                made["laser"] = np.concatenate(each).astype(column.type)
            else:
                made[column.name] = np.empty(self._rows, column.type)
                made[column.name][:] = self._points[column.name][: self._rows]
        self._rows = 0
        self._frames.clear()
        self._lasers.clear()
        return [made]
