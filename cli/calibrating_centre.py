"""``turnscan calibrate laser-centre``: where a laser emits, or a camera sees from, by two triangles."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from ..schemas.errors import UsageError
from .calibration_output import OutOption, OverwriteOption, check_free, conclude
from .output import Format, FormatOption, JsonOption, chosen, emit_object
from .places import read_calibration_file


def calibrate_centre_command(
    readings: Annotated[
        list[str], typer.Argument(metavar="DISTANCE:LENGTH...", help="Face to wall, line on it; mm.")
    ],
    camera: Annotated[
        bool, typer.Option("--camera", help="LENGTH is the width of wall that fills the picture.")
    ] = False,
    sigma_distance_mm: Annotated[
        float, typer.Option("--sigma-distance-mm", min=0.0, help="Of a distance, 1 sigma.")
    ] = 1.0,
    sigma_length_mm: Annotated[
        float, typer.Option("--sigma-length-mm", min=0.0, help="Of a length, 1 sigma.")
    ] = 0.5,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", "-c", metavar="FILE", help="Note the result in it.")
    ] = None,
    out: OutOption = None,
    max_sigma_mm: Annotated[float, typer.Option("--max-sigma-mm", help="Gate: 1 sigma.")] = 5.0,
    overwrite: OverwriteOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Where the light leaves a laser (or a camera sees from), behind its front face.

    The paper's section 3.1.1: a line laser square to a wall, at two distances or more; the lengths of
    the line on the wall make similar triangles. The farther apart, the better: the gain says what an
    error of the rangefinder counts.
    """
    if (calibration is None) != (out is None):
        raise UsageError(
            "--calibration and -o go together", hint="the result is noted in a copy of FILE"
        )
    check_free(out, overwrite=overwrite)
    from ..process.calibrate.laser_centre import Reading, centre_behind_face, gain_at
    from ..schemas.quality import Gate, Quality, joined_quality

    parsed = [Reading(*_reading(word)) for word in readings]
    found = centre_behind_face(
        parsed, sigma_distance_mm=sigma_distance_mm, sigma_length_mm=sigma_length_mm
    )
    what = "camera" if camera else "laser"
    shown: dict[str, Any] = {
        "what": what,
        "behind_front_mm": found.behind_mm,
        "sigma_mm": found.sigma_mm,
        "ratio_t_over_s": found.ratio,
        "gain": found.gain,
        "opening_deg": math.degrees(found.opening_rad),
        "reduced_chi2": found.reduced_chi2 if math.isfinite(found.reduced_chi2) else None,
        "residuals_mm": list(found.residuals_mm),
        "gain_at_ratio": {f"{r:g}": round(gain_at(r), 3) for r in (1.5, 2.0, 3.0, 5.0, 10.0)},
    }
    emit_object(shown, chosen(style, as_json))
    if calibration is None or out is None:
        return
    document = read_calibration_file(calibration)
    quality = Quality(
        part=f"{what}-centre",
        method=f"similar triangles, {len(parsed)} readings",
        gates=(Gate.at_most("sigma", found.sigma_mm, max_sigma_mm, "mm"),),
        notes=(
            (
                f"the {what}'s centre lies {found.behind_mm:.2f} mm behind its front face, 1 sigma "
                f"{found.sigma_mm:.2f} mm, t/s {found.ratio:.2f}, gain {found.gain:.2f}"
            ),
        ),
    )
    result = document.model_copy(update={"quality": joined_quality(document.quality, quality)})
    conclude(result, (quality,), out)


def _reading(word: str) -> tuple[float, float]:
    left, sign, right = word.partition(":")
    try:
        values = float(left), float(right)
    except ValueError:
        values = math.nan, math.nan
    if not sign or not all(math.isfinite(v) for v in values):
        raise UsageError(f"{word!r}: expected DISTANCE:LENGTH in mm", hint="such as 500:230")
    return values
