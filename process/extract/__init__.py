"""Stripe extraction: sub-pixel stripe centres from one frame. A method a file, one public function."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from .extractor import METHODS, STRIPE_DTYPE, Extractor, noise_of

__all__ = ["METHODS", "STRIPE_DTYPE", "Extractor", "extract_stripe", "noise_of"]


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
    limits = base_dn, max_width_px, saturation_dn, from_px, to_px
    if expected_px is None:
        return _extractor(method, orientation, *limits, choice, pool_rows)(frame, background, noise)
    extractor = _made(method, orientation, *limits, choice, pool_rows, expected_px)
    return extractor(frame, background, noise)


def _made(
    method: str,
    orientation: str,
    base_dn: float,
    max_width_px: float,
    saturation_dn: float | None,
    from_px: int,
    to_px: int | None,
    choice: str,
    pool_rows: int,
    expected_px: float | npt.NDArray[np.float64] | None = None,
) -> Extractor:
    return Extractor(
        method,
        orientation=orientation,
        base_dn=base_dn,
        max_width_px=max_width_px,
        saturation_dn=saturation_dn,
        from_px=from_px,
        to_px=to_px,
        choice=choice,
        expected_px=expected_px,
        pool_rows=pool_rows,
    )


#: An extractor holds nothing of a frame: whoever asks for the same again gets the same.
_extractor = lru_cache(64)(_made)
