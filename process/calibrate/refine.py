"""`calibrate refine`: one robust adjustment of camera, planes and axis to everything that was seen.

Estimated one after the other, the laser's plane takes over the camera's errors where the boards stood
and carries them, grown, to where they did not. Together, stripes on boards also speak about the
camera, and a wall at a known distance about all parts at the range where it matters. The covariance
of the result holds the cross terms, without which the uncertainty of a range is several times too
large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Calibration, Intrinsics, Joint, Matrix
from ...schemas.errors import CalibrationError, InputError
from ...schemas.observations import Observations
from .camera import free_directions
from .refine_data import Data, check_references, data_of, joined
from .refine_judge import Pulls, Reference, contradictions, judged_references, pulls
from .refine_parts import document_slopes, origin_height_mm, with_origin
from .refine_solve import Solution, solve
from .refine_start import first_sigmas, first_state, with_references
from .refine_state import Layout, State
from .start import Fix

Floats = npt.NDArray[np.float64]

#: Numbers that may be held, by their place in the camera's ten; aspect and principal-point go by name.
_SINGLE: tuple[tuple[int, Fix], ...] = (
    (4, "skew"),
    (5, "k1"),
    (6, "k2"),
    (7, "p1"),
    (8, "p2"),
    (9, "k3"),
)


@dataclass(frozen=True)
class Refined:
    """The adjusted parts with their joint covariance, and how the observations fit.

    ``order`` and ``covariance`` are those of the document's joint part; ``slopes`` is how its numbers
    follow the calibration's unknowns. By ``birge`` (>= 1) sigmas were enlarged because boards or walls
    contradict each other; ``pulls`` says which do.
    """

    start: Calibration
    solution: Solution
    data: Data
    layout: Layout
    order: tuple[str, ...]
    covariance: Floats
    slopes: Floats
    pulls: Pulls
    references: tuple[Reference, ...]
    fixed: tuple[Fix, ...]

    @property
    def state(self) -> State:
        """The solution's state."""
        return self.solution.state

    @property
    def birge(self) -> float:
        """How much all sigmas were enlarged."""
        return self.pulls.birge

    def calibration(self) -> Calibration:
        """The document: parts that were adjusted with their joint covariance, others as they were."""
        s, d = self.state, self.data
        joint = Joint(order=self.order, covariance=_plain(self.covariance))
        camera: Intrinsics = s.intrinsics(d.width_px, d.height_px).model_copy(
            update={"covariance": joint.block("intrinsics")}
        )
        planes = []
        for plane, n, h in zip(self.start.lasers, s.normals, s.distances_mm, strict=True):
            role = f"plane/{plane.laser}"
            if not joint.numbers(role):
                planes.append(plane)
                continue
            values = {"normal": _three(n), "distance_mm": float(h)}
            planes.append(plane.model_copy(update={**values, "covariance": joint.block(role)}))
        axis = self.start.turntable
        if axis is not None and self.layout.axis:
            values = {"point_mm": _three(s.point_mm), "direction": _three(s.direction)}
            axis = axis.model_copy(update={**values, "covariance": joint.block("axis")})
        fields = self.start.model_dump()
        fields.update(
            camera=camera.model_dump(),
            lasers=[p.model_dump() for p in planes],
            turntable=None if axis is None else axis.model_dump(),
            joint=joint.model_dump(),
        )
        return Calibration.model_validate(fields)


def refine(
    several: Sequence[Observations], start: Calibration, *, fix: Sequence[Fix] | None = None
) -> Refined:
    """Adjust ``start`` to all observations at once.

    ``fix`` names what is held of the camera (:data:`camera.FIXABLE`); None holds what has no variance
    in ``start``, or skew where it states none.

    Raises
    ------
    InputError
        There are no boards, or the observations do not go together.
    CalibrationError
        ``start`` lacks a part, the observations do not fix the unknowns, or references contradict the
        rest or each other.
    """
    seen = joined(several)
    check_references(seen)
    if not seen.boards:
        raise InputError(
            "no boards are among the observations, and nothing else fixes the camera",
            hint="calibrate camera ... --observations F.json saves them",
        )
    # Planes that no stripe was seen of stay as they are.
    used = {s.laser for b in seen.boards for s in b.stripes}
    seen_at = [e for w in seen.walls for e in w.stripes]
    seen_at += [e for b in seen.spheres for e in b.stripes]
    seen_at += [e for x in seen.lengths for e in x.ends]
    wanted = {e.stripe.laser for e in seen_at}
    if wanted - used:
        raise CalibrationError(
            f"laser {min(wanted - used)} is seen on a reference, but on no board",
            hint="calibrate plane ... --observations F.json saves the stripes on boards",
        )
    active = start.model_copy(
        update={
            "lasers": tuple(p for p in start.lasers if p.laser in used),
            "quality": None,
            "joint": None,
        }
    )
    fixed = tuple(fix) if fix is not None else held(start.intrinsics_or_fail())
    data, layout, solution = _solved(seen, active, fixed)
    references = judged_references(data, layout, solution)
    contradictions(references)
    pulled = pulls(layout, solution)
    height_mm = origin_height_mm(data, first_state(data, active), active)
    order, lift = document_slopes(data, layout, solution.state, active, height_mm)
    covariance = pulled.birge**2 * lift @ solution.inverse @ lift.T
    full = replace(
        with_origin(data, solution.state, active, height_mm),
        normals=np.array([p.normal for p in start.lasers], np.float64).reshape(-1, 3),
        distances_mm=np.array([p.distance_mm for p in start.lasers], np.float64),
    )
    for i, plane in enumerate(start.lasers):
        if plane.laser in used:
            k = [p.laser for p in active.lasers].index(plane.laser)
            full.normals[i] = solution.state.normals[k]
            full.distances_mm[i] = solution.state.distances_mm[k]
    return Refined(
        start=start,
        solution=replace(solution, state=full),
        data=data,
        layout=layout,
        order=order,
        covariance=0.5 * (covariance + covariance.T),
        pulls=pulled,
        slopes=lift[:, : layout.calibration],
        references=references,
        fixed=fixed,
    )


def _solved(
    seen: Observations, start: Calibration, fixed: Sequence[Fix]
) -> tuple[Data, Layout, Solution]:
    """The solution; references come in when boards alone have said how good boards and stripes are.

    Otherwise a wrong reference would only make the boards look bad.
    """
    references = {"walls": (), "spheres": (), "lengths": ()}
    alone = seen.model_copy(update=references)
    data, layout = _problem(alone, start, fixed)
    state = first_state(data, start)
    solution = solve(data, layout, state, first_sigmas(data, layout, state))
    if alone == seen:
        return data, layout, solution
    data, layout = _problem(seen, start, fixed)
    state = with_references(data, solution.state)
    return data, layout, solve(data, layout, state, solution.sigmas, known=True)


def _problem(seen: Observations, start: Calibration, fixed: Sequence[Fix]) -> tuple[Data, Layout]:
    data = data_of(seen, start)
    turned = data.turned
    layout = Layout.of(
        free_directions(fixed),
        len(start.lasers),
        len(seen.boards),
        0 if turned is None else int(turned.body.max()) + 1,
        0 if turned is None else len(turned.nominal_rad),
        len(seen.walls),
        len(seen.spheres),
        len(data.board_of_stripe),
        exact_angles=turned is not None and turned.sd_rad == 0.0,
        sized=turned is not None and turned.size_sd > 0.0,
    )
    return data, layout


def held(camera: Intrinsics) -> tuple[Fix, ...]:
    """What a calibration of the camera held: numbers without variance, or skew if none is stated."""
    if camera.covariance is None:
        return () if camera.skew else ("skew",)
    variance = np.diag(np.array(camera.covariance))
    out: list[Fix] = [name for i, name in _SINGLE if variance[i] == 0.0]
    c = np.array(camera.covariance)
    if variance[2] == 0.0 and variance[3] == 0.0:
        out.append("principal-point")
    if variance[0] > 0 and abs(c[0, 1]) >= (1.0 - 1e-9) * np.sqrt(variance[0] * variance[1]):
        out.append("aspect")
    return tuple(out)


def _three(v: Floats) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def _plain(matrix: Floats) -> Matrix:
    return tuple(tuple(float(a) for a in row) for row in matrix)
