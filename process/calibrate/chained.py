"""The joint covariance of parts that were estimated one after the other.

A plane (or an axis) that was estimated with a camera held follows that camera: to first order
``plane = plane_0 + B (camera - camera_0)`` beside its own noise of covariance K. So if the camera has
the covariance C, the plane has ``K + B C B'``, and ``B C`` is what the two have in common. Without this
term the range of a point, in which most of both errors cancels where the boards were, would be stated
many times too uncertain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Calibration, Joint, LaserPlane, Matrix, TurntableAxis

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Follower:
    """A new part, its covariance (n, n) for the other parts as given, and how it follows those.

    ``by`` maps a role (``intrinsics``, ``plane/0``) to slopes (n, k) of the part's numbers by that
    role's. None: nobody knows how it follows them, and ``part`` states a covariance by itself.
    """

    part: LaserPlane | TurntableAxis
    own: Floats
    by: Mapping[str, Floats] | None

    @property
    def role(self) -> str:
        """``plane/<laser>`` or ``axis``."""
        return f"plane/{self.part.laser}" if isinstance(self.part, LaserPlane) else "axis"


def chained(document: Calibration, followers: Sequence[Follower]) -> Calibration:
    """``document`` with new parts, their covariances, and the joint covariance of all that is known.

    What the document knew of parts that stay, stays. A camera without covariance counts as exact: then
    there is nothing in common, and no joint covariance.
    """
    order, known = _known(document, [f.role for f in followers])
    planes = {p.laser: p for p in document.lasers}
    axis = document.turntable
    for f in followers:
        part: Any = f.part
        if f.by is not None:
            share = np.zeros((len(f.own), len(known)))
            for role, slopes in f.by.items():
                at = _numbers(order, role)
                share[:, at] = slopes[:, : len(at)]
            common = share @ known
            own = _symmetric(f.own + common @ share.T)
            part = part.model_copy(update={"covariance": _plain(own)})
            if order:
                known = np.block([[known, common.T], [common, own]])
                order.append(f.role)
        if isinstance(part, LaserPlane):
            planes[part.laser] = part
        else:
            axis = part
    joint = Joint(order=tuple(order), covariance=_plain(_symmetric(known))) if len(order) > 1 else None
    return document.model_copy(
        update={
            "lasers": tuple(planes[n] for n in sorted(planes)),
            "turntable": axis,
            "joint": joint,
        }
    )


def _known(document: Calibration, replaced: Sequence[str]) -> tuple[list[str], Floats]:
    """The roles whose covariance is known with all cross terms, and that; without those replaced."""
    joint = document.joint
    if joint is not None:
        order = [role for role in joint.order if role not in replaced]
        return order, np.array(joint.block(*order), np.float64).reshape(-1, sum(map(_count, order)))
    camera = document.camera
    if camera is None or camera.covariance is None:
        return [], np.zeros((0, 0))
    return ["intrinsics"], np.array(camera.covariance, np.float64)


def _count(role: str) -> int:
    return {"intrinsics": 10, "plane": 4, "axis": 6}[role.partition("/")[0]]


def _numbers(order: Sequence[str], role: str) -> range:
    """Where the numbers of ``role`` stand; empty where it counts as exact."""
    start = 0
    for other in order:
        if other == role:
            return range(start, start + _count(role))
        start += _count(other)
    return range(0)


def _symmetric(matrix: Floats) -> Floats:
    return np.asarray(0.5 * (matrix + matrix.T), np.float64)


def _plain(matrix: Floats) -> Matrix:
    return tuple(tuple(float(a) for a in row) for row in matrix)
