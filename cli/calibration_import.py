"""``turnscan calibrate import``: a camera calibration of another program becomes a calibration."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Annotated

import typer

from ..schemas.errors import StorageError, UsageError
from .calibration_output import NoteOption, OutOption, OverwriteOption, RigOption, check_free, conclude
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit, emit_object


def import_camera(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Calib_Results.mat, OpenCV YAML, XML or JSON, ROS YAML."),
    ],
    out: OutOption = None,
    rig: RigOption = "unknown",
    note: NoteOption = "",
    size_px: Annotated[
        str | None,
        typer.Option("--size-px", metavar="WxH", help="Image size, where the file does not say it."),
    ] = None,
    overwrite: OverwriteOption = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Take the camera from a calibration of the Caltech toolbox, OpenCV or ROS.

    The Caltech toolbox prints about 3 sigma: its uncertainties are divided by 3. No gate is judged,
    since the views are not there.
    """
    check_free(out, overwrite=overwrite)
    from ..process.calibrate.foreign import read_foreign_camera
    from ..schemas.calibration import Calibration
    from ..schemas.quality import EstimationInput, Quality

    try:
        data = file.read_bytes()
    except OSError as error:
        raise StorageError(f"cannot read {file}: {error.strerror}") from error
    found = read_foreign_camera(data, where=str(file), size_px=_size(size_px))
    quality = Quality(
        part="intrinsics",
        method=f"imported from a file of {found.source}",
        notes=found.notes,
        inputs=(EstimationInput(name=file.name, sha256=hashlib.sha256(data).hexdigest()),),
    )
    camera = found.intrinsics
    calibration = Calibration(rig=rig, note=note, camera=camera, quality=(quality,))
    values = (
        *(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew),
        *camera.distortion,
    )
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "skew", "k1", "k2", "p1", "p2", "k3")
    spread = camera.covariance
    rows = [
        {"parameter": n, "value": v, "sigma": None if spread is None else spread[i][i] ** 0.5}
        for i, (n, v) in enumerate(zip(names, values, strict=True))
    ]
    chosen_style = chosen(style, as_json)
    if chosen_style is Format.json:
        shown = {
            "calibration": calibration.calibration_id(),
            "verdict": calibration.verdict,
            "source": found.source,
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "parameters": rows,
            "notes": list(found.notes),
        }
        emit_object(shown, chosen_style)
    else:
        emit(rows, ["parameter", "value", "sigma"], chosen_style)
        for text in found.notes:
            current_session().say(f"note: {text}")
    conclude(calibration, (quality,), out)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    sides = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text.strip())
    if sides is None or "0" in (sides.group(1), sides.group(2)):
        raise UsageError(f"--size-px {text!r}: expected WIDTHxHEIGHT", hint="such as --size-px 640x480")
    return int(sides.group(1)), int(sides.group(2))
