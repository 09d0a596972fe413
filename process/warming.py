"""Everything compiled before the first real frame: a recipe run once on a frame that is made up.

Compiling takes half a minute on a new machine, and a turntable does not wait.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Calibration
from ..schemas.errors import TurnscanError
from ..schemas.events import TurntableAngle
from ..schemas.image_messages import ENCODINGS
from ..schemas.recipe import Recipe
from ..schemas.tables import STRIPES
from .batches import columns_of, record_batches
from .finding import FrameSource, StripeFinder
from .stages import PointChain
from .striping import Tally, stripe_parts

_DARK_DN, _STRIPE_DN, _WIDTH_PX = 12.0, 150.0, 1.5


@dataclass(frozen=True)
class _Made:
    """A frame that was never taken, as a log gives frames."""

    frame: int
    t_ns: int
    lasers_on: tuple[int, ...]
    image: npt.NDArray[Any]
    camera: str = "0"

    def decode(self) -> npt.NDArray[Any]:
        return self.image


def warm(
    recipe: Recipe, calibration: Calibration | None, width_px: int, height_px: int, encoding: str
) -> None:
    """Load, or compile, every kernel that ``recipe`` needs for frames of this kind.

    What cannot be done with these frames is left for the first real one to say.
    """
    laser = calibration.lasers[0].laser if calibration is not None and calibration.lasers else 0
    frames = _frames(width_px, height_px, encoding, laser, recipe.extract().orientation == "vertical")
    with contextlib.suppress(TurnscanError):
        finder = StripeFinder(recipe, calibration, FrameSource("made up", "0"))
        parts = stripe_parts(frames, finder, Tally(), lambda _: None)
        for batch in record_batches(STRIPES, parts):
            if calibration is not None:
                PointChain(recipe, calibration).points(columns_of(batch))


def _frames(width_px: int, height_px: int, encoding: str, laser: int, vertical: bool) -> Iterator[Any]:
    size, channels = ENCODINGS[encoding]
    across = np.arange(width_px if vertical else height_px)
    middle = len(across) / 2
    profile = _STRIPE_DN * np.exp(-((across - middle) ** 2) / (2 * _WIDTH_PX**2))
    lit = np.broadcast_to(profile if vertical else profile[:, None], (height_px, width_px))
    yield TurntableAngle(t_ns=0, commanded_rad=0.0, reported_rad=0.0)
    for n, (lasers, image) in enumerate((((), 0 * lit), ((laser,), lit))):
        grey = np.rint((_DARK_DN + image) * (1 if size == 1 else 257)).astype(np.dtype(f"u{size}"))
        pixels = grey if channels == 1 else np.repeat(grey[..., None], channels, axis=2)
        # As a log gives them: another type to the compiler than what may be written to.
        pixels.flags.writeable = False
        yield _Made(frame=n, t_ns=n + 1, lasers_on=lasers, image=pixels)
