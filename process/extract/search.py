"""Find the stripe in each row: its peak, its surroundings, and whether it is one at all.

Frames are given with the stripe across the rows (vertical); a horizontal one is transposed before.
Everything is done for all rows at once on short windows about the peaks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Share of its height above which samples belong to a stripe. Lower, and a glow beside the stripe pulls
#: the centre; higher, and so few samples are left that the centre moves with its place in the pixel
#: (0.045 px at 0.5 for a stripe 1.8 px wide, 0.018 px here).
RUN_LEVEL = 0.3
#: Width at half height of a Gaussian, in standard deviations.
FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
#: A second stripe is reported when it is at least this bright, relative to the first.
_SECOND = 0.5
#: Width of the box that the brightest place is searched with: a stripe outshines a hot pixel.
_BOX = 5


@dataclass(frozen=True)
class Stripes:
    """Rows with a stripe, and the samples about each peak.

    ``samples`` is (N, 2 K + 1): grey values (less the laser-off frame) at ``left + j``; where
    ``inside`` is False the window reaches over the frame's or the search window's border. ``run`` marks
    the samples that belong to the stripe: the unbroken stretch about the peak above RUN_LEVEL of its
    height.
    ``clipped`` marks those at or above the saturation level.
    """

    row: Ints
    left: Ints
    peak: Ints
    samples: Floats
    inside: npt.NDArray[np.bool_]
    run: npt.NDArray[np.bool_]
    clipped: npt.NDArray[np.bool_]
    background_dn: Floats
    amplitude_dn: Floats
    second: npt.NDArray[np.bool_]

    def positions(self) -> Floats:
        """Pixel position of every sample, relative to its row's peak: (N, 2 K + 1)."""
        return (self.left - self.peak)[:, None] + np.arange(self.samples.shape[1], dtype=np.float64)

    def select(self, keep: npt.NDArray[np.bool_]) -> Stripes:
        """The rows where ``keep`` is True."""
        return Stripes(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def find_stripes(
    frame: npt.NDArray[Any],
    background: npt.NDArray[Any] | None,
    *,
    base_dn: float,
    max_width_px: float,
    saturation_dn: float,
    from_px: int = 0,
    to_px: int | None = None,
) -> Stripes:
    """The brightest stripe of each row whose height above its surroundings exceeds ``base_dn``.

    ``frame`` is (H, W), uint8 or uint16; ``background`` the laser-off frame or None; the search is
    limited to columns [from_px, to_px). The local background is the median of the samples within
    ``max_width_px`` of the peak.
    """
    stop = frame.shape[1] if to_px is None else min(to_px, frame.shape[1])
    if from_px >= stop:
        raise InputError(
            f"the search window from {from_px} to {stop} px holds nothing of a frame of "
            f"{frame.shape[1]} px",
            hint="correct extract.windows in the recipe",
        )
    area = frame[:, from_px:stop]
    if background is None:
        signal: npt.NDArray[Any] = area
    else:
        # Signed on purpose: clipping at zero would bend the noise about the stripe.
        signal = cv2.subtract(area, background[:, from_px:stop], dtype=cv2.CV_32F)
    score = cv2.blur(signal, (_BOX, 1), borderType=cv2.BORDER_REPLICATE)
    rows = np.arange(frame.shape[0])
    peak = score.argmax(axis=1)
    best = score[rows, peak].astype(np.float64)
    # Most rows of most frames hold nothing: leave them out before anything is gathered.
    floor = _median(score[:, :: max(1, score.shape[1] // 64)])
    found = np.flatnonzero(best - floor > 0.5 * base_dn)
    half = int(np.ceil(max_width_px))
    stripes = _gather(signal, area, found, peak[found], half, saturation_dn)
    keep = stripes.amplitude_dn > base_dn
    second = _second(score, found, peak[found], best[found], stripes.background_dn, half)
    stripes = Stripes(**{**stripes.__dict__, "second": second}).select(keep)
    shifted = {"left": stripes.left + from_px, "peak": stripes.peak + from_px}
    return Stripes(**{**stripes.__dict__, **shifted})


def _gather(
    signal: npt.NDArray[Any],
    area: npt.NDArray[Any],
    row: Ints,
    peak: Ints,
    half: int,
    saturation_dn: float,
) -> Stripes:
    width = signal.shape[1]
    columns = peak[:, None] + np.arange(-half, half + 1)
    inside = (columns >= 0) & (columns < width)
    clamped = np.clip(columns, 0, width - 1)
    raw = signal[row[:, None], clamped]
    clipped = (raw if signal is area else area[row[:, None], clamped]) >= saturation_dn
    clipped &= inside
    samples = raw.astype(np.float64)
    background = _masked_median(raw, inside)
    # The peak is that of a box: the summit, the brightest sample itself, is not far.
    first = max(0, half - _BOX // 2)
    near = slice(first, half + _BOX // 2 + 1)
    top = np.where(inside[:, near], samples[:, near], -np.inf)
    summit = top.argmax(axis=1) + first
    amplitude = samples[np.arange(len(row)), summit] - background
    above = inside & (samples - background[:, None] > RUN_LEVEL * amplitude[:, None])
    run = _stretch(above, summit)
    return Stripes(
        row=row,
        left=columns[:, 0],
        peak=peak + summit - half,
        samples=samples,
        inside=inside,
        run=run,
        clipped=clipped,
        background_dn=background,
        amplitude_dn=amplitude,
        second=np.zeros(len(row), np.bool_),
    )


def _median(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """``np.median(values, axis=1)``, faster: short rows of small integers are best sorted."""
    # NumPy's vectorised sorts begin at 16 bits: bytes take ten times as long.
    ordered = np.sort(values.astype(np.uint16) if values.dtype == np.uint8 else values, axis=1)
    n = ordered.shape[1]
    return ordered[:, n // 2] if n % 2 else ordered[:, n // 2 - 1 : n // 2 + 1].mean(axis=1)


def _masked_median(samples: npt.NDArray[Any], inside: npt.NDArray[np.bool_]) -> Floats:
    """Median of the samples of each row that are inside."""
    out = _median(samples).astype(np.float64)
    cut = np.flatnonzero(~inside.all(axis=1))
    for i in cut:
        out[i] = np.median(samples[i, inside[i]].astype(np.float64))
    return out


def _stretch(above: npt.NDArray[np.bool_], summit: Ints) -> npt.NDArray[np.bool_]:
    """The unbroken stretch of True about ``summit`` in each row; none where that is False."""
    # No gap lies between two samples when as many gaps are counted up to the one as to the other.
    gaps = np.cumsum(~above, axis=1, dtype=np.int16)
    stretch: npt.NDArray[np.bool_] = above & (gaps == gaps[np.arange(len(gaps)), summit][:, None])
    return stretch


def _second(
    score: npt.NDArray[Any], row: Ints, peak: Ints, best: Floats, background: Floats, half: int
) -> npt.NDArray[np.bool_]:
    """Whether a place outside the stripe's own window is nearly as bright."""
    rest = score[row]
    columns = np.clip(peak[:, None] + np.arange(-half, half + 1), 0, score.shape[1] - 1)
    # Nothing is darker than a black pixel, and black is never nearly as bright as a stripe.
    rest[np.arange(len(row))[:, None], columns] = 0 if rest.dtype.kind == "u" else -np.inf
    other: npt.NDArray[np.bool_] = (rest.max(axis=1) - background) > _SECOND * (best - background)
    return other


def half_width_px(stripes: Stripes) -> Floats:
    """Width of each stripe at half height, to sub-pixel by linear interpolation of its flanks (N,)."""
    n, count = stripes.samples.shape
    if not n:
        return np.zeros(0, np.float64)
    rows = np.arange(n)
    level = stripes.background_dn + 0.5 * stripes.amplitude_dn
    high = stripes.run & (stripes.samples > level[:, None])
    first = high.argmax(axis=1)
    last = count - 1 - high[:, ::-1].argmax(axis=1)

    def crossing(at: Ints, step: int) -> Floats:
        inner = stripes.samples[rows, at]
        outer = stripes.samples[rows, np.clip(at + step, 0, count - 1)]
        drop = inner - outer
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(drop > 0, (inner - level) / drop, 0.5)
        return np.clip(part, 0.0, 1.0)

    return (last - first) + crossing(first, -1) + crossing(last, 1)


def noise_dn(frame: npt.NDArray[Any]) -> float:
    """Standard deviation of the noise of single pixels, from second differences along the rows.

    The median absolute deviation ignores stripe and edges; rounding to whole DN adds 1/12 DN^2.
    """
    rows = frame[:: max(1, frame.shape[0] // 64)].astype(np.int32)
    if rows.shape[1] < 3:
        return float(np.sqrt(1.0 / 12.0))
    bend = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    # Whole DN make the plain median jump; the mean of the lower two thirds is smooth (factor for a
    # normal distribution: E[|z| given |z| < q(2/3)] = 0.4557).
    size = np.abs(bend).ravel()
    count = max(1, 2 * size.size // 3)
    low = float(np.partition(size, count - 1)[:count].mean())
    return float(np.sqrt((low / 0.4557) ** 2 / 6.0 + 1.0 / 12.0))
