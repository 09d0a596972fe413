"""Robust least squares of the joint adjustment: SciPy's trust region, sparse and preconditioned.

The unknowns differ by ten orders of magnitude in scale and a hundredfold in how well they are known,
so the step is counted in the Cholesky factor of the normal matrix: there the problem is round, and
LSMR needs few products. Between rounds the sigmas of corners and stripes are estimated from the
residuals (variance components).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import linalg, optimize, sparse

from ...schemas.errors import CalibrationError
from .refine_blocks import Block, Sigmas
from .refine_data import Data
from .refine_references import ends_noise_mm
from .refine_residuals import residuals
from .refine_state import Chart, Layout, State, moved

Floats = npt.NDArray[np.float64]

#: Residuals beyond so many sigmas count linearly (Huber).
HUBER = 3.0
_ROUNDS = 10
_SETTLED = 0.03
_SINGULAR = 1e-13
#: Kinds with thousands of residuals, of which a few say nothing.
_MANY = ("corners", "turning", "stripes", "wall stripes", "sphere stripes")
#: Kinds of deviations that are expected to be zero, and how far their variance may leap in a round.
_PRIORS = ("bends", "twists")
_LEAP = (0.04, 25.0)
#: A corner is never better than this; perfect ones would make the rest weightless.
_LEAST_PX = 1e-4
#: No board is known to be flatter.
_FLAT_MM = 0.01


@dataclass(frozen=True)
class Solution:
    """State, sigmas, residual blocks and the normal matrix (P, P) with its inverse at the minimum.

    ``condition`` is that of the unknowns, each scaled to its own curvature.
    """

    state: State
    sigmas: Sigmas
    blocks: list[Block]
    normal: Floats
    inverse: Floats
    condition: float


def solve(data: Data, layout: Layout, start: State, sigmas: Sigmas, *, known: bool = False) -> Solution:
    """The minimum that is reached from ``start``.

    ``known``: the sigmas of boards and table are what they are, and only those of references are found.

    Raises
    ------
    CalibrationError
        The observations do not fix the unknowns, or the state leads nowhere from the start.
    """
    state = start
    for _ in range(_ROUNDS):
        chart = moved(state, layout, np.zeros(layout.width))
        sigmas = replace(sigmas, ends_mm=ends_noise_mm(data, layout, chart))
        state = _round(data, layout, state, sigmas)
        blocks = residuals(data, layout, moved(state, layout, np.zeros(layout.width)), sigmas)
        normal = _normal(blocks, layout)
        inverse = _inverse(normal)
        better = _components(data, blocks, layout, inverse, sigmas)
        if known:
            found = {n: getattr(better, n) for n in ("wall", "sphere", "wall_memory")}
            better = replace(sigmas, **found)
        change = max(
            abs(np.log(getattr(better, n) / getattr(sigmas, n)))
            for n in (
                "corner_px",
                "turned_px",
                "stripe",
                "wall",
                "sphere",
                "bend_mm",
                "twist_mm",
                "memory",
            )
        )
        if change < _SETTLED:
            break
        sigmas = better
    return Solution(state, sigmas, blocks, normal, inverse, _condition(normal))


def matrix_of(blocks: Sequence[Block], layout: Layout) -> sparse.csr_matrix:
    """All slopes as one sparse matrix (N, P), rows in the order of the blocks."""
    rows, columns, values, at = [], [], [], 0
    for b in blocks:
        count, width = b.slopes.shape
        rows.append(np.repeat(np.arange(at, at + count), width))
        columns.append(b.columns.ravel())
        values.append(b.slopes.ravel())
        at += count
    place = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(values), place), shape=(at, layout.width))


def weights_of(block: Block) -> Floats:
    """Huber's weights of a block's residuals; 1 for exact ones."""
    if block.exact:
        return np.ones(len(block.values))
    return np.minimum(1.0, HUBER / np.maximum(np.abs(block.values), 1e-300))


def _normal(blocks: Sequence[Block], layout: Layout) -> Floats:
    j = matrix_of(blocks, layout)
    w = np.concatenate([weights_of(b) for b in blocks])
    return np.asarray((j.T @ j.multiply(w[:, None])).toarray(), np.float64)


def _factor(normal: Floats) -> tuple[Floats, Floats]:
    """Scales that make the diagonal 1, and the lower Cholesky factor of the matrix that they scale."""
    diagonal = np.diag(normal)
    if not np.isfinite(normal).all() or (diagonal <= 0).any():
        raise _unfixed()
    scale = 1.0 / np.sqrt(diagonal)
    try:
        factor = linalg.cholesky(normal * np.outer(scale, scale), lower=True)
    except linalg.LinAlgError as error:
        raise _unfixed() from error
    # What is left of an unknown's curvature when those before it are free.
    if np.square(np.diag(factor)).min() < _SINGULAR:
        raise _unfixed()
    return scale, np.asarray(factor, np.float64)


def _inverse(normal: Floats) -> Floats:
    scale, factor = _factor(normal)
    half = linalg.solve_triangular(factor, np.diag(scale), lower=True)
    return np.asarray(half.T @ half, np.float64)


def _condition(normal: Floats) -> float:
    scale = 1.0 / np.sqrt(np.diag(normal))
    values = np.linalg.eigvalsh(normal * np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-300)))


def _unfixed() -> CalibrationError:
    return CalibrationError(
        "the observations do not fix all that is to be estimated",
        hint="add boards at other tilts and ranges (calibrate camera and plane --observations), "
        "or hold something (--fix)",
    )


def _round(data: Data, layout: Layout, state: State, sigmas: Sigmas) -> State:
    """One adjustment with all sigmas held."""
    first = residuals(data, layout, moved(state, layout, np.zeros(layout.width)), sigmas)
    if not all(np.isfinite(b.values).all() for b in first):
        raise CalibrationError(
            "some observations lie where the calibration that was given has no rays or planes",
            hint="start from the calibration that the observations were made with",
        )
    normal = _normal(first, layout)
    scale, factor = _factor(normal)

    def step(z: Floats) -> Floats:
        return scale * linalg.solve_triangular(factor, z, lower=True, trans="T")

    last: list[tuple[bytes, list[Block]]] = []

    def blocks_at(z: Floats) -> list[Block]:
        key = z.tobytes()
        if not last or last[0][0] != key:
            last[:] = [(key, residuals(data, layout, moved(state, layout, step(z)), sigmas))]
        return last[0][1]

    def values(z: Floats) -> Floats:
        return np.concatenate([b.values for b in blocks_at(z)])

    def slopes(z: Floats) -> sparse.linalg.LinearOperator:
        j = matrix_of(blocks_at(z), layout)
        turned = j.T.tocsr()
        return sparse.linalg.LinearOperator(
            j.shape,
            matvec=lambda x: j @ step(np.ravel(x)),
            rmatvec=lambda y: linalg.solve_triangular(
                factor, scale * (turned @ np.ravel(y)), lower=True
            ),
            dtype=np.float64,
        )

    exact = np.concatenate([np.full(len(b.values), b.exact) for b in first])

    def loss(square: Floats) -> Floats:
        """Huber's rho and its two derivatives by the square, for what may be an outlier."""
        far = (square > 1.0) & ~exact
        root = np.sqrt(np.where(far, square, 1.0))
        return np.stack(
            [
                np.where(far, 2.0 * root - 1.0, square),
                np.where(far, 1.0 / root, 1.0),
                np.where(far, -0.5 / root**3, 0.0),
            ]
        )

    # SciPy's first trust region is 1 in units of x_scale: let it be the step that a linear problem
    # takes.
    weight = np.concatenate([weights_of(b) for b in first])
    descent = slopes(np.zeros(layout.width)).rmatvec(weight * values(np.zeros(layout.width)))
    found = optimize.least_squares(
        values,
        np.zeros(layout.width),
        jac=slopes,
        x_scale=2.0 * max(1.0, float(np.linalg.norm(descent))),
        tr_options={"regularize": False, "atol": 1e-12, "btol": 1e-12, "maxiter": 60},
        loss=loss,
        f_scale=HUBER,
        tr_solver="lsmr",
        ftol=1e-11,
        xtol=1e-11,
        gtol=1e-9,
        max_nfev=60,
    )
    if not np.isfinite(found.cost):
        raise _unfixed()
    chart: Chart = moved(state, layout, step(found.x))
    return chart.state


def _components(
    data: Data, blocks: Sequence[Block], layout: Layout, inverse: Floats, sigmas: Sigmas
) -> Sigmas:
    """Sigmas that make each kind's weighted squares equal its redundancy (Foerstner 1979).

    Corners have no stated sigma; stripes have, and are only ever enlarged.
    """
    changes: dict[str, float] = {}
    memory = {"stripes": sigmas.memory, "wall stripes": sigmas.wall_memory}
    walls = data.wall_points
    series = {
        "stripes": data.stripe,
        # A wall's stripes at each angle and of each laser by themselves.
        "wall stripes": np.unique(
            np.stack([walls.on, walls.laser, walls.phi_rad], axis=1), axis=0, return_inverse=True
        )[1].ravel(),
    }
    for b in blocks:
        if b.exact:
            continue
        w = weights_of(b)
        # Of single rows, whatever they have in common.
        values = b.values * np.sqrt(memory.get(b.kind, 1.0))
        if b.kind in memory:
            memory[b.kind] = _memory(values, series[b.kind])
        # The trace of J inverse J', each row weighted.
        redundancy = float(w.sum() - (inverse * _normal([b], layout)).sum())
        if redundancy > (5.0 if b.kind in _MANY else 0.5):
            ratio = float((w * values**2).sum() / redundancy)
            if b.kind in _PRIORS:
                # Of a deviation that is hardly seen the ratio says little: solved for its variance.
                seen = redundancy / float(w.sum())
                ratio = float(np.clip((ratio - 1.0 + seen) / seen, *_LEAP))
            changes[b.kind] = float(np.sqrt(ratio))

    def enlarged(name: str, kind: str) -> float:
        return max(1.0, float(getattr(sigmas, name)) * changes.get(kind, 1.0))

    return replace(
        sigmas,
        corner_px=max(_LEAST_PX, sigmas.corner_px * changes.get("corners", 1.0)),
        turned_px=max(_LEAST_PX, sigmas.turned_px * changes.get("turning", 1.0)),
        stripe=enlarged("stripe", "stripes"),
        wall=enlarged("wall", "wall stripes"),
        sphere=enlarged("sphere", "sphere stripes"),
        memory=memory["stripes"],
        wall_memory=memory["wall stripes"],
        bend_mm=max(_FLAT_MM, sigmas.bend_mm * changes.get("bends", 1.0)),
        twist_mm=max(_FLAT_MM, sigmas.twist_mm * changes.get("twists", 1.0)),
    )


def _memory(values: Floats, series: npt.NDArray[np.int64]) -> float:
    """How many neighbours err together: 1 + 2 sum of autocorrelations while they are positive.

    Over all ``series`` (stripes) at once, each a run of values. Speckle, paper and squares under a
    stripe move its centre over many rows alike, and then a thousand rows are not a thousand witnesses.
    """
    runs = [values[series == k] for k in range(int(series.max()) + 1)]
    longest = max(len(r) for r in runs) // 2
    power = float(sum(r @ r for r in runs))
    total = 1.0
    for lag in range(1, longest):
        together = float(sum(r[:-lag] @ r[lag:] for r in runs if len(r) > lag))
        # As many rows less as the lag takes from every run.
        share = together / power * len(values) / max(1, sum(max(0, len(r) - lag) for r in runs))
        if share < 2.0 / np.sqrt(len(values)):
            break
        total += 2.0 * share
    return total
