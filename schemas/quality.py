"""How well a part of a calibration was estimated: acceptance limits (gates), what was left out.

A calibration that fails a gate is kept as failed. Nothing hides that: it stands in the document, so it
is covered by the calibration's digest, and ``calibration certify`` refuses it unless it is forced.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .document import Model

Sense = Literal["at most", "at least"]
Verdict = Literal["passed", "failed", "not judged"]
_Word = Annotated[str, Field(min_length=1, max_length=80)]


class Gate(Model):
    """One acceptance limit: ``value`` must be at most, or at least, ``limit``; both in ``unit``.

    ``value`` is None where it could not be computed (a singular fit), and such a gate never passes.
    Make one with :meth:`at_most` or :meth:`at_least`, which judge by themselves.
    """

    name: _Word
    value: float | None = None
    limit: float
    unit: Annotated[str, Field(max_length=20)] = ""
    sense: Sense
    passed: bool

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.passed != _passes(self.value, self.sense, self.limit):
            raise ValueError(
                f"gate {self.name}: passed is {self.passed}, but {self.value} against "
                f"{self.sense} {self.limit} says otherwise"
            )
        return self

    @classmethod
    def at_most(cls, name: str, value: float, limit: float, unit: str = "") -> Gate:
        """A gate that passes when ``value <= limit``; NaN and infinity fail."""
        return cls._judged(name, value, limit, unit, "at most")

    @classmethod
    def at_least(cls, name: str, value: float, limit: float, unit: str = "") -> Gate:
        """A gate that passes when ``value >= limit``; NaN and infinity fail."""
        return cls._judged(name, value, limit, unit, "at least")

    @classmethod
    def _judged(cls, name: str, value: float, limit: float, unit: str, sense: Sense) -> Gate:
        number = float(value) if math.isfinite(value) else None
        return cls(
            name=name,
            value=number,
            limit=float(limit),
            unit=unit,
            sense=sense,
            passed=_passes(number, sense, float(limit)),
        )

    def sentence(self) -> str:
        """For people: ``rms is 0.81 px, limit at most 0.5 px``."""
        unit = f" {self.unit}" if self.unit else ""
        found = "could not be computed" if self.value is None else f"is {self.value:.4g}{unit}"
        return f"{self.name} {found}, limit {self.sense} {self.limit:.4g}{unit}"


def _passes(value: float | None, sense: Sense, limit: float) -> bool:
    if value is None:
        return False
    return value <= limit if sense == "at most" else value >= limit


class LeftOut(Model):
    """An input (image, view, corner, frame) that was not used, and why not."""

    what: Annotated[str, Field(min_length=1)]
    why: Annotated[str, Field(min_length=1)]


class EstimationInput(Model):
    """An input that was used: a file or scan by name, with its SHA-256 where it is a file."""

    name: Annotated[str, Field(min_length=1)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None


class Quality(Model):
    """What is known of the estimation of one part (or of all of them together: part ``joint``).

    ``part`` is a role as in ``Calibration.parts()``: ``intrinsics``, ``plane/<laser>``, ``axis``; or
    ``joint``, ``laser-centre``. ``method`` says in a word how it was estimated.
    """

    part: Annotated[str, Field(pattern=r"^[a-z0-9/-]{1,40}$")]
    method: str = ""
    gates: tuple[Gate, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    notes: tuple[str, ...] = ()
    inputs: tuple[EstimationInput, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [g.name for g in self.gates]
        if len(set(names)) != len(names):
            raise ValueError(f"part {self.part}: the same gate stands twice in {names}")
        return self

    def failed(self) -> tuple[Gate, ...]:
        """The gates that did not pass."""
        return tuple(g for g in self.gates if not g.passed)

    @property
    def verdict(self) -> Verdict:
        """``failed`` if any gate did not pass; ``not judged`` if there is none."""
        if not self.gates:
            return "not judged"
        return "failed" if self.failed() else "passed"


def joined_quality(old: Sequence[Quality] | None, *new: Quality) -> tuple[Quality, ...]:
    """``old`` with the entries of ``new`` in the place of those of the same part, by part."""
    by_part = {q.part: q for q in (*(old or ()), *new)}
    return tuple(by_part[part] for part in sorted(by_part))


def without_joint(old: Sequence[Quality] | None) -> tuple[Quality, ...]:
    """``old`` without the joint adjustment's: it no longer holds when a part is estimated anew."""
    return tuple(q for q in old or () if q.part != "joint")
