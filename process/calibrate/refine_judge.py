"""How the observations fit the joint solution: references one by one, and boards against each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.errors import CalibrationError
from .refine_blocks import Block
from .refine_data import Data
from .refine_solve import Solution, matrix_of, weights_of
from .refine_state import Layout

Floats = npt.NDArray[np.float64]

#: A reference that is so many sigmas off contradicts the rest: by chance one in 16,000.
CONTRADICTS = 4.0
_LEAST_REDUNDANCY = 1e-6


@dataclass(frozen=True)
class Reference:
    """One reference: stated and found, ``off_mm`` what the rest says without it, that in sigmas.

    ``before_mm`` is what is left after the adjustment, found minus stated.
    """

    kind: str
    name: str
    stated_mm: float
    sd_mm: float
    found_mm: float
    off_mm: float
    sigmas: float


def judged_references(data: Data, layout: Layout, solution: Solution) -> tuple[Reference, ...]:
    """Each reference against all other observations (Baarda's test of one residual)."""
    out = []
    kinds = {"walls": data.walls, "spheres": data.spheres, "lengths": data.lengths}
    for block in solution.blocks:
        known = kinds.get(block.kind)
        if known is None:
            continue
        j = matrix_of([block], layout).toarray()
        taken = np.einsum("ni,ij,nj->n", j, solution.inverse, j)
        redundancy = np.maximum(1.0 - taken, _LEAST_REDUNDANCY)
        # The weight of a length also holds the noise of its ends.
        unit = 1.0 / np.abs(j).max(axis=1) if block.kind != "lengths" else known.sd_mm
        for i, name in enumerate(known.names):
            value = float(block.values[i])
            sd = float(known.sd_mm[i]) if block.kind != "lengths" else float(unit[i])
            out.append(
                Reference(
                    kind=block.kind,
                    name=name,
                    stated_mm=float(known.value_mm[i]),
                    sd_mm=float(known.sd_mm[i]),
                    found_mm=float(known.value_mm[i]) + value * sd,
                    off_mm=value * sd / float(redundancy[i]),
                    sigmas=value / float(np.sqrt(redundancy[i])),
                )
            )
    return tuple(out)


def contradictions(references: Sequence[Reference]) -> None:
    """Refuse references that the rest of the observations exclude, or that exclude each other.

    Raises
    ------
    CalibrationError
        One is more than four sigmas off what all the others say; the message says how many mm.
    """
    wrong = [r for r in references if abs(r.sigmas) > CONTRADICTS]
    if not wrong:
        return
    worst = max(wrong, key=lambda r: abs(r.sigmas))
    others = [r.name for r in wrong if r is not worst]
    more = f"; so do {', '.join(others)}" if others else ""
    raise CalibrationError(
        f"{worst.name} contradicts the rest: stated {worst.stated_mm:g} mm (sd {worst.sd_mm:g}), all "
        f"the others say {worst.stated_mm + worst.off_mm:.2f} mm, {abs(worst.off_mm):.2f} mm or "
        f"{abs(worst.sigmas):.1f} sigma off{more}",
        hint="measure it again (from the camera's centre, square to the wall), state an honest sd, or "
        "leave it out",
    )


@dataclass(frozen=True)
class Pulls:
    """How boards and walls pull against each other.

    ``birge`` (>= 1) is Birge's ratio: how much harder they pull at the calibration than noise would.
    ``without`` (C, m): of each cluster (a board's number; walls and spheres after them), in order of
    ``cluster`` (C,), by how much the calibration's m unknowns would move without it.
    """

    birge: float
    cluster: npt.NDArray[np.int64]
    without: Floats


def pulls(layout: Layout, solution: Solution) -> Pulls:
    """What each cluster says of the calibration against all the others.

    As ``covariance._birge``: the unknowns of each cluster are eliminated from its own normal equations,
    which leaves what the cluster says of the calibration alone.
    """
    inner = layout.calibration
    blocks = solution.blocks
    weight = np.concatenate([weights_of(b) for b in blocks])
    value = np.concatenate([b.values for b in blocks])
    cluster = np.concatenate([_clusters(b, i) for i, b in enumerate(blocks)])
    j = matrix_of(blocks, layout)
    inverse = solution.inverse[:inner, :inner]
    whole = np.asarray(np.linalg.inv(inverse), np.float64)
    pull, free, spread = 0.0, 0.0, 0.0
    each, without = [], []
    for number in np.unique(cluster):
        mine = np.flatnonzero(cluster == number)
        rows = j[mine]
        w = weight[mine]
        own = np.unique(rows.indices)
        own = own[own >= inner]
        a = rows[:, :inner].toarray()
        b = rows[:, own].toarray()
        gradient = a.T @ (w * value[mine])
        normal = a.T @ (w[:, None] * a)
        if len(own):
            mixed = b.T @ (w[:, None] * a)
            core = np.linalg.pinv(b.T @ (w[:, None] * b), hermitian=True, rcond=1e-13)
            gradient = gradient - mixed.T @ (core @ (b.T @ (w * value[mine])))
            normal = normal - mixed.T @ core @ mixed
        pull += float(gradient @ inverse @ gradient)
        # What is left of a cluster's own say, and the variance of its square, when all is noise.
        part = inverse @ normal
        rest = part - part @ part
        free += float(np.trace(rest))
        spread += 2.0 * float(np.einsum("ij,ji->", rest, rest))
        each.append(int(number))
        without.append(_without(whole, normal, gradient))
    clusters, moves = np.array(each, np.int64), np.array(without).reshape(-1, inner)
    if len(each) < 4 or free <= 0.05 * inner:
        return Pulls(1.0, clusters, moves)
    ratio = pull / free
    chance = 1.0 + 3.0 * float(np.sqrt(spread)) / free
    return Pulls(float(np.sqrt(ratio)) if ratio > chance else 1.0, clusters, moves)


def _without(whole: Floats, normal: Floats, gradient: Floats) -> Floats:
    """How far the unknowns move when a cluster is taken out; 0 where the others do not hold them."""
    rest = whole - normal
    unit = 1.0 / np.sqrt(np.diag(whole))
    weights, axes = np.linalg.eigh(rest * np.outer(unit, unit))
    held = weights > 1e-9 * weights.max()
    step = (axes[:, held].T @ (gradient * unit)) / weights[held]
    return np.asarray(unit * (axes[:, held] @ step), np.float64)


def _clusters(block: Block, number: int) -> npt.NDArray[np.int64]:
    # Residuals of no cluster (lengths) stand each for itself.
    if (block.cluster == -2).all():
        return -10 - 1000 * number - np.arange(len(block.cluster))
    return np.asarray(block.cluster, np.int64)
