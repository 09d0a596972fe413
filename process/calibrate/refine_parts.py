"""From the unknowns of the joint adjustment to the numbers of the document, with their slopes.

Where along itself an axis has its origin is a choice, and it follows what was seen: the table's top, or
the place beside the camera. The adjustment leaves it where it began, so it is set here by the rule that
`calibrate axis` has; else its z, and the sigma of it, would be those of an older axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Calibration
from .axis_adjust import Sightings, Turning
from .axis_result import origin_of
from .refine_data import Data
from .refine_state import Layout, State, moved, tangents_of

Floats = npt.NDArray[np.float64]

_STEP = 1e-5


def origin_height_mm(data: Data, state: State, start: Calibration) -> float:
    """How far along the axis the origin of ``start`` is from where the rule has it in ``state``."""
    if data.turned is None:
        return 0.0
    axis = start.axis_or_fail()
    gap = np.array(axis.point_mm) - _origin(data, state, start, 0.0)
    return float(gap @ state.direction)


def with_origin(data: Data, state: State, start: Calibration, height_mm: float) -> State:
    """The state with the axis' point where the rule has it, and so far along the axis from there."""
    if data.turned is None:
        return state
    return replace(state, point_mm=_origin(data, state, start, height_mm))


def document_slopes(
    data: Data, layout: Layout, state: State, start: Calibration, height_mm: float
) -> tuple[tuple[str, ...], Floats]:
    """The order of the document's numbers, and how they follow all unknowns: (rows, P)."""
    order = ["intrinsics", *(f"plane/{p.laser}" for p in start.lasers)]
    rows = 10 + 4 * len(start.lasers) + (6 if layout.axis else 0)
    out = np.zeros((rows, layout.width))
    m = layout.free.shape[1]
    out[:10, :m] = layout.free
    for k, basis in enumerate(tangents_of(state.normals)):
        at = m + 3 * k
        out[10 + 4 * k : 13 + 4 * k, at : at + 2] = basis
        out[13 + 4 * k, at + 2] = 1.0
    if layout.axis:
        order.append("axis")
        # The origin follows the bodies, too: they lie on the table's top.
        for k in (*layout.axis, *layout.bodies, *layout.size):
            ends = []
            for sign in (_STEP, -_STEP):
                x = np.zeros(layout.width)
                x[k] = sign
                s = moved(state, layout, x).state
                ends.append(np.concatenate([_origin(data, s, start, height_mm), s.direction]))
            out[-6:, k] = (ends[0] - ends[1]) / (2.0 * _STEP)
    return tuple(order), out


def _origin(data: Data, state: State, start: Calibration, height_mm: float) -> Floats:
    t = data.turned
    assert t is not None
    turning = Turning(
        state.point_mm, state.direction, state.body_turns, state.body_shifts_mm, state.phi_rad
    )
    seen = Sightings(t.frame, t.body, state.size * t.points_mm, t.seen_px)
    return origin_of(turning, seen, start.axis_or_fail().head) + height_mm * state.direction
