"""What a recipe means for a scan: its keys, what of it exists, and what changed if it does not.

Pure look-ups in the catalogue and the keys: no log and no table is opened.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..schemas.calibration import Calibration
from ..schemas.key import points_key, stripes_key
from ..schemas.manifests import DerivationManifest, ScanSummary
from ..schemas.recipe import Recipe, stage_version


@dataclass(frozen=True)
class Plan:
    """The two derivations that a recipe asks of a scan, and which of them exist."""

    scan: ScanSummary
    recipe: Recipe
    calibration: Calibration
    why_calibration: str
    stripes_key: str
    stripes_parts: dict[str, str]
    points_key: str
    points_parts: dict[str, str]
    stripes: DerivationManifest | None
    points: DerivationManifest | None

    @property
    def done(self) -> bool:
        """Whether nothing is left to derive."""
        return self.stripes is not None and self.points is not None

    @property
    def missing(self) -> tuple[str, ...]:
        """Kinds that are to be derived."""
        pairs = (("stripes", self.stripes), ("points", self.points))
        return tuple(kind for kind, made in pairs if made is None)


@dataclass(frozen=True)
class Keys:
    """Keys of both derivations and the calibration parts in them."""

    stripes: str
    stripes_parts: dict[str, str]
    points: str
    points_parts: dict[str, str]


def keys_of(scan: ScanSummary, recipe: Recipe, calibration: Calibration) -> Keys:
    """The keys of ``recipe`` on ``scan`` with ``calibration``."""
    stripes, stripes_parts = stripes_key(
        recipe,
        content_sha256=scan.content_sha256,
        calibration=calibration,
        lasers=scan.lasers,
    )
    points, points_parts = points_key(
        recipe, stripes=stripes, calibration=calibration, lasers=scan.lasers
    )
    return Keys(stripes, stripes_parts, points, points_parts)


def stage_records(stages: Any) -> tuple[dict[str, Any], ...]:
    """Stages with version and parameters, as manifests record them."""
    return tuple({"version": stage_version(s), **s.plain()} for s in stages)


def what_changed(plan: Plan, kind: str, earlier: list[DerivationManifest]) -> str:
    """In words: which input differs from the nearest earlier derivation of this scan."""
    mine = [m for m in earlier if m.kind == kind]
    if not mine:
        return "never derived"
    same_recipe = [m for m in mine if m.recipe == plan.recipe.recipe_id()]
    if not same_recipe:
        names = sorted({str(m.recipe_document.get("name", m.recipe)) for m in mine})
        known = ", ".join(names)
        return f"recipe {plan.recipe.name} ({plan.recipe.recipe_id()}) is new here, known: {known}"
    newest = max(same_recipe, key=lambda m: m.created_ns)
    return ", ".join(_differences(plan, kind, newest)) or "an input changed"


def _differences(plan: Plan, kind: str, old: DerivationManifest) -> list[str]:
    out = []
    if old.content_sha256 != plan.scan.content_sha256:
        out.append("the content of the scan changed")
    parts = plan.stripes_parts if kind == "stripes" else plan.points_parts
    out += _parts(old.parts, parts)
    stages = plan.recipe.frame_stages() if kind == "stripes" else plan.recipe.point_stages()
    for now, then in zip(stage_records(stages), old.stages, strict=False):
        if now["version"] != then["version"]:
            out.append(f"stage {now['stage']} went from version {then['version']} to {now['version']}")
    if kind == "points" and old.upstream != (plan.stripes_key,):
        out.append("its stripes changed")
    return out


def _parts(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    return [
        f"{role} changed from {old.get(role, 'none')[:12]} to {new.get(role, 'none')[:12]}"
        for role in sorted({*old, *new})
        if old.get(role) != new.get(role)
    ]
