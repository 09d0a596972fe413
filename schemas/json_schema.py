"""JSON Schemas of every document and log event, generated from the models.

The generated files stand in schemas/json/ so that other programs can use them; a test compares them
with what the models say now, and ``make docs`` writes them again.
"""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from .archive_events import AnyArchiveEvent
from .calibration import Calibration, PaperCalibration
from .events import (
    CalibrationSnapshot,
    DeviceLine,
    Exposure,
    LaserState,
    LogLine,
    ReferenceEvent,
    ScanEnd,
    ScanStart,
    StripeTruth,
    TurntableAngle,
)
from .manifests import ArchiveSettings, DerivationManifest, ScanSummary
from .observations import Observations
from .recipe import Recipe
from .rig import Rig
from .scene import SceneDocument

_DIALECT = "https://json-schema.org/draft/2020-12/schema"

_NAMED: dict[str, Any] = {
    "archive": ArchiveSettings,
    "archive-event": AnyArchiveEvent,
    "calibration": Calibration,
    "calibration-snapshot": CalibrationSnapshot,
    "derivation": DerivationManifest,
    "device-line": DeviceLine,
    "exposure": Exposure,
    "laser-state": LaserState,
    "log-line": LogLine,
    "observations": Observations,
    "paper-calibration": PaperCalibration,
    "recipe": Recipe,
    "reference-event": ReferenceEvent,
    "rig": Rig,
    "scan": ScanSummary,
    "scan-end": ScanEnd,
    "scan-start": ScanStart,
    "scene": SceneDocument,
    "stripe-truth": StripeTruth,
    "turntable-angle": TurntableAngle,
}


def json_schemas() -> dict[str, dict[str, Any]]:
    """Document name -> JSON Schema (draft 2020-12) of its present model."""
    out: dict[str, dict[str, Any]] = {}
    for name, model in _NAMED.items():
        adapter: TypeAdapter[Any] = TypeAdapter(model)
        out[name] = {"$schema": _DIALECT, **adapter.json_schema(mode="validation")}
    return out
