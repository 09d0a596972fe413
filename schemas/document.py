"""What all documents share: a frozen model that refuses unknown fields and non-finite numbers.

A *document* is a model with ``format`` and ``version``; its reader checks both first,
and turns every failure into one :class:`DocumentError` that names the file and the field.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from .canonical import digest
from .errors import DamageError, DocumentError, FormatVersionError


class Model(BaseModel):
    """Frozen, closed, finite: the base of every value that is written down."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    def plain(self) -> dict[str, Any]:
        """The JSON form, with fields that are None left out."""
        return self.model_dump(mode="json", exclude_none=True)


class Sealed(Model):
    """A document that carries the digest of the rest of itself, so that no change goes unseen."""

    sha256_of_rest: str | None = None

    def rest_sha256(self) -> str:
        """Digest of every field but ``sha256_of_rest``."""
        rest = {k: v for k, v in self.plain().items() if k != "sha256_of_rest"}
        return digest(f"sealed/{type(self).__name__}", rest)

    def sealed(self) -> Self:
        """The same document with its digest."""
        return self.model_copy(update={"sha256_of_rest": self.rest_sha256()})

    def check_sealed(self, *, where: str) -> Self:
        """The document itself, or a DamageError if a field differs from what was sealed."""
        if self.sha256_of_rest != self.rest_sha256():
            raise DamageError(
                f"{where}: its content differs from its own digest: the file was changed",
                hint="restore it from a copy; nothing in an archive is edited by hand",
            )
        return self


AnyModel = TypeVar("AnyModel", bound=BaseModel)


def _explain(error: ValidationError) -> str:
    parts = []
    for item in error.errors()[:4]:
        where = ".".join(str(p) for p in item["loc"]) or "document"
        found = item.get("input")
        shown = "" if isinstance(found, (dict, list)) else f" (found {found!r})"
        parts.append(f"{where}: {item['msg']}{shown}")
    more = error.error_count() - len(parts)
    return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")


def validate(model: type[AnyModel], value: Any, *, where: str) -> AnyModel:
    """``value`` as a ``model``; every failure is a DocumentError naming ``where`` and the field."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise DocumentError(
            f"{where}: {_explain(error)}", hint=f"correct the field in {where}"
        ) from error


def check_version(value: Mapping[str, Any], *, name: str, version: int, where: str) -> None:
    """Refuse a document of another format, or of a newer version than this program knows."""
    found = value.get("format")
    if found != name:
        raise DocumentError(
            f"{where}: format is {found!r}, expected {name!r}",
            hint=f'a document of this kind starts with "format": "{name}"',
        )
    number = value.get("version")
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise DocumentError(f"{where}: version is {number!r}, expected a whole number from 1")
    if number > version:
        raise FormatVersionError(
            f"{where}: {name} version {number}, this turnscan reads up to {version}",
            hint="install a newer turnscan; nothing was changed",
        )


def parse_json(data: bytes | str, *, where: str) -> dict[str, Any]:
    """A JSON object from text; NaN and infinity are refused, and so are repeated keys."""

    def refuse(token: str) -> Any:
        raise DocumentError(
            f"{where}: contains {token}, expected finite numbers", hint="replace it by a number"
        )

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, item in pairs:
            if key in out:
                raise DocumentError(f"{where}: the key {key!r} stands twice")
            out[key] = item
        return out

    try:
        value = json.loads(data, parse_constant=refuse, object_pairs_hook=unique)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DocumentError(f"{where}: not JSON ({error})") from error
    if not isinstance(value, dict):
        raise DocumentError(f"{where}: expected a JSON object, found {type(value).__name__}")
    return value


def parse_toml(data: bytes, *, where: str) -> dict[str, Any]:
    """A TOML table from bytes."""
    try:
        return tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DocumentError(f"{where}: not TOML ({error})") from error


def dump_json(value: Any) -> bytes:
    """Readable JSON bytes with sorted keys and a final line end, for files that people open."""
    text = json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()
