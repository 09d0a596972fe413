"""Events of the archive: one immutable JSON file each; the archive's state is a fold over them.

Order is by ULID and by the explicit ``after`` of an event that takes back or follows another; the
wall clock alone decides nothing.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from .document import Sealed, check_version, parse_json
from .errors import DocumentError
from .events import Nanoseconds, Tags

FORMAT: Final = "turnscan.event"
VERSION: Final = 1


class ArchiveEvent(Sealed):
    """What all archive events share: id (ULID), time, author's remark, the event it follows."""

    format: Literal["turnscan.event"] = FORMAT
    version: Literal[1] = VERSION
    id: Annotated[str, Field(pattern=r"^[0-7][0-9A-HJKMNP-TV-Z]{25}$")]
    t_ns: Nanoseconds
    after: str | None = None
    note: str = ""


class Certified(ArchiveEvent):
    """A calibration holds for a rig over [from_ns, to_ns); an open end is None.

    One that was certified although something spoke against it (a failed acceptance limit, an unknown
    rig) keeps what that was in ``objections`` and the answer of whoever forced it in ``reason``.
    """

    kind: Literal["certified"] = "certified"
    calibration: str
    rig: str
    from_ns: Nanoseconds | None = None
    to_ns: Nanoseconds | None = None
    objections: tuple[str, ...] | None = None
    reason: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.from_ns is not None and self.to_ns is not None and self.to_ns <= self.from_ns:
            raise ValueError(f"to_ns {self.to_ns} is not after from_ns {self.from_ns}")
        if self.objections and not self.reason:
            raise ValueError("objections were raised, and no reason is given")
        return self

    def covers(self, t_ns: int) -> bool:
        """Whether ``t_ns`` lies in the half-open range."""
        return (self.from_ns is None or t_ns >= self.from_ns) and (
            self.to_ns is None or t_ns < self.to_ns
        )

    def overlaps(self, from_ns: int | None, to_ns: int | None) -> bool:
        """Whether any moment lies in this range and in [from_ns, to_ns)."""
        return (self.to_ns is None or from_ns is None or from_ns < self.to_ns) and (
            self.from_ns is None or to_ns is None or self.from_ns < to_ns
        )


class Withdrawn(ArchiveEvent):
    """A certification is taken back; ``after`` names the certified event."""

    kind: Literal["withdrawn"] = "withdrawn"
    calibration: str
    after: str


class Tagged(ArchiveEvent):
    """Tags and label of a scan; an empty value removes the tag."""

    kind: Literal["tagged"] = "tagged"
    scan: str
    label: str | None = None
    tags: Tags = Field(default_factory=dict)


class Referenced(ArchiveEvent):
    """A trusted measurement that belongs to a scan."""

    kind: Literal["referenced"] = "referenced"
    scan: str
    value: dict[str, Any]


class Retired(ArchiveEvent):
    """A scan is no longer processed or listed by default; nothing is deleted."""

    kind: Literal["retired"] = "retired"
    scan: str


class Restored(ArchiveEvent):
    """A retired scan is in use again."""

    kind: Literal["restored"] = "restored"
    scan: str


AnyArchiveEvent = Annotated[
    Certified | Withdrawn | Tagged | Referenced | Retired | Restored, Field(discriminator="kind")
]
_ADAPTER: TypeAdapter[AnyArchiveEvent] = TypeAdapter(AnyArchiveEvent)


def parse_archive_event(data: bytes, *, where: str) -> AnyArchiveEvent:
    """An archive event from JSON bytes; ``where`` names the file in errors."""
    value = parse_json(data, where=where)
    check_version(value, name=FORMAT, version=VERSION, where=where)
    try:
        return _ADAPTER.validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(p) for p in first["loc"])
        raise DocumentError(f"{where}: {field}: {first['msg']}") from error
