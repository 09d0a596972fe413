"""The paper's denoising (section 3.2.1): Gaussian 3 x 3, median, and both orders of the two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..schemas.recipe import Denoise, Extract

#: Formula (12), with the centre weight on f(i, j): [1 2 1; 2 4 2; 1 2 1] / 16.
_GAUSSIAN = np.array([0.25, 0.5, 0.25])
#: What the methods of extraction read beyond twice the widest stripe: the background's samples, and the
#: few pixels by which the summit may lie off the place that the search gave.
_BESIDE = 8
#: Rows above and below that are read in the same columns (Steger's method smooths over them), also
#: where the stripe ends or jumps; the stretches grow by as many columns.
_ROWS = 12


def denoise(frame: npt.NDArray[Any], step: Denoise) -> npt.NDArray[Any]:
    """``frame`` (H, W), uint8 or uint16, filtered everywhere, in the same type.

    Beyond its borders the Gaussian sees the frame mirrored, the median the border's pixels repeated.
    ``step.where`` is not looked at: see :func:`denoise_at_stripe`.
    """
    for name in step.method.split("-"):
        if name == "gaussian":
            frame = cv2.sepFilter2D(frame, -1, _GAUSSIAN, _GAUSSIAN, borderType=cv2.BORDER_REFLECT_101)
        elif name == "median":
            frame = cv2.medianBlur(frame, step.median_size_px)
    return frame


def denoise_at_stripe(
    frame: npt.NDArray[Any],
    background: npt.NDArray[Any] | None,
    step: Denoise,
    extract: Extract,
    spans: Sequence[tuple[int, int | None]],
    noise: float,
) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
    """Frame and laser-off frame (H, W), filtered where ``extract`` will look for its samples.

    The stripe is searched in the unfiltered frame, less the laser-off frame, in each of ``spans``
    (from_px, to_px). About it the pixels are those that :func:`denoise` gives, as far as
    any method reads them; a row with a second bright stripe is filtered whole, so that the choice
    between them compares like with like. Elsewhere the frames are as they were: only where a second
    stripe is just half as bright as the first may the flag that tells of it differ. ``noise`` is that
    of single pixels of the unfiltered frame, in DN.
    """
    from .denoise_window import filter_windows, joined
    from .extract.search import find_peaks

    steps = [(n, 1 if n == "gaussian" else step.median_size_px // 2) for n in step.method.split("-")]
    if step.method == "none":
        return frame, background
    across = extract.orientation == "horizontal"
    frames = [frame] if background is None else [frame, background]
    if across:
        frames = [cv2.transpose(f) for f in frames]
    signal = np.ascontiguousarray(frames[0])
    least = 4.0 * noise
    if background is not None:
        signal = cv2.subtract(
            signal, frames[1], dtype=cv2.CV_16S if frame.dtype == np.uint8 else cv2.CV_32S
        )
        least *= float(np.sqrt(2.0))
    height, width = signal.shape
    first, last = np.full(height, width, np.int64), np.zeros(height, np.int64)
    reach = int(np.ceil(2.0 * extract.max_width_px)) + _BESIDE
    for from_px, to_px in spans:
        stop = width if to_px is None else min(to_px, width)
        if from_px >= stop:
            continue
        # Half of what counts as a stripe: rows that show one only once they are filtered count, too.
        peak, second = find_peaks(signal, from_px, stop, 0.5 * max(extract.base_dn, least))
        found = peak >= 0
        low = np.where(second, from_px, peak - reach)
        high = np.where(second, stop, peak + reach + 1)
        first = np.where(found, np.minimum(first, low), first)
        last = np.where(found, np.maximum(last, high), last)
    first, last = joined(first, last, _ROWS, width)
    done = [filter_windows(f, steps, first, last, transposed=across) for f in frames]
    if across:
        done = [cv2.transpose(f) for f in done]
    return done[0], None if background is None else done[1]
