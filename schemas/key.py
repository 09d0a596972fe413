"""The derivation key: what a sealed result means, as one SHA-256.

Key = digest of {stage, version, parameters, content digest of the input, ids of the calibration
parts that the stage uses, upstream keys}. Library versions, host and duration are recorded in the
manifest and are no part of the key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .calibration import Calibration
from .canonical import digest
from .errors import CalibrationError
from .recipe import Recipe, Stage, Triangulate, Undistort, stage_version


def parts_used(stage: Stage, lasers: Sequence[int]) -> tuple[str, ...]:
    """Roles of the calibration parts that ``stage`` reads, for a scan with these lasers."""
    if isinstance(stage, Undistort):
        return ("intrinsics",)
    if isinstance(stage, Triangulate):
        return ("intrinsics", "axis", *(f"plane/{n}" for n in sorted(set(lasers))))
    return ()


def stage_key(
    stage: Stage,
    *,
    input_sha256: str | None,
    parts: Mapping[str, str],
    upstream: Sequence[str],
) -> str:
    """Key of one stage. ``input_sha256`` is the scan's content digest for the first stage only."""
    return digest(
        "stage-key",
        {
            "stage": stage.stage,
            "version": stage_version(stage),
            "parameters": stage.plain(),
            "input": input_sha256,
            "parts": dict(parts),
            "upstream": list(upstream),
        },
    )


def _chain(
    stages: Sequence[Stage],
    *,
    input_sha256: str | None,
    upstream: Sequence[str],
    part_ids: Mapping[str, str],
    lasers: Sequence[int],
    calibration: Calibration | None,
) -> tuple[str, dict[str, str]]:
    used: dict[str, str] = {}
    for stage in stages:
        parts = {}
        roles = parts_used(stage, lasers)
        if isinstance(stage, Triangulate) and "joint" in part_ids:
            # The standard deviation of a range depends on the cross terms; old keys stay as they are.
            roles = (*roles, "joint")
        for role in roles:
            if role not in part_ids:
                name = calibration.calibration_id() if calibration else "(none)"
                raise CalibrationError(
                    f"calibration {name} has no {role}, which the stage {stage.stage} needs",
                    hint="use a calibration that holds this part (turnscan calibration list)",
                )
            parts[role] = part_ids[role]
        used.update(parts)
        key = stage_key(stage, input_sha256=input_sha256, parts=parts, upstream=upstream)
        input_sha256, upstream = None, (key,)
    return upstream[0], used


def stripes_key(
    recipe: Recipe,
    *,
    content_sha256: str,
    calibration: Calibration | None,
    lasers: Sequence[int],
    part_ids: Mapping[str, str] | None = None,
) -> tuple[str, dict[str, str]]:
    """Key of STRIPES of a scan, and role -> id of the parts that entered it.

    ``calibration`` may be None when no stage before the table uses one. ``part_ids``, if given, are
    those of ``calibration``: who makes the keys of many scans takes the digests of its parts but once.
    """
    return _chain(
        recipe.frame_stages(),
        input_sha256=content_sha256,
        upstream=(),
        part_ids=(calibration.part_ids() if calibration else {}) if part_ids is None else part_ids,
        lasers=lasers,
        calibration=calibration,
    )


def points_key(
    recipe: Recipe,
    *,
    stripes: str,
    calibration: Calibration,
    lasers: Sequence[int],
    part_ids: Mapping[str, str] | None = None,
) -> tuple[str, dict[str, str]]:
    """Key of POINTS derived from the STRIPES with key ``stripes``, and the parts in it.

    ``part_ids`` as for :func:`stripes_key`.
    """
    return _chain(
        recipe.point_stages(),
        input_sha256=None,
        upstream=(stripes,),
        part_ids=calibration.part_ids() if part_ids is None else part_ids,
        lasers=lasers,
        calibration=calibration,
    )
