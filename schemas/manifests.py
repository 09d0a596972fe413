"""Documents that the archive writes beside its bytes: archive settings, scan summary, manifests."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from .document import Model, Sealed
from .events import Ended, Nanoseconds, Tags

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

#: The derived tables.
Kind = Literal["stripes", "points"]

#: Version of the archive's layout, in turnscan.toml. Raised when old programs would misread it.
ARCHIVE_VERSION = 1


class ArchiveSettings(Model):
    """turnscan.toml: format version, archive id, defaults."""

    format: Literal["turnscan.archive"] = "turnscan.archive"
    version: Literal[1] = 1
    archive: str
    created_ns: Nanoseconds
    recipe: str = "default"


class ScanSummary(Model):
    """scan.json: what a reader wants to know of a log without opening it.

    ``content_sha256`` covers the decoded payloads that processing reads (docs/format.md says which)
    and enters every key; ``frames_sha256`` leaves times out and finds a second import of the same
    content.
    """

    format: Literal["turnscan.scan"] = "turnscan.scan"
    version: Literal[1] = 1
    scan: str
    rig: str
    label: str = ""
    tags: Tags = Field(default_factory=dict)
    source: str
    software: str
    started_ns: Nanoseconds
    ended_ns: Nanoseconds
    ended: Ended
    cameras: tuple[str, ...]
    lasers: tuple[int, ...]
    frames: int
    background_frames: int
    width_px: int
    height_px: int
    encoding: str
    angle_min_rad: float
    angle_max_rad: float
    calibration: str | None = None
    content_sha256: Sha256
    frames_sha256: Sha256
    log_bytes: int
    log_sha256: Sha256
    salvaged_from: str | None = None
    continues: str | None = None


class DerivationManifest(Sealed):
    """k-<key12>.json: written last, and so the mark that the table beside it is complete."""

    format: Literal["turnscan.derivation"] = "turnscan.derivation"
    version: Literal[1] = 1
    kind: Kind
    key: Sha256
    scan: str
    content_sha256: Sha256
    recipe: str
    recipe_document: dict[str, Any]
    calibration: str | None = None
    parts: dict[str, Sha256] = Field(default_factory=dict)
    upstream: tuple[Sha256, ...] = ()
    stages: tuple[dict[str, Any], ...]
    table_version: int
    path: str
    rows: int
    bytes: int
    sha256: Sha256
    frames: int
    frames_without_stripe: int = 0
    warnings: tuple[str, ...] = ()
    created_ns: Nanoseconds
    duration_s: float
    made_with: dict[str, str] = Field(default_factory=dict)
