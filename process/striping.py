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
from ..schemas.events import TurntableAngle
from ..schemas.recipe import Recipe
from .batches import BATCH_ROWS
from .pairing import LitFrame, pair_frames
from .stages import FrameChain

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
    gathered = _Gathered()
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
        gathered.add(lit, found)
        if gathered.rows >= BATCH_ROWS:
            yield gathered.columns()
            gathered = _Gathered()
    if gathered.rows:
        yield gathered.columns()


class _Gathered:
    """Stripe points of frames, held as they come, and made into columns when there are enough."""

    def __init__(self) -> None:
        self.rows = 0
        self._points: list[Points] = []
        # Of every piece: frame, time, laser, angle, number of points.
        self._heads: list[tuple[int, int, int, float, int]] = []

    def add(self, lit: LitFrame, found: list[tuple[int, Points]]) -> None:
        """One frame's stripe points of all lasers, in the order of rows."""
        # Within one turn, where float32 is good to 3e-7 rad.
        angle_rad = math.fmod(lit.angle_rad, math.tau)
        for laser, points in found if len(found) == 1 else _by_row(found):
            self._points.append(points)
            self._heads.append((lit.frame, lit.t_ns, laser, angle_rad, len(points)))
            self.rows += len(points)

    def columns(self) -> dict[str, Any]:
        """The columns of STRIPES."""
        frame, t_ns, laser, angle_rad, count = zip(*self._heads, strict=True)
        points = np.concatenate(self._points)
        return {
            "frame": np.repeat(np.array(frame, np.uint32), count),
            "t_ns": np.repeat(np.array(t_ns, np.int64), count),
            "laser": np.repeat(np.array(laser, np.uint8), count),
            "angle_rad": np.repeat(np.array(angle_rad, np.float32), count),
            **{name: points[name] for name in points.dtype.names or ()},
        }


def _by_row(found: list[tuple[int, Points]]) -> Iterator[tuple[int, Points]]:
    """The points of several lasers merged by row, in pieces of one point; in a row by laser."""
    points = np.concatenate([p for _, p in found])
    laser = np.concatenate([np.full(len(p), n, np.uint8) for n, p in found])
    for i in np.argsort(points["row"], kind="stable"):
        yield int(laser[i]), points[i : i + 1]


def _is_frame(item: Any, camera: str) -> bool:
    """Whether an item of a log is a frame of ``camera``; of the events none has pixels."""
    return hasattr(item, "decode") and item.camera == camera
