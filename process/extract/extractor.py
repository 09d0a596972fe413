"""One way to extract, with its words and numbers checked once: called with frame after frame."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError, UsageError
from ...schemas.recipe import METHOD_VERSIONS
from .frame_check import SIGNED, checked, clip_level, locked

#: What extract_stripe returns for each stripe point; names and units as in STRIPES.
STRIPE_DTYPE: Final = np.dtype(
    [
        ("row", np.uint16),
        ("u_px", np.float64),
        ("sigma_u_px", np.float64),
        ("amplitude_dn", np.float64),
        ("width_px", np.float64),
        ("background_dn", np.float64),
        ("flags", np.uint16),
    ]
)

METHODS: Final = tuple(METHOD_VERSIONS)
CHOICES: Final = ("brightest", "first", "nearest", "continuous")

#: Below this ratio of amplitude to noise there is no stripe, whatever base_dn says: 30 DN are much in
#: 8 bits and little in 16.
LEAST: Final = 4.0
#: The difference of two frames is louder than one by this.
SQRT_2: Final = 2.0**0.5


class Extractor:
    """:func:`turnscan.process.extract.extract_stripe`, all of its arguments given but those of a frame.

    Raises
    ------
    UsageError
        There is no such method, orientation or choice, or a number is out of its range.
    """

    def __init__(
        self,
        method: str = "fused",
        *,
        orientation: str = "vertical",
        base_dn: float = 30.0,
        max_width_px: float = 40.0,
        saturation_dn: float | None = None,
        from_px: int = 0,
        to_px: int | None = None,
        choice: str = "brightest",
        expected_px: float | npt.NDArray[np.float64] | None = None,
        pool_rows: int = 1,
    ) -> None:
        _check_words(
            method, orientation, choice, expected_px is not None, pool_rows, base_dn, max_width_px
        )
        self._lying = orientation == "horizontal"
        self._base_dn, self._max_width_px, self._saturation_dn = base_dn, max_width_px, saturation_dn
        self._from_px, self._to_px = from_px, to_px
        self._choice, self._expected_px, self._pool_rows = choice, expected_px, pool_rows
        # One call of compiled code, since on small frames a second one costs as much as its work.
        self._brightest = method == "fused" and choice == "brightest"
        name = method.replace("-", "_")
        self._method = _function(name, "brightest" if self._brightest else name)

    def __call__(
        self,
        frame: npt.NDArray[Any],
        background: npt.NDArray[Any] | None = None,
        noise: float | None = None,
        out: npt.NDArray[Any] | None = None,
    ) -> npt.NDArray[Any]:
        """The stripe points of a frame, with its laser-off frame and its noise, if they are known.

        ``out`` (at least a row of the frame each, :data:`STRIPE_DTYPE`) is memory for them, which the
        points returned are then a part of.

        Raises
        ------
        InputError
            The frame or the background cannot be what they should be.
        """
        frame = checked(frame, "frame")
        if self._lying:
            frame = cv2.transpose(frame)
        height, width = frame.shape
        from_px, stop = self._from_px, width if self._to_px is None else min(self._to_px, width)
        if not 0 <= from_px < stop:
            raise InputError(
                f"the search window from {from_px} to {stop} px holds nothing of a frame of {width} px",
                hint="correct extract.windows in the recipe",
            )
        clip_dn = clip_level(frame, self._saturation_dn)
        signal = frame = locked(frame)
        if background is not None:
            signal = self._less(frame, background)
        if out is None:
            out = np.empty(height, STRIPE_DTYPE)
        limits = (from_px, stop, self._base_dn, self._max_width_px)
        if self._brightest:
            count = self._method(signal, frame, limits, -1.0 if noise is None else noise, clip_dn, out)
        else:
            if noise is None:
                noise = noise_of(frame)
            if background is not None:
                noise *= SQRT_2
            limits = (*limits[:2], max(self._base_dn, LEAST * noise), self._max_width_px)
            count = self._method(
                signal, frame, self._peaks(signal, limits), limits, noise, clip_dn, out
            )
        points = out[:count]
        return points if self._pool_rows == 1 else _function("pooling", "pooled")(points)

    def _less(self, frame: npt.NDArray[Any], background: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """``frame`` less its laser-off frame, which is as it came."""
        background = checked(background, "background frame")
        if self._lying:
            background = cv2.transpose(background)
        if background.shape != frame.shape or background.dtype != frame.dtype:
            raise InputError(
                f"the background frame is {background.shape} {background.dtype}, the frame "
                f"{frame.shape} {frame.dtype}",
                hint="both must come from the same camera with the same settings",
            )
        # Signed on purpose: clipping at zero would bend the noise about the stripe.
        return locked(cv2.subtract(frame, background, dtype=SIGNED[frame.dtype.char]))

    def _peaks(
        self, signal: npt.NDArray[Any], limits: tuple[int, int, float, float]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        if self._choice == "brightest":
            return _function("search", "find_peaks")(signal, *limits[:3])
        choose = _function("choice", "choose_peaks")
        return choose(signal, *limits[:3], self._choice, self._expected_px)


def noise_of(frame: npt.NDArray[Any]) -> float:
    """Standard deviation of the noise of single pixels of a frame (H, W), in DN."""
    return float(_function("noise", "noise_dn")(locked(frame), frame.dtype.kind != "f"))


@cache
def _function(module: str, name: str) -> Any:
    """A function of this package; what it needs is loaded, or compiled, when it is first asked for."""
    return getattr(importlib.import_module(f".{module}", __package__), name)


def _check_words(
    method: str,
    orientation: str,
    choice: str,
    expected: bool,
    pool_rows: int,
    base_dn: float,
    max_width_px: float,
) -> None:
    if method not in METHODS:
        raise UsageError(f"no extraction method {method!r}; there are: {', '.join(METHODS)}")
    if orientation not in ("vertical", "horizontal"):
        raise UsageError(f"orientation is {orientation!r}, expected vertical or horizontal")
    if choice not in CHOICES:
        raise UsageError(f"choice is {choice!r}, expected one of: {', '.join(CHOICES)}")
    if (choice == "nearest") != expected:
        raise UsageError('expected_px and choice = "nearest" go together', hint="give both or neither")
    if pool_rows not in (1, 3):
        raise UsageError(f"pool_rows is {pool_rows}, expected 1 or 3")
    if not base_dn >= 0.0:
        raise UsageError(f"base_dn is {base_dn}, expected a number from 0")
    if not 0.0 < max_width_px <= 400.0:
        raise UsageError(f"max_width_px is {max_width_px}, expected a number up to 400")
