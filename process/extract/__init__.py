"""Stripe extraction: sub-pixel stripe centres from one frame. A method a file, one public function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError, UsageError
from ...schemas.tables import Flag
from .argmax import argmax
from .centroid import centroid
from .search import FWHM, Floats, Stripes, find_stripes, half_width_px, noise_dn
from .varied_boundary import varied_boundary

__all__ = ["METHODS", "STRIPE_DTYPE", "extract_stripe"]

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

#: Below this ratio of amplitude to noise the centre is called weak, and below the other there is none,
#: whatever base_dn says: 30 DN are much in 8 bits and little in 16.
_WEAK, _LEAST = 8.0, 4.0

_Result = tuple[Floats, Floats, Floats | None]
_METHODS: Final[dict[str, Callable[[Stripes, float, float], _Result]]] = {
    "argmax": lambda s, noise, _: (*argmax(s, noise), None),
    "centroid": lambda s, noise, _: (*centroid(s, noise), None),
    "varied-boundary": varied_boundary,
}
METHODS: Final = tuple(_METHODS)


def extract_stripe(
    frame: npt.NDArray[Any],
    method: str = "varied-boundary",
    *,
    orientation: str = "vertical",
    background: npt.NDArray[Any] | None = None,
    base_dn: float = 30.0,
    max_width_px: float = 40.0,
    saturation_dn: float | None = None,
    from_px: int = 0,
    to_px: int | None = None,
    noise: float | None = None,
) -> npt.NDArray[Any]:
    """Stripe centres of one grey frame: one point in each row (column) that holds a stripe.

    Parameters
    ----------
    frame
        (H, W), uint8 or uint16, grey values in DN.
    method
        ``argmax``, ``centroid`` or ``varied-boundary`` (the paper's).
    orientation
        ``vertical``: one centre a row, along u; ``horizontal``: one a column, along v.
    background
        A laser-off frame of the same shape and type, subtracted with its sign.
    base_dn
        Gbase: what is not higher than this (or than 4 times the noise) above its local background is
        no stripe.
    max_width_px
        Half of the window about the peak that a row's samples are taken from.
    saturation_dn
        Level from which samples count as clipped; the full scale of the type by default.
    from_px, to_px
        Where along the row (column) the stripe may lie, half-open.
    noise
        Standard deviation of a pixel's noise in DN; estimated from the frame by default.

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
        There is no such method or orientation.
    """
    _check(frame, "frame")
    if method not in _METHODS:
        raise UsageError(f"no extraction method {method!r}; there are: {', '.join(METHODS)}")
    if orientation not in ("vertical", "horizontal"):
        raise UsageError(f"orientation is {orientation!r}, expected vertical or horizontal")
    if background is not None:
        _check(background, "background frame")
        if background.shape != frame.shape or background.dtype != frame.dtype:
            raise InputError(
                f"the background frame is {background.shape} {background.dtype}, the frame "
                f"{frame.shape} {frame.dtype}",
                hint="both must come from the same camera with the same settings",
            )
    if orientation == "horizontal":
        frame = np.ascontiguousarray(frame.T)
        background = None if background is None else np.ascontiguousarray(background.T)
    if saturation_dn is None:
        saturation_dn = float(np.iinfo(frame.dtype).max)
    if noise is None:
        noise = noise_dn(frame)
    if background is not None:
        noise *= np.sqrt(2.0)
    stripes = find_stripes(
        frame,
        background,
        base_dn=max(base_dn, _LEAST * noise),
        max_width_px=max_width_px,
        saturation_dn=saturation_dn,
        from_px=from_px,
        to_px=to_px,
    )
    centre, sigma, width = _METHODS[method](stripes, noise, base_dn)
    out = np.zeros(len(centre), STRIPE_DTYPE)
    out["row"], out["u_px"], out["sigma_u_px"] = stripes.row, centre, sigma
    out["amplitude_dn"], out["background_dn"] = stripes.amplitude_dn, stripes.background_dn
    out["width_px"] = half_width_px(stripes) / FWHM if width is None else width
    out["flags"] = _flags(stripes, noise)
    return out[np.isfinite(centre)]


def _flags(stripes: Stripes, noise: float) -> npt.NDArray[np.uint16]:
    flags = np.zeros(len(stripes.row), np.uint16)
    flags[(stripes.clipped & stripes.run).any(axis=1)] |= np.uint16(Flag.SATURATED)
    # The run touches a border when the sample beside it lies outside, or the window ends there.
    beside = np.zeros_like(stripes.run)
    beside[:, 1:] |= stripes.run[:, :-1]
    beside[:, :-1] |= stripes.run[:, 1:]
    ends = stripes.run[:, [0, -1]].any(axis=1) if stripes.run.size else np.zeros(0, np.bool_)
    flags[(beside & ~stripes.inside).any(axis=1) | ends] |= np.uint16(Flag.EDGE)
    flags[stripes.amplitude_dn < _WEAK * noise] |= np.uint16(Flag.WEAK)
    flags[stripes.second] |= np.uint16(Flag.SECOND)
    return flags


def _check(frame: npt.NDArray[Any], what: str) -> None:
    if frame.ndim != 2 or frame.size == 0:
        raise InputError(
            f"the {what} has shape {frame.shape}, expected (H, W)",
            hint="convert colour frames first (stage grey)",
        )
    if frame.dtype not in (np.uint8, np.uint16):
        raise InputError(f"the {what} is {frame.dtype}, expected uint8 or uint16")
