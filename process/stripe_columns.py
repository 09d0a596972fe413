"""Stripe points of many frames, filled into columns of STRIPES in the table's own types."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.tables import STRIPES
from .batches import BATCH_ROWS
from .compiled import kernel

Points = npt.NDArray[Any]
Columns = dict[str, npt.NDArray[Any]]


class StripeColumns:
    """Room for :data:`BATCH_ROWS` stripe points, made anew whenever it is full."""

    def __init__(self) -> None:
        self._rows = 0
        self._columns: Columns = {}

    def add(
        self, points: Points, *, frame: int, t_ns: int, angle_rad: float, laser: int | npt.NDArray[Any]
    ) -> list[Columns]:
        """Add the points of a frame, in the order of rows; returns the columns that became full."""
        full = []
        done = 0
        while done < len(points):
            if not self._columns:
                self._columns = {c.name: np.empty(BATCH_ROWS, c.type) for c in STRIPES.columns}
            c, at = self._columns, self._rows
            some = points[done : done + BATCH_ROWS - at]
            stop = at + len(some)
            one = laser if isinstance(laser, int) else 0
            _fill(some, at, frame, t_ns, one, angle_rad, *c.values())
            if not isinstance(laser, int):
                c["laser"][at:stop] = laser[done : done + len(some)]
            done += len(some)
            self._rows = stop
            if stop == BATCH_ROWS:
                full += self.rest()
        return full

    def rest(self) -> list[Columns]:
        """What is held, if anything is; it begins anew."""
        columns, rows = self._columns, self._rows
        self._columns, self._rows = {}, 0
        return [{name: column[:rows] for name, column in columns.items()}] if rows else []


@kernel
def _fill(
    points: Points,
    at: int,
    of_frame: int,
    of_time: int,
    of_laser: int,
    of_angle: float,
    frame: npt.NDArray[Any],
    t_ns: npt.NDArray[Any],
    laser: npt.NDArray[Any],
    angle_rad: npt.NDArray[Any],
    row: npt.NDArray[Any],
    u_px: npt.NDArray[Any],
    sigma_u_px: npt.NDArray[Any],
    amplitude_dn: npt.NDArray[Any],
    width_px: npt.NDArray[Any],
    background_dn: npt.NDArray[Any],
    flags: npt.NDArray[Any],
) -> None:
    """The points of one frame into the columns of STRIPES, from ``at`` on."""
    stop = at + len(points)
    frame[at:stop] = of_frame
    t_ns[at:stop] = of_time
    laser[at:stop] = of_laser
    angle_rad[at:stop] = of_angle
    for i in range(len(points)):
        point = points[i]
        row[at + i] = point.row
        u_px[at + i] = point.u_px
        sigma_u_px[at + i] = point.sigma_u_px
        amplitude_dn[at + i] = point.amplitude_dn
        width_px[at + i] = point.width_px
        background_dn[at + i] = point.background_dn
        flags[at + i] = point.flags
