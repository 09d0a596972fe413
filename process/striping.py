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

from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError, InputError
from ..schemas.events import LogEvent, TurntableAngle
from ..schemas.recipe import Recipe
from .pairing import LitFrame, pair_frames
from .stages import FrameChain
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


@dataclass
class FrameSource:
    """Whose frames are taken: the scan, its one camera, and the size of every frame."""

    scan: str
    camera: str
    size: tuple[int, int] | None = None

    def check(self, lit: LitFrame) -> None:
        """A frame of another size than the scan's would be triangulated wrongly without a word."""
        height, width = lit.image.shape[:2]
        if self.size is None:
            self.size = (width, height)
        if (width, height) != self.size:
            raise InputError(
                f"scan {self.scan}, frame {lit.frame}: is {width} x {height}, the scan's first frame "
                f"is {self.size[0]} x {self.size[1]}",
                hint="a scan holds frames of one size: record or import the others as a scan of "
                "their own",
            )


def stripe_parts(
    items: Iterable[Any],
    recipe: Recipe,
    calibration: Calibration | None,
    source: FrameSource,
    tally: Tally,
    advance: Callable[[Tally], None],
) -> Iterator[dict[str, Any]]:
    """STRIPES columns of many frames at a time: the same from a sealed log and from one that grows."""
    chain = FrameChain(recipe, calibration)
    columns = StripeColumns()
    vertical = recipe.extract().orientation == "vertical"

    def of_camera() -> Iterator[Any]:
        for item in items:
            if isinstance(item, TurntableAngle) or _is_frame(item, source.camera):
                yield item

    with_background = recipe.extract().background == "off-frame"
    for lit in pair_frames(of_camera(), with_background=with_background, left_out=tally.left_out):
        source.check(lit)
        try:
            found = chain.extract(lit.image, lit.lasers_on, lit.background)
        except (InputError, CalibrationError) as error:
            raise type(error)(
                f"scan {source.scan}, frame {lit.frame}: {error}", hint=error.hint
            ) from error
        tally.frames += 1
        tally.empty += not any(len(points) for _, points in found)
        tally.rows = len(found) * lit.image.shape[0 if vertical else 1]
        tally.rows_with_stripe = sum(len(points) for _, points in found)
        advance(tally)
        points, laser = _by_row(found)
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
