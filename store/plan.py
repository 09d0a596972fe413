"""What a recipe means for a scan: its keys, what of it exists, and what changed if it does not.

Pure look-ups in the catalogue and the keys: no log and no table is opened.
"""

from __future__ import annotations

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
    recipe_id: str
    calibration: Calibration
    calibration_id: str
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

    @property
    def both(self) -> tuple[str, str]:
        """The key of STRIPES and the key of POINTS."""
        return self.stripes, self.points


class KeyMaker:
    """The keys of one recipe on many scans; digests of calibrations and their parts are taken once."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self.recipe_id = recipe.recipe_id()
        # The calibration is held beside its ids: an object that is gone may leave its id() to another.
        self._ids: dict[int, tuple[Calibration, str, dict[str, str]]] = {}

    def _ids_of(self, calibration: Calibration) -> tuple[Calibration, str, dict[str, str]]:
        at = id(calibration)
        if at not in self._ids:
            self._ids[at] = (calibration, calibration.calibration_id(), calibration.part_ids())
        return self._ids[at]

    def calibration_id(self, calibration: Calibration) -> str:
        """The id of ``calibration``."""
        return self._ids_of(calibration)[1]

    def keys(self, scan: ScanSummary, calibration: Calibration) -> Keys:
        """The keys of the recipe on ``scan`` with ``calibration``."""
        _, _, part_ids = self._ids_of(calibration)
        stripes, stripes_parts = stripes_key(
            self._recipe,
            content_sha256=scan.content_sha256,
            calibration=calibration,
            lasers=scan.lasers,
            part_ids=part_ids,
        )
        points, points_parts = points_key(
            self._recipe,
            stripes=stripes,
            calibration=calibration,
            lasers=scan.lasers,
            part_ids=part_ids,
        )
        return Keys(stripes, stripes_parts, points, points_parts)


def stage_records(stages: Any) -> tuple[dict[str, Any], ...]:
    """Stages with version and parameters, as manifests record them."""
    return tuple({"version": stage_version(s), **s.plain()} for s in stages)


def what_changed(plan: Plan, kind: str, earlier: list[DerivationManifest]) -> str:
    """In one line: which input differs from the nearest earlier derivation of this scan."""
    return ", ".join(_changes(plan, kind, earlier))


def why_stale(plan: Plan, earlier: list[DerivationManifest]) -> str:
    """In one line, why the scan is stale; empty if it is not."""
    reasons: list[str] = []
    for kind in plan.missing:
        found = _changes(plan, kind, earlier)
        # That stripes changed says nothing more where they are to be derived, too.
        news = [r for r in found if r != _NEW_STRIPES or plan.stripes is not None]
        reasons += [r for r in news if r not in reasons]
    return ", ".join(reasons)


_NEW_STRIPES = "its stripes changed"


def _changes(plan: Plan, kind: str, earlier: list[DerivationManifest]) -> list[str]:
    mine = [m for m in earlier if m.kind == kind]
    if not mine:
        return ["never derived"]
    same_recipe = [m for m in mine if m.recipe == plan.recipe_id]
    if not same_recipe:
        names = sorted({str(m.recipe_document.get("name", m.recipe)) for m in mine})
        known = ", ".join(names)
        new = f"{plan.recipe.name} ({plan.recipe_id})"
        return [f"recipe changed: {new} is new here, known: {known}"]
    newest = max(same_recipe, key=lambda m: m.created_ns)
    return _differences(plan, kind, newest) or ["derived before, but its table is gone"]


def _differences(plan: Plan, kind: str, old: DerivationManifest) -> list[str]:
    out = []
    if old.content_sha256 != plan.scan.content_sha256:
        out.append("the content of the scan changed")
    parts = plan.stripes_parts if kind == "stripes" else plan.points_parts
    changed = [r for r in sorted({*old.parts, *parts}) if old.parts.get(r) != parts.get(r)]
    if changed:
        then = f"{old.calibration} to " if old.calibration else ""
        names = f"{then}{plan.calibration_id}"
        out.append(f"calibration changed: {', '.join(changed)} ({names})")
    stages = plan.recipe.frame_stages() if kind == "stripes" else plan.recipe.point_stages()
    for now, before in zip(stage_records(stages), old.stages, strict=False):
        if now["version"] != before["version"]:
            out.append(
                f"software changed: stage {now['stage']} from version {before['version']} to "
                f"{now['version']}"
            )
    if kind == "points" and old.upstream != (plan.stripes_key,):
        out.append(_NEW_STRIPES)
    return out
