"""Stripe extraction: sub-pixel stripe centres from one frame. A method a file, one public function."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError, UsageError
from ...schemas.recipe import METHOD_VERSIONS

__all__ = ["METHODS", "STRIPE_DTYPE", "extract_stripe", "noise_of"]

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


def extract_stripe(
    frame: npt.NDArray[Any],
    method: str = "fused",
    *,
    orientation: str = "vertical",
    background: npt.NDArray[Any] | None = None,
    base_dn: float = 30.0,
    max_width_px: float = 40.0,
    saturation_dn: float | None = None,
    from_px: int = 0,
    to_px: int | None = None,
    noise: float | None = None,
    choice: str = "brightest",
    expected_px: float | npt.NDArray[np.float64] | None = None,
    pool_rows: int = 1,
) -> npt.NDArray[Any]:
    """Stripe centres of one grey frame: one point in each row (column) that holds a stripe.

    Parameters
    ----------
    frame
        (H, W), uint8, uint16 or floating point, grey values in DN.
    method
        One of :data:`METHODS`: ``fused`` (ours), ``varied-boundary`` (the paper's) and the others that
        it names.
    orientation
        ``vertical``: one centre a row, along u; ``horizontal``: one a column, along v.
    background
        A laser-off frame of the same shape and type, subtracted with its sign.
    base_dn
        Gbase: what is not higher than this (or than 4 times the noise) above its local background is
        no stripe.
    max_width_px
        Widest stripe, as a Gaussian standard deviation; and half of the window about the peak that the
        other methods take their samples from.
    saturation_dn
        Level from which samples count as clipped. By default one below the full scale of the type; in
        16 bit frames of the least of 10, 12, 14 and 16 bits that holds the brightest sample; for
        floating point nothing is clipped.
    from_px, to_px
        Where along the row (column) the stripe may lie, half-open.
    noise
        Standard deviation of a pixel's noise in DN; estimated from the frame by default.
    choice
        Which stripe of a row with several: the ``brightest``, the ``first`` (least u), the ``nearest``
        to ``expected_px``, or the one that goes on along the stripe (``continuous``).
    expected_px
        Where the stripe is expected, one value or one for each row; for ``choice = "nearest"``.
    pool_rows
        1, or 3: the centre is the mean of three neighbouring rows where they lie on a line. Its
        deviation is smaller by sqrt(3), and neighbouring points are then correlated.

    Returns
    -------
    numpy.ndarray
        Structured, :data:`STRIPE_DTYPE`, ordered by row. ``row`` is the column number for a horizontal
        stripe, and ``u_px`` then runs along v.

    Raises
    ------
    InputError
        The frame or the background cannot be what they should be.
    UsageError
        There is no such method, orientation or choice, or a number is out of its range.
    """
    _check_words(method, orientation, choice, expected_px is not None, pool_rows, base_dn, max_width_px)
    frame = _checked(frame, "frame")
    if orientation == "horizontal":
        frame = cv2.transpose(frame)
    if background is not None:
        background = _checked(background, "background frame")
        if orientation == "horizontal":
            background = cv2.transpose(background)
        if background.shape != frame.shape or background.dtype != frame.dtype:
            raise InputError(
                f"the background frame is {background.shape} {background.dtype}, the frame "
                f"{frame.shape} {frame.dtype}",
                hint="both must come from the same camera with the same settings",
            )
    stop = frame.shape[1] if to_px is None else min(to_px, frame.shape[1])
    if not 0 <= from_px < stop:
        raise InputError(
            f"the search window from {from_px} to {stop} px holds nothing of a frame of "
            f"{frame.shape[1]} px",
            hint="correct extract.windows in the recipe",
        )
    clip_dn = _clip_level(frame, saturation_dn)
    signal = frame = _locked(frame)
    if background is not None:
        # Signed on purpose: clipping at zero would bend the noise about the stripe.
        signal = _locked(cv2.subtract(frame, background, dtype=_SIGNED[frame.dtype.char]))
    out = np.empty(frame.shape[0], STRIPE_DTYPE)
    limits = (from_px, stop, base_dn, max_width_px)
    if method == "fused" and choice == "brightest":
        # One call of compiled code, since on small frames a second one costs as much as its work.
        count = _function("fused", "brightest")(
            signal, frame, limits, -1.0 if noise is None else noise, clip_dn, out
        )
    else:
        if noise is None:
            noise = noise_of(frame)
        if background is not None:
            noise *= SQRT_2
        base_dn = max(base_dn, LEAST * noise)
        peaks = _peaks(signal, from_px, stop, base_dn, choice, expected_px)
        limits = (from_px, stop, base_dn, max_width_px)
        name = method.replace("-", "_")
        count = _function(name, name)(signal, frame, peaks, limits, noise, clip_dn, out)
    points = out[:count]
    if pool_rows == 3:
        points = _function("pooling", "pooled")(points)
    return points


_SIGNED: Final = {"B": cv2.CV_16S, "H": cv2.CV_32S, "f": cv2.CV_32F, "d": cv2.CV_64F}


def noise_of(frame: npt.NDArray[Any]) -> float:
    """Standard deviation of the noise of single pixels of a frame (H, W), in DN."""
    return float(_function("noise", "noise_dn")(_locked(frame), frame.dtype.kind != "f"))


def _locked(frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """``frame``, not to be written: else the kernels would be compiled for either sort of array."""
    view = frame.view()
    view.flags.writeable = False
    return view


@cache
def _function(module: str, name: str) -> Any:
    """A function of this package; what it needs is loaded, or compiled, when it is first asked for."""
    return getattr(importlib.import_module(f".{module}", __name__), name)


def _peaks(
    signal: npt.NDArray[Any],
    from_px: int,
    to_px: int,
    base_dn: float,
    choice: str,
    expected_px: float | npt.NDArray[np.float64] | None,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    if choice == "brightest":
        return _function("search", "find_peaks")(signal, from_px, to_px, base_dn)
    choose = _function("choice", "choose_peaks")
    return choose(signal, from_px, to_px, base_dn, choice, expected_px)


def _clip_level(frame: npt.NDArray[Any], asked: float | None) -> float:
    kind = frame.dtype.char
    if asked is None and kind == "B":
        return 254.0
    if kind in "fd":
        return float("inf") if asked is None else float(asked)
    full = 255 if kind == "B" else 65535
    if asked is None:
        # Cameras of 10, 12 and 14 bits clip far below the type's own limit.
        brightest = int(frame.max())
        full = next(level for level in (1023, 4095, 16383, 65535) if brightest <= level)
        # Noise and rounding take a clipped sample one step down.
        return full - 1.0
    if not 0.0 < asked <= full:
        raise InputError(
            f"saturation_dn is {asked:g}, the frame is {frame.dtype} with a full scale of {full}",
            hint="give the level in DN of these frames, or leave it out",
        )
    return float(asked)


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


def _checked(frame: npt.NDArray[Any], what: str) -> npt.NDArray[Any]:
    """``frame``, contiguous; or an InputError that says what is wrong with it."""
    if not isinstance(frame, np.ndarray):
        raise InputError(f"the {what} is {type(frame).__name__}, expected an array (H, W)")
    kind = frame.dtype.char
    if frame.ndim != 2 or frame.size == 0:
        raise InputError(
            f"the {what} has shape {frame.shape}, expected (H, W)",
            hint="convert colour frames first (stage grey)",
        )
    if frame.shape[0] > 65535 or frame.shape[1] > 65535:
        raise InputError(f"the {what} has shape {frame.shape}; rows and columns go up to 65535")
    if kind not in _SIGNED:
        raise InputError(f"the {what} is {frame.dtype}, expected uint8, uint16 or floating point")
    if kind in "fd" and not np.isfinite(frame).all():
        row, column = np.argwhere(~np.isfinite(frame))[0]
        raise InputError(
            f"the {what} holds {frame[row, column]} in row {row}, column {column}, expected numbers",
            hint="replace what is missing before extraction",
        )
    return frame if frame.flags.c_contiguous else np.ascontiguousarray(frame)
