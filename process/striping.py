"""Frames and angles of one log to STRIPES columns, frame by frame, with what is counted on the way.

The one way from frames to stripes, for a sealed log and for one that is still being written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.events import LogEvent, TurntableAngle
from .finding import Found, StripeFinder
from .pairing import pair_frames
from .stripe_columns import StripeColumns

Points = npt.NDArray[Any]


@dataclass
class Tally:
    """What is counted while frames stream by: for the manifest, and for who watches."""

    frames: int = 0
    empty: int = 0
    #: Rows (columns) of the last frame, and those of them that showed the stripe.
    rows: int = 0
    rows_with_stripe: int = 0
    #: Frames after the turntable's last report, which have no angle.
    left_out: list[int] = field(default_factory=list)

    def warnings(self) -> tuple[str, ...]:
        """What the manifest should warn of."""
        out = []
        if self.frames and self.empty == self.frames:
            out.append("no frame shows a stripe: lower extract.base_dn, or look at the frames")
        elif self.empty:
            out.append(f"{self.empty} of {self.frames} frames show no stripe")
        if self.left_out:
            out.append(f"{len(self.left_out)} frames after the turntable's last report were left out")
        return tuple(out)

    def fields(self) -> dict[str, Any]:
        """What a manifest of STRIPES takes from here."""
        return {
            "frames": self.frames,
            "frames_without_stripe": self.empty,
            "warnings": self.warnings(),
        }


def stripe_parts(
    items: Iterable[Any], finder: StripeFinder, tally: Tally, advance: Callable[[Tally], None]
) -> Iterator[dict[str, Any]]:
    """STRIPES columns of many frames at a time: the same from a sealed log and from one that grows.

    ``items`` are events and frames, or in the place of frames what ``finder`` found in them.
    """
    columns = StripeColumns()

    def of_camera() -> Iterator[Any]:
        for item in items:
            if isinstance(item, TurntableAngle) or _is_frame(item, finder.source.camera):
                yield item

    for lit in pair_frames(
        of_camera(), with_background=finder.with_background, left_out=tally.left_out
    ):
        found = lit.image
        if not isinstance(found, Found):
            found = finder.find(lit.frame, found, lit.lasers_on, lit.background)
        tally.frames += 1
        tally.rows = found.rows * len(found.stripes)
        tally.rows_with_stripe = sum(len(points) for _, points in found.stripes)
        tally.empty += not tally.rows_with_stripe
        advance(tally)
        points, laser = _by_row(found.stripes)
        yield from columns.add(
            points,
            frame=lit.frame,
            t_ns=lit.t_ns,
            # Within one turn, where float32 is good to 3e-7 rad.
            angle_rad=math.fmod(lit.angle_rad, math.tau),
            laser=laser,
        )
    yield from columns.rest()


def _by_row(found: list[tuple[int, Points]]) -> tuple[Points, int | npt.NDArray[np.uint8]]:
    """The points of all lasers and the laser of each, in the order of rows; in a row by laser."""
    if len(found) == 1:
        ((laser, points),) = found
        return points, laser
    together = np.concatenate([p for _, p in found])
    lasers = np.concatenate([np.full(len(p), n, np.uint8) for n, p in found])
    order = np.argsort(together["row"], kind="stable")
    return together[order], lasers[order]


def _is_frame(item: Any, camera: str) -> bool:
    """Whether an item of a log is a frame of ``camera``: what is no event."""
    return not isinstance(item, LogEvent) and item.camera == camera
