"""Does a calibration still fit a scan? The overlap of its first and last sweep, and fixed targets.

Within a scan of more than one turn, the same angle is seen twice. Whatever the calibration is, both
sweeps must give the same points; where they do not, something moved in between: camera, laser, table.
A target, whose place in the scene is known, tells whether the calibration is right, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.errors import InputError

Columns = Mapping[str, npt.NDArray[Any]]
Read = Callable[[], Iterator[Columns]]
Floats = npt.NDArray[np.float64]

#: Frame pairs that are looked at, spread over the overlap: memory stays small whatever the scan is.
MOST_PAIRS = 180
_FEWEST_PAIRS = 3
#: 1.4826 median absolute deviations are one sigma of a normal distribution; the median of n normal
#: numbers has sqrt(pi / 2) times the standard error of their mean (Kenney & Keeping 1962).
_MAD_TO_SIGMA = 1.4826
_MEDIAN_ERROR = math.sqrt(math.pi / 2.0)


@dataclass(frozen=True)
class Drift:
    """What the overlap of the first and the last sweep says (last minus first).

    ``bias_mm`` is the mean change of range and ``bias_px`` of the stripe in the image; ``drift_mm`` the
    rms change from frame to frame, noise taken off, which also sees a change that has another sign on
    the other side of the table. ``noise_mm`` is the sigma of one point; ``sigmas`` says how unlikely
    the changes are by noise alone.
    """

    turns: float
    pairs: int
    points: int
    bias_mm: float
    bias_px: float
    drift_mm: float
    noise_mm: float
    sigmas: float


@dataclass(frozen=True)
class Target:
    """A point in scene space, known to ``sd_mm``, on a surface that is flat ``within_mm`` around."""

    name: str
    x_mm: float
    y_mm: float
    z_mm: float
    sd_mm: float = 0.0
    within_mm: float = 20.0


@dataclass(frozen=True)
class TargetOffset:
    """How far the surface lies from a target, along its own normal (positive: beyond the target).

    ``points`` is 0, and the rest None, where the scan shows no surface there.
    """

    target: Target
    points: int
    offset_mm: float | None = None
    sigma_mm: float | None = None
    sigmas: float | None = None


def sweep_overlap(read: Read) -> Drift:
    """Compare the first and the last sweep of a scan; ``read`` gives its POINTS anew at each call.

    Raises
    ------
    InputError
        The scan is not more than one turn, or too few frames of both sweeps show the same rows.
    """
    frames, angles = _frame_angles(read())
    travelled = np.abs(np.unwrap(angles) - angles[0]) if len(angles) else np.zeros(0)
    total = float(travelled[-1]) if len(travelled) else 0.0
    if total <= math.tau:
        raise InputError(
            f"the scan goes over {math.degrees(total):.4g} deg: no angle is seen twice",
            hint="give --target, or scan more than one turn (such as 400 deg)",
        )
    # The last sweep that has room for a comparison: of 720.5 deg, not the half degree at the end.
    back = math.tau * max(1, math.floor((total - min(0.6, total - math.tau)) / math.tau))
    late = np.flatnonzero(travelled >= back - 1e-9)
    late = late[np.linspace(0, len(late) - 1, min(MOST_PAIRS, len(late))).round().astype(int)]
    after = np.searchsorted(travelled, travelled[late] - back + 1e-9, side="right")
    before = np.clip(after - 1, 0, len(travelled) - 1)
    after = np.clip(after, 0, len(travelled) - 1)
    wanted = np.unique(np.concatenate([frames[late], frames[before], frames[after]]))
    held = _rows_of(read(), wanted)
    pairs = []
    for j, i, k in zip(late, before, after, strict=True):
        gap = float(travelled[k] - travelled[i])
        weight = 0.0 if gap <= 0 else float((travelled[j] - back - travelled[i]) / gap)
        found = _pair(held[frames[i]], held[frames[k]], min(max(weight, 0.0), 1.0), held[frames[j]])
        if found is not None:
            pairs.append(found)
    if len(pairs) < _FEWEST_PAIRS:
        raise InputError(
            f"only {len(pairs)} frames of the last sweep show the rows of the first one",
            hint="scan some frames more than one turn, or give --target",
        )
    return _drift(total / math.tau, pairs)


@dataclass(frozen=True)
class _Pair:
    """Medians over the rows of one frame: change of range and of u, error of the former."""

    points: int
    change_mm: float
    change_px: float
    error_mm: float
    noise_mm: float


def _frame_angles(batches: Iterator[Columns]) -> tuple[npt.NDArray[np.int64], Floats]:
    frames, angles = [], []
    for columns in batches:
        names, first = np.unique(columns["frame"], return_index=True)
        frames.append(names.astype(np.int64))
        angles.append(columns["angle_rad"][first].astype(np.float64))
    if not frames:
        return np.zeros(0, np.int64), np.zeros(0)
    joined, first = np.unique(np.concatenate(frames), return_index=True)
    return joined, np.concatenate(angles)[first]


Held = dict[str, npt.NDArray[Any]]


def _rows_of(batches: Iterator[Columns], wanted: npt.NDArray[np.int64]) -> dict[int, Held]:
    """Key (laser and row), range and u of the wanted frames, sorted by key."""
    parts: dict[int, list[Held]] = {int(f): [] for f in wanted}
    for columns in batches:
        frame = columns["frame"].astype(np.int64)
        for name in np.intersect1d(wanted, frame):
            some = slice(*np.searchsorted(frame, [name, name + 1]))
            key = columns["laser"][some].astype(np.int64) << 32 | columns["row"][some].astype(np.int64)
            values = {n: columns[n][some].astype(np.float64) for n in ("range_mm", "u_px")}
            parts[int(name)].append({"key": key, **values})
    out = {}
    for frame_number, pieces in parts.items():
        joined = {n: np.concatenate([p[n] for p in pieces]) for n in ("key", "range_mm", "u_px")}
        order = np.argsort(joined["key"], kind="stable")
        out[frame_number] = {n: a[order] for n, a in joined.items()}
    return out


def _pair(before: Held, after: Held, weight: float, late: Held) -> _Pair | None:
    """``late`` against the two frames of the first sweep around its angle, interpolated."""
    shared, a, b = np.intersect1d(before["key"], after["key"], return_indices=True)
    _, s, late_at = np.intersect1d(shared, late["key"], return_indices=True)
    if len(s) < 8:
        return None

    def change(name: str) -> Floats:
        first = before[name][a[s]] * (1.0 - weight) + after[name][b[s]] * weight
        return np.asarray(late[name][late_at] - first)

    ranges = change("range_mm")
    middle = float(np.median(ranges))
    noise = _MAD_TO_SIGMA * float(np.median(np.abs(ranges - middle)))
    error = _MEDIAN_ERROR * noise / math.sqrt(len(s))
    return _Pair(len(s), middle, float(np.median(change("u_px"))), error, noise / math.sqrt(2.0))


def _drift(turns: float, pairs: list[_Pair]) -> Drift:
    change = np.array([p.change_mm for p in pairs])
    error = np.maximum([p.error_mm for p in pairs], 1e-9)
    count = len(pairs)
    # Robust against a surface that is seen in one sweep only: medians of medians.
    bias = float(np.median(change))
    spread = float(np.sqrt(max(0.0, np.median(change**2) - float(np.median(error**2)))))
    # Rows of a frame share what is wrong with them (a rough surface, an angle that is a little off),
    # so the frames' own scatter is counted when it is more than the rows explain.
    scatter = _MAD_TO_SIGMA * float(np.median(np.abs(change - bias)))
    each = max(scatter, float(np.median(error)))
    uniform = abs(bias) / (_MEDIAN_ERROR * each / math.sqrt(count))
    return Drift(
        turns=turns,
        pairs=count,
        points=sum(p.points for p in pairs),
        bias_mm=bias,
        bias_px=float(np.median([p.change_px for p in pairs])),
        drift_mm=max(abs(bias), spread),
        noise_mm=float(np.median([p.noise_mm for p in pairs])),
        sigmas=max(uniform, scatter / float(np.median(error))),
    )


def target_offsets(batches: Iterable[Columns], targets: list[Target]) -> list[TargetOffset]:
    """How far the scanned surface lies from each target; points are taken from POINTS, streaming."""
    near: list[list[Floats]] = [[] for _ in targets]
    for columns in batches:
        points = np.stack([columns[f"{n}_mm"] for n in "xyz"], axis=1).astype(np.float64)
        for target, some in zip(targets, near, strict=True):
            away = points - (target.x_mm, target.y_mm, target.z_mm)
            some.append(away[np.einsum("ij,ij->i", away, away) <= target.within_mm**2])
    return [_offset(t, np.concatenate(some)) for t, some in zip(targets, near, strict=True)]


def _offset(target: Target, away: Floats) -> TargetOffset:
    """A plane through points near the target (relative to it), and its distance along the normal."""
    if len(away) < 12:
        return TargetOffset(target, 0)
    kept = away
    for _ in range(5):
        middle = kept.mean(axis=0)
        normal = np.linalg.svd(kept - middle, full_matrices=False)[2][2]
        left = (away - middle) @ normal
        sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(left - np.median(left)))), 1e-6)
        kept = away[np.abs(left) <= 3.0 * sigma]
        if len(kept) < 12:
            return TargetOffset(target, 0)
    outward = np.array([target.x_mm, target.y_mm, target.z_mm])
    if normal @ outward < 0:
        normal = -normal
    # The plane's height at the target itself: the error of the mean, and of the tilt at that place.
    middle = kept.mean(axis=0)
    spread = np.linalg.svd(kept - middle, compute_uv=False)[1]
    lever = float(np.linalg.norm(middle - (middle @ normal) * normal)) / max(float(spread), 1e-9)
    rms = float(np.sqrt(np.mean(((kept - middle) @ normal) ** 2)))
    fit = rms * math.sqrt(1.0 / len(kept) + lever**2)
    offset = float(middle @ normal)
    error = math.hypot(target.sd_mm, fit)
    return TargetOffset(target, len(kept), offset, error, abs(offset) / max(error, 1e-9))
