"""What `turnscan calibrate axis` shows of an axis: a table with sigmas, or all of it as JSON."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from .calibrating_geometry import judged_fields, say_quality
from .output import Format, current_session, emit, emit_object

if TYPE_CHECKING:
    from ..process.calibrate.axis_result import AxisFit
    from ..process.calibrate.table_scale import TableScale
    from ..schemas.calibration import Calibration
    from ..schemas.quality import Quality


def show_axis(
    fit: AxisFit, sized: TableScale | None, quality: Quality, result: Calibration, style: Format
) -> None:
    """Parameters on stdout, gates and notes on stderr; with JSON also covariance and every frame."""
    import numpy as np

    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    names = ("point_x_mm", "point_y_mm", "point_z_mm", "direction_x", "direction_y", "direction_z")
    values = (*fit.point_mm, *fit.direction)
    rows = [
        {"parameter": n, "value": float(v), "sigma": float(s)}
        for n, v, s in zip(names, values, sigma, strict=True)
    ]
    frames = [
        {
            "frame": f.name,
            "nominal_deg": math.degrees(f.nominal_rad),
            "angle_deg": math.degrees(f.angle_rad),
            "off_deg": math.degrees(f.off_rad),
            "rms_px": f.rms_px,
            "tilt_deg": math.degrees(f.tilt_rad),
            "shift_mm": math.hypot(*f.shift_mm),
            "rise_mm": f.rise_mm,
            "points": f.points,
        }
        for f in fit.frames
    ]
    if style is not Format.json:
        emit(rows, ["parameter", "value", "sigma"], style)
        if style is Format.table:
            current_session().say(f"positive angles turn {fit.positive_turn}, head {fit.head}")
            say_quality(quality)
        return
    shown: dict[str, Any] = {
        "calibration": result.calibration_id(),
        "parameters": rows,
        "covariance": fit.covariance.tolist(),
        "positive_turn": fit.positive_turn,
        "head": fit.head,
        "rms_px": fit.rms_px,
        "angle_scale": fit.angle_scale,
        "step_sd_deg": math.degrees(fit.step_sd_rad),
        "eccentricity_deg": math.degrees(fit.eccentricity_rad),
        "wobble_deg": math.degrees(fit.wobble_rad),
        "wander_mm": fit.wander_mm,
        "marker_scale": None if sized is None else sized.scale,
        "marker_scale_sigma": None if sized is None else math.sqrt(sized.own_variance),
        "frames": frames,
        **judged_fields(quality),
    }
    emit_object(shown, style)
