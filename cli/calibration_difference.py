"""``calibration diff``: two calibrations, parameter by parameter and in mm."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

import typer

from ..schemas.errors import CalibrationError, UsageError
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit, emit_object
from .places import CalibrationArgument, open_archive

_PARAMETERS = ["part", "parameter", "first", "second", "difference", "sigma", "sigmas"]
_SHIFTS = ["laser", "at_m", "points", "rms_mm", "max_mm", "range_mm", "x_mm", "y_mm", "z_mm"]


def diff_calibrations(
    first: CalibrationArgument,
    second: CalibrationArgument,
    at_m: Annotated[
        list[float] | None,
        typer.Option("--at-m", metavar="M", help="Range of the shifts; may be repeated."),
    ] = None,
    show_all: Annotated[bool, typer.Option("--all", help="Also parameters that are equal.")] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Show how two calibrations differ: parameters in sigmas of both, and how far points move.

    Points are those of the stripe at 0.5, 1, 3, 5 and 7 m under the first calibration, at angle 0: rms
    and largest shift, mean change of range, mean shift along x, y and z of the scene.
    """
    from ..process.calibrate import difference

    archive = open_archive()
    a, b = archive.calibration(first), archive.calibration(second)
    if any(m <= 0 for m in at_m or []):
        raise UsageError(f"--at-m {min(at_m or [])}: a range is above 0", hint="such as --at-m 1.5")
    ranges = tuple(1000.0 * m for m in at_m) if at_m else difference.RANGES_MM
    session = current_session()
    parts = difference.part_differences(a, b)
    rows: list[dict[str, Any]] = [
        asdict(p)
        for p in difference.parameter_differences(a, b)
        if show_all or p.difference is None or p.difference != 0.0
    ]
    try:
        moved = [{"at_m": s.at_mm / 1000.0, **asdict(s)} for s in difference.shifts(a, b, ranges)]
    except CalibrationError as error:
        session.say(f"warning: no shifts in mm: {error}")
        moved = []
    chosen_style = chosen(style, as_json)
    if moved and difference.in_camera_space(a, b):
        session.say("note: shifts are in camera space, as a calibration has no axis")
    if chosen_style is Format.json:
        value = {
            "first": a.calibration_id(),
            "second": b.calibration_id(),
            "parts": [asdict(p) for p in parts],
            "parameters": rows,
            "shifts": moved,
            "space": "camera" if difference.in_camera_space(a, b) else "scene",
        }
        emit_object(value, chosen_style)
        return
    if chosen_style is Format.csv:
        emit(rows, _PARAMETERS, chosen_style)
        return
    if all(p.same for p in parts):
        session.say("all parts are the same")
    if rows:
        emit(rows, _PARAMETERS, chosen_style)
    for part in parts:
        if part.sigmas is not None and not part.same:
            session.say(f"{part.part} as a whole: {part.sigmas:.3g} sigmas")
        elif part.part == "joint" and not part.same:
            session.say("joint: the covariance between the parts differs")
        elif not part.same and a.parts().get(part.part) and b.parts().get(part.part):
            session.say(f"{part.part}: a covariance is missing, so there are no sigmas")
    seen = [s for s in moved if s["points"]]
    if seen:
        typer.echo()
        emit(seen, _SHIFTS, chosen_style)
    unseen = sorted({s["at_m"] for s in moved if not s["points"]})
    if unseen:
        session.say(f"no stripe in the image at {', '.join(f'{m:g}' for m in unseen)} m")
