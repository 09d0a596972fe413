"""The stripes of single frames of one scan, before the frames are paired, in any thread, or after.

Without laser-off frames nothing but the frame itself is needed, so it can be done where the frame was
decompressed; angles come later.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any, Final

import numpy.typing as npt

from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError, InputError, TurnscanError
from ..schemas.recipe import Recipe
from .stages import FrameChain

Points = npt.NDArray[Any]

#: A frame that takes so long is worth a thread; and what one frame counts at most, since the first ones
#: wait for machine code.
_WORTH_S: Final = 0.5e-3
_LONGEST_S: Final = 2e-3


@dataclass
class FrameSource:
    """Whose frames are taken: the scan, its one camera, and the size of every frame."""

    scan: str
    camera: str
    size: tuple[int, int] | None = None

    def check(self, frame: int, image: npt.NDArray[Any]) -> None:
        """A frame of another size than the scan's would be triangulated wrongly without a word."""
        height, width = image.shape[:2]
        if self.size is None:
            self.size = (width, height)
        if (width, height) != self.size:
            raise InputError(
                f"scan {self.scan}, frame {frame}: is {width} x {height}, the scan's first frame "
                f"is {self.size[0]} x {self.size[1]}",
                hint="a scan holds frames of one size: record or import the others as a scan of "
                "their own",
            )


@dataclass(frozen=True)
class Found:
    """What was found in one frame: its rows (or columns), and (laser, stripe points) of every laser."""

    rows: int
    stripes: list[tuple[int, Points]]


@dataclass(frozen=True)
class FoundFrame:
    """A frame of a log whose pixels were used and let go of: what was found in it, or why nothing."""

    frame: int
    t_ns: int
    camera: str
    lasers_on: tuple[int, ...]
    found: Found | TurnscanError

    def decode(self) -> Found:
        """What was found, in the place of the pixels."""
        if isinstance(self.found, TurnscanError):
            raise self.found
        return self.found


class StripeFinder:
    """The frame stages of a recipe for the frames of one source; any thread may use it."""

    def __init__(self, recipe: Recipe, calibration: Calibration | None, source: FrameSource) -> None:
        self.source = source
        extract = recipe.extract()
        self.with_background = extract.background == "off-frame"
        self._vertical = extract.orientation == "vertical"
        self._recipe, self._calibration = recipe, calibration
        self._mean_s, self._encoded = 0.0, False
        self._of_thread = threading.local()
        # The first one now: what is wrong with the recipe is told before any frame is read.
        self._chain()

    def __call__(self, item: Any) -> Any:
        """What was found in a frame of a log; or the frame itself, for :meth:`find` in its turn: if it
        has to be paired first, or takes next to no time.
        """
        self._encoded = item.encoded
        ours = item.lasers_on and item.camera == self.source.camera
        if not ours or not self.worth_a_thread():
            return item
        found: Found | TurnscanError
        try:
            there = self.find(item.frame, item.decode(), item.lasers_on, None)
            # The next frame's points are written to the same memory.
            found = Found(there.rows, [(laser, points.copy()) for laser, points in there.stripes])
        except TurnscanError as error:
            # To be told in its turn, if nothing before it fails.
            found = error
        return FoundFrame(item.frame, item.t_ns, item.camera, item.lasers_on, found)

    def worth_a_thread(self) -> bool:
        """Whether a frame takes so long that threads gain more than they lose by passing Python on."""
        return not self.with_background and (self._encoded or self._mean_s > _WORTH_S)

    def find(
        self,
        frame: int,
        image: npt.NDArray[Any],
        lasers_on: tuple[int, ...],
        background: npt.NDArray[Any] | None,
    ) -> Found:
        """The stripes of a frame, until the next call in the same thread."""
        self.source.check(frame, image)
        began = time.perf_counter()
        try:
            stripes = self._chain().extract(image, lasers_on, background)
        except (InputError, CalibrationError) as error:
            raise type(error)(
                f"scan {self.source.scan}, frame {frame}: {error}", hint=error.hint
            ) from error
        took_s = time.perf_counter() - began
        self._mean_s += (min(took_s, _LONGEST_S) - self._mean_s) / 8.0
        return Found(image.shape[0 if self._vertical else 1], stripes)

    def _chain(self) -> FrameChain:
        """That of this thread: its memory is written to with every frame."""
        if not hasattr(self._of_thread, "chain"):
            self._of_thread.chain = FrameChain(self._recipe, self._calibration)
        chain: FrameChain = self._of_thread.chain
        return chain
