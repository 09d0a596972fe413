"""What residuals of the joint adjustment are made of: blocks, their columns, and their sigmas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .refine_state import Layout

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Block:
    """Residuals of one kind: ``values`` (N,), slopes (N, k) by the unknowns ``columns`` (N, k).

    ``cluster`` (N,) names what errs together: a board, a wall; -1 the turning table, -2 numbers.
    ``exact`` residuals are never taken for outliers.
    """

    kind: str
    values: Floats
    columns: Ints
    slopes: Floats
    cluster: Ints
    exact: bool = False


@dataclass(frozen=True)
class Sigmas:
    """What the residuals are divided by: sd of a corner's coordinate, px, of boards and turning bodies.

    ``stripe``, ``wall``, ``sphere`` enlarge the stated sigmas of stripe points; ``ends_mm`` (L,) is
    what the stripe's noise at both ends makes of each length; ``bend_mm`` and ``twist_mm`` are what the
    surface under a stripe is off its board's plane. ``memory`` and ``wall_memory`` (>= 1) say how many
    rows of a stripe err together.
    """

    corner_px: float
    turned_px: float
    stripe: float
    wall: float
    sphere: float
    ends_mm: Floats
    bend_mm: float
    twist_mm: float
    memory: float = 1.0
    wall_memory: float = 1.0


def camera_columns(layout: Layout, rows: int) -> Ints:
    """The camera's unknowns, in every one of ``rows`` rows."""
    return np.broadcast_to(np.arange(layout.free.shape[1]), (rows, layout.free.shape[1]))


def block_columns(first: int, size: int, number: Ints) -> Ints:
    """Unknowns of the block of ``size`` that each ``number`` (N,) names, counted from ``first``."""
    return first + size * number[:, None] + np.arange(size)


def axis_columns(layout: Layout, rows: int) -> Ints:
    """The axis' unknowns, if it has any, in every one of ``rows`` rows."""
    return np.broadcast_to(np.arange(layout.axis.start, layout.axis.stop), (rows, len(layout.axis)))
