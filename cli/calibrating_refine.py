"""``turnscan calibrate refine``: one adjustment of camera, planes and axis to all observations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .calibrating import FixWord, fixed_words
from .calibrating_geometry import judged_fields, say_quality
from .calibration_observations import (
    parse_reference,
    read_observations,
    read_stripe_points,
)
from .calibration_output import (
    DryRunOption,
    NoteOption,
    OutOption,
    OverwriteOption,
    check_free,
    conclude,
)
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit, emit_object
from .places import read_calibration_file

if TYPE_CHECKING:
    from ..process.calibrate.refine import Refined
    from ..schemas.calibration import Calibration
    from ..schemas.observations import Observations
    from ..schemas.quality import Quality


def calibrate_refine_command(
    observations: Annotated[
        list[Path],
        typer.Argument(metavar="FILE.json...", help="What camera, plane and axis saved."),
    ],
    calibration: Annotated[
        Path,
        typer.Option(
            "--calibration", "-c", metavar="FILE", help="To start from: camera, planes, axis."
        ),
    ],
    wall: Annotated[
        list[str] | None,
        typer.Option(
            "--wall",
            metavar="FILE.csv:MM:SD",
            help="Stripe points on a flat wall, its distance from the camera's centre; may repeat.",
        ),
    ] = None,
    sphere: Annotated[
        list[str] | None,
        typer.Option(
            "--sphere", metavar="FILE.csv:MM:SD", help="Stripe points on a sphere, its diameter."
        ),
    ] = None,
    length: Annotated[
        list[str] | None,
        typer.Option(
            "--length",
            metavar="FILE.csv:MM:SD",
            help="Stripe points at the two ends of a length (column end: 1, 2).",
        ),
    ] = None,
    skew: Annotated[bool, typer.Option("--skew", help="Estimate skew, too.")] = False,
    fix: Annotated[
        list[FixWord] | None,
        typer.Option("--fix", help="Hold of the camera; may repeat. Default: as FILE held."),
    ] = None,
    out: OutOption = None,
    note: NoteOption = "",
    max_rms_px: Annotated[float, typer.Option("--max-rms-px", help="Gate: noise of corners.")] = 0.5,
    max_stripe: Annotated[
        float, typer.Option("--max-stripe", help="Gate: noise of stripes over what they state.")
    ] = 5.0,
    max_contradiction: Annotated[
        float, typer.Option("--max-contradiction", help="Gate: how much the views disagree.")
    ] = 5.0,
    max_reference_sigmas: Annotated[
        float, typer.Option("--max-reference-sigmas", help="Gate: worst reference.")
    ] = 3.0,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Adjust camera, laser planes and axis together to everything that was seen.

    FILE.json are what `calibrate camera`, `plane` and `axis` saved with --observations. A wall at a
    distance that a laser rangefinder measured, square to the wall from the camera's centre at the first
    angle, holds the far range; it must be seen at two angles of the head at least. The result carries
    one covariance of all parts, from which sigma_range_mm of every point is made.
    """
    check_free(out, overwrite=overwrite)
    from ..process.calibrate.refine import refine
    from ..process.calibrate.refine_quality import RefineLimits, refine_quality
    from ..schemas.quality import joined_quality

    start = read_calibration_file(calibration)
    camera = start.intrinsics_or_fail()
    size = (camera.width_px, camera.height_px)
    seen = [read_observations(path) for path in observations]
    references = _references(size, wall or [], sphere or [], length or [])
    if references is not None:
        seen.append(references)
    held = fixed_words(fix, skew=skew) if fix or skew else None
    with current_session().progress("adjusting"):
        fit = refine(seen, start, fix=held)
    result = fit.calibration()
    limits = RefineLimits(
        most_rms_px=max_rms_px,
        most_stripe=max_stripe,
        most_birge=max_contradiction,
        most_reference_sigmas=max_reference_sigmas,
    )
    quality = refine_quality(fit, result, limits)
    inputs = tuple(dict.fromkeys(i for o in seen for i in o.inputs))
    quality = quality.model_copy(update={"inputs": inputs})
    result = result.model_copy(
        update={"quality": joined_quality(start.quality, quality), "note": note or start.note}
    )
    _show(fit, start, result, quality, chosen(style, as_json))
    conclude(result, (quality,), None if dry_run else out)


def _references(
    size: tuple[int, int], walls: list[str], spheres: list[str], lengths: list[str]
) -> Observations | None:
    """The references named on the command line, as observations; None if there are none."""
    if not (walls or spheres or lengths):
        return None
    from ..process.calibrate.observed import one_observation
    from ..schemas.errors import InputError
    from ..schemas.observations import SeenLength, SeenSphere, SeenWall

    def stripes(word: str, option: str) -> tuple[Path, float, float, list[Any]]:
        path, value, sd = parse_reference(word, option)
        return path, value, sd, read_stripe_points(path)

    made_walls, made_spheres, made_lengths = [], [], []
    for word in walls:
        path, mm, sd, seen = stripes(word, "--wall")
        made_walls.append(SeenWall(name=str(path), distance_mm=mm, sd_mm=sd, stripes=tuple(seen)))
    for word in spheres:
        path, mm, sd, seen = stripes(word, "--sphere")
        made_spheres.append(SeenSphere(name=str(path), diameter_mm=mm, sd_mm=sd, stripes=tuple(seen)))
    for word in lengths:
        path, mm, sd, seen = stripes(word, "--length")
        if len(seen) != 2:
            raise InputError(
                f"{path}: a length has two ends, found {len(seen)}",
                hint="a column end with 1 and 2 tells the points of the two ends apart",
            )
        made_lengths.append(SeenLength(name=str(path), length_mm=mm, sd_mm=sd, ends=(seen[0], seen[1])))
    return one_observation(size, walls=made_walls, spheres=made_spheres, lengths=made_lengths)


def _show(
    fit: Refined, start: Calibration, result: Calibration, quality: Quality, style: Format
) -> None:
    import numpy as np

    from ..process.calibrate.difference import parameter_differences
    from ..process.calibrate.refine_quality import systematic_mm

    sigma = {(d.part, d.parameter): d for d in parameter_differences(result, result)}
    rows = [
        {
            "part": d.part,
            "parameter": d.parameter,
            "before": d.first,
            "value": d.second,
            # The sigma of a difference with itself is that of two.
            "sigma": None
            if sigma[d.part, d.parameter].sigma is None
            else float(sigma[d.part, d.parameter].sigma or 0.0) / float(np.sqrt(2.0)),
        }
        for d in parameter_differences(start, result)
    ]
    if style is not Format.json:
        emit(rows, ["part", "parameter", "before", "value", "sigma"], style)
        if style is Format.table:
            say_quality(quality)
        return
    s = fit.solution.sigmas
    shown: dict[str, Any] = {
        "calibration": result.calibration_id(),
        "parameters": rows,
        "order": list(fit.order),
        "covariance": fit.covariance.tolist(),
        "corner_noise_px": s.corner_px,
        "turning_noise_px": s.turned_px if fit.data.turned is not None else None,
        "stripe_over_stated": s.stripe,
        "wall_stripe_over_stated": s.wall if fit.data.walls.names else None,
        "birge": fit.birge,
        "condition": fit.solution.condition,
        "references": [r.__dict__ for r in fit.references],
        "systematic_mm": {
            str(p.laser): [{"range_mm": a, "sigma_mm": b} for a, b in systematic_mm(result, p.laser)]
            for p in result.lasers
        },
        **judged_fields(quality),
    }
    emit_object(shown, style)
