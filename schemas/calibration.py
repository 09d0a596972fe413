"""The calibration document: camera intrinsics, laser planes, turntable axis, each with covariance.

All geometry is in camera space (X right, Y down, Z forward, mm) as docs/conventions.md draws it.
Each *part* has a content id of its own, so that a derivation's key can name just the parts that its
stages use. Unit vectors are normalised on the way in when they are within 1e-3 of unit length.
A joint adjustment also knows how the errors of the parts hang together: the part ``joint``.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal, Self, TypeGuard

from pydantic import Field, model_validator

from .canonical import digest
from .document import Model, check_version, parse_json, validate
from .errors import CalibrationError, DocumentError
from .quality import Gate, Quality, Verdict

FORMAT: Final = "turnscan.calibration"
VERSION: Final = 1

Vector = tuple[float, float, float]
Matrix = tuple[tuple[float, ...], ...]
Positive = Annotated[float, Field(gt=0)]
Head = Literal["rotates", "fixed"]
Turn = Literal["counterclockwise", "clockwise"]

_UNIT_TOLERANCE = 1e-3


def _norm(v: Vector) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _check_unit(name: str, v: Vector) -> float:
    n = _norm(v)
    if abs(n - 1.0) > _UNIT_TOLERANCE:
        raise ValueError(f"{name} has length {n:.6g}, expected 1 within {_UNIT_TOLERANCE:g}")
    return n


def _scaled(v: Vector, n: float) -> Vector:
    return (v[0] / n, v[1] / n, v[2] / n)


def _check_covariance(matrix: Matrix | None, size: int, order: str) -> None:
    """Symmetric, of the right size, with a non-negative diagonal and bounded correlations."""
    if matrix is None:
        return
    if len(matrix) != size or any(len(row) != size for row in matrix):
        raise ValueError(f"covariance must be {size} x {size}, in the order {order}")
    for i in range(size):
        if matrix[i][i] < 0:
            raise ValueError(f"covariance[{i}][{i}] is {matrix[i][i]:g}, a variance below zero")
    for i in range(size):
        for j in range(i):
            bound = math.sqrt(matrix[i][i] * matrix[j][j]) * (1 + 1e-6) + 1e-30
            if abs(matrix[i][j] - matrix[j][i]) > 1e-9 * bound + 1e-30:
                raise ValueError(f"covariance[{i}][{j}] differs from covariance[{j}][{i}]")
            if abs(matrix[i][j]) > bound:
                raise ValueError(f"covariance[{i}][{j}] means a correlation above 1")


class Part(Model):
    """One separately identified piece of a calibration."""

    def part_id(self) -> str:
        """Content id: SHA-256 (64 hex digits) over kind and fields, covariance included."""
        return digest(f"calibration-part/{type(self).__name__}", self.plain())


class Intrinsics(Part):
    """Camera intrinsics: Caltech/OpenCV five coefficients and skew (paper, formulas 6-11).

    ``xp = fx (xd + skew yd) + cx``, ``yp = fy yd + cy``; pixel centres at integers.
    """

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    skew: float = 0.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    covariance: Matrix | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_covariance(self.covariance, 10, "fx fy cx cy skew k1 k2 p1 p2 k3")
        return self


class LaserPlane(Part):
    """One laser sheet: the plane ``normal . X = distance_mm`` in camera space."""

    laser: Annotated[int, Field(ge=0, le=255)]
    normal: Vector
    distance_mm: float
    covariance: Matrix | None = None

    @model_validator(mode="before")
    @classmethod
    def _normalise(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        normal, distance = data.get("normal"), data.get("distance_mm")
        if not _is_vector(normal) or not isinstance(distance, (int, float)):
            return data
        n = _norm(normal)
        # A second pass over an already normalised document must not move a single bit of it.
        if abs(n - 1.0) <= _UNIT_TOLERANCE and abs(n - 1.0) > 1e-14:
            return {**data, "normal": _scaled(normal, n), "distance_mm": distance / n}
        return data

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_unit("normal", self.normal)
        _check_covariance(self.covariance, 4, "nx ny nz distance_mm")
        return self


class TurntableAxis(Part):
    """Where the turntable turns, and what its angle means.

    ``point_mm`` is the origin of turntable space, ``direction`` its z ("up"), both in camera space.
    x is ``x_direction``, else the camera's X, made perpendicular to ``direction``. A positive angle
    turns ``positive_turn`` about ``direction`` (counterclockwise: right-handed, seen from above).
    ``head = "fixed"``: the object turns; ``"rotates"``: camera and laser turn, the scene stands.
    """

    point_mm: Vector
    direction: Vector
    x_direction: Vector | None = None
    head: Head = "fixed"
    positive_turn: Turn = "counterclockwise"
    covariance: Matrix | None = None

    @model_validator(mode="before")
    @classmethod
    def _normalise(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        out = dict(data)
        for name in ("direction", "x_direction"):
            v = data.get(name)
            if _is_vector(v) and 1e-14 < abs(_norm(v) - 1.0) <= _UNIT_TOLERANCE:
                out[name] = _scaled(v, _norm(v))
        return out

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_unit("direction", self.direction)
        x = self.x_direction if self.x_direction is not None else (1.0, 0.0, 0.0)
        _check_unit("x_direction", x)
        if abs(sum(a * b for a, b in zip(x, self.direction, strict=True))) > 0.98:
            raise ValueError(
                "direction is within 12 degrees of the camera's X (or of x_direction), so x of "
                "turntable space is undefined; give an x_direction across the axis"
            )
        _check_covariance(self.covariance, 6, "point_mm (3) direction (3)")
        return self

    def camera_from_turntable(self) -> tuple[Vector, Vector, Vector]:
        """The axes x, y, z of turntable space as unit vectors in camera space (rotation columns)."""
        z = self.direction
        x0 = self.x_direction if self.x_direction is not None else (1.0, 0.0, 0.0)
        along = x0[0] * z[0] + x0[1] * z[1] + x0[2] * z[2]
        across = (x0[0] - along * z[0], x0[1] - along * z[1], x0[2] - along * z[2])
        x = _scaled(across, _norm(across))
        y = (
            z[1] * x[2] - z[2] * x[1],
            z[2] * x[0] - z[0] * x[2],
            z[0] * x[1] - z[1] * x[0],
        )
        return x, y, z

    def turn_sign(self) -> int:
        """Sign s of ``scene_from_turntable(angle) = Rz(s angle)``.

        An object that turned by +angle is turned back (-1); a head that turned by +angle carries
        its measurements with it (+1); a clockwise positive turn reverses either.
        """
        sign = 1 if self.head == "rotates" else -1
        return sign if self.positive_turn == "counterclockwise" else -sign


#: Numbers that the covariance of a part counts: intrinsics 10, a plane 4, the axis 6.
_NUMBERS = {"intrinsics": 10, "plane": 4, "axis": 6}


class Joint(Part):
    """Covariance of several parts together, cross terms included: what one joint adjustment knows.

    ``order`` names the roles whose numbers follow each other in ``covariance``, each in the order of
    its own part (intrinsics 10, ``plane/<laser>`` 4, axis 6). The blocks on the diagonal are the
    parts' own covariances.
    """

    order: Annotated[tuple[str, ...], Field(min_length=2)]
    covariance: Matrix

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(set(self.order)) != len(self.order):
            raise ValueError(f"order: the same part stands twice in {list(self.order)}")
        unknown = [r for r in self.order if r.partition("/")[0] not in _NUMBERS]
        if unknown:
            raise ValueError(f"order: no part is called {unknown[0]!r}")
        size = sum(_NUMBERS[r.partition("/")[0]] for r in self.order)
        _check_covariance(self.covariance, size, " ".join(self.order))
        return self

    def numbers(self, role: str) -> range:
        """Where the numbers of ``role`` stand in the covariance; empty if it is not in it."""
        start = 0
        for other in self.order:
            count = _NUMBERS[other.partition("/")[0]]
            if other == role:
                return range(start, start + count)
            start += count
        return range(0)

    def block(self, *roles: str) -> Matrix:
        """The covariance of these parts alone, in this order."""
        at = [i for role in roles for i in self.numbers(role)]
        return tuple(tuple(self.covariance[i][j] for j in at) for i in at)


def _is_vector(v: Any) -> TypeGuard[Vector]:
    return (
        isinstance(v, (list, tuple))
        and len(v) == 3
        and all(isinstance(a, (int, float)) and math.isfinite(a) for a in v)
    )


class Calibration(Model):
    """A calibration document. Any part may be missing; a stage that needs it says so."""

    format: Literal["turnscan.calibration"] = FORMAT
    version: Literal[1] = VERSION
    rig: Annotated[str, Field(min_length=1, max_length=80)]
    note: str = ""
    camera: Intrinsics | None = None
    lasers: tuple[LaserPlane, ...] = ()
    turntable: TurntableAxis | None = None
    # None, and so absent from the digest, in documents that nobody judged.
    quality: Annotated[tuple[Quality, ...], Field(min_length=1)] | None = None
    # None where the parts share nothing, or what they share is not known.
    joint: Joint | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        numbers = [plane.laser for plane in self.lasers]
        if len(set(numbers)) != len(numbers):
            raise ValueError(f"lasers: the same laser number stands twice in {numbers}")
        judged = [q.part for q in self.quality or ()]
        if len(set(judged)) != len(judged):
            raise ValueError(f"quality: the same part stands twice in {judged}")
        if self.joint is not None:
            self._check_joint(self.joint)
        return self

    def _check_joint(self, joint: Joint) -> None:
        """A part that was replaced after the joint adjustment makes the cross terms meaningless."""
        parts = self.parts()
        for role in joint.order:
            part = parts.get(role)
            own = getattr(part, "covariance", None)
            if own is None:
                raise ValueError(f"joint: {role} has no covariance of its own, or is missing")
            for i, (one, other) in enumerate(zip(own, joint.block(role), strict=True)):
                for j, (a, b) in enumerate(zip(one, other, strict=True)):
                    if abs(a - b) > 1e-9 * math.sqrt(own[i][i] * own[j][j]) + 1e-30:
                        raise ValueError(
                            f"joint: its covariance of {role} is not the part's own, at [{i}][{j}]"
                        )

    def failed_gates(self) -> tuple[tuple[str, Gate], ...]:
        """(part, gate) of every acceptance limit that was not met."""
        return tuple((q.part, g) for q in self.quality or () for g in q.failed())

    @property
    def verdict(self) -> Verdict:
        """``failed`` if any gate of any part did not pass; ``not judged`` if there is no gate."""
        if self.failed_gates():
            return "failed"
        return "passed" if any(q.gates for q in self.quality or ()) else "not judged"

    def sha256(self) -> str:
        """Content digest (64 hex digits) of the whole document."""
        return digest("calibration", self.plain())

    def calibration_id(self) -> str:
        """``c-`` and the first 12 hex digits of the digest."""
        return f"c-{self.sha256()[:12]}"

    def parts(self) -> dict[str, Part]:
        """Role -> part: ``intrinsics``, ``plane/<laser>``, ``axis``; and ``joint`` if there is one."""
        out: dict[str, Part] = {}
        if self.camera is not None:
            out["intrinsics"] = self.camera
        for plane in self.lasers:
            out[f"plane/{plane.laser}"] = plane
        if self.turntable is not None:
            out["axis"] = self.turntable
        if self.joint is not None:
            out["joint"] = self.joint
        return out

    def part_ids(self) -> dict[str, str]:
        """Role -> content id of the part."""
        return {role: part.part_id() for role, part in self.parts().items()}

    def intrinsics_or_fail(self) -> Intrinsics:
        """The camera part, or a CalibrationError that says it is missing."""
        if self.camera is None:
            raise self._missing("camera intrinsics")
        return self.camera

    def plane_or_fail(self, laser: int) -> LaserPlane:
        """The plane of ``laser``, or a CalibrationError that says it is missing."""
        for plane in self.lasers:
            if plane.laser == laser:
                return plane
        raise self._missing(f"plane of laser {laser}")

    def axis_or_fail(self) -> TurntableAxis:
        """The turntable part, or a CalibrationError that says it is missing."""
        if self.turntable is None:
            raise self._missing("turntable axis")
        return self.turntable

    def _missing(self, what: str) -> CalibrationError:
        return CalibrationError(
            f"calibration {self.calibration_id()} of rig {self.rig!r} has no {what}",
            hint="use a calibration that holds this part (turnscan calibration list)",
        )


class PaperCalibration(Model):
    """The paper's parameters (section 2.2): f, L, D, theta, c, with the camera they belong to.

    ``theta_rad`` is the laser's output angle against the baseline, ``L_mm`` laser to camera,
    ``D_mm`` laser to rotation centre, ``c_mm`` the deviation of the rotation centre ("deviation d"
    in the paper's own list). The angle of formula (5) turns clockwise seen from above.
    """

    format: Literal["turnscan.paper-calibration"] = "turnscan.paper-calibration"
    version: Literal[1] = 1
    rig: Annotated[str, Field(min_length=1, max_length=80)]
    note: str = ""
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    f_px: Positive
    cx_px: float
    cy_px: float
    skew: float = 0.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    L_mm: Positive
    D_mm: float
    theta_rad: Annotated[float, Field(gt=0, lt=math.pi)]
    c_mm: float

    def calibration(self) -> Calibration:
        """The same rig in the general model (DESIGN of the spaces: docs/conventions.md)."""
        sin, cos = math.sin(self.theta_rad), math.cos(self.theta_rad)
        return Calibration(
            rig=self.rig,
            note=self.note,
            camera=Intrinsics(
                width_px=self.width_px,
                height_px=self.height_px,
                fx_px=self.f_px,
                fy_px=self.f_px,
                cx_px=self.cx_px,
                cy_px=self.cy_px,
                skew=self.skew,
                distortion=self.distortion,
            ),
            lasers=(LaserPlane(laser=0, normal=(sin, 0.0, cos), distance_mm=self.L_mm * sin),),
            turntable=TurntableAxis(
                point_mm=(self.L_mm - self.D_mm, 0.0, -self.c_mm),
                direction=(0.0, -1.0, 0.0),
                head="rotates",
                positive_turn="clockwise",
            ),
        )


def parse_calibration(data: bytes | str, *, where: str) -> Calibration:
    """A calibration from JSON text of either format; ``where`` names the file in errors."""
    value = parse_json(data, where=where)
    name = value.get("format")
    if name == "turnscan.paper-calibration":
        check_version(value, name=name, version=1, where=where)
        return validate(PaperCalibration, value, where=where).calibration()
    if name != FORMAT:
        raise DocumentError(
            f"{where}: format is {name!r}, expected {FORMAT!r} or 'turnscan.paper-calibration'",
            hint="docs/format.md shows both documents",
        )
    check_version(value, name=FORMAT, version=VERSION, where=where)
    return validate(Calibration, value, where=where)
