"""What `turnscan calibrate camera` shows and keeps of an estimate: tables, JSON, corners as CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..schemas.errors import StorageError
from .output import Format, current_session, emit, emit_object

if TYPE_CHECKING:
    from ..process.calibrate.camera import CameraEstimate
    from ..schemas.quality import Quality


def show_camera(estimate: CameraEstimate, quality: Quality, name: str, style: Format) -> None:
    """The parameters on stdout; with JSON also covariance, gates, every view and every corner."""
    values, sigmas = estimate.parameters(), estimate.sigmas()
    parameters = [{"parameter": n, "value": values[n], "sigma": sigmas[n]} for n in values]
    rms = estimate.bundle.view_rms_px()
    views = [
        {
            "view": v.name,
            "corners": len(v.ids),
            "rms_px": float(rms[i]),
            "max_px": float(_lengths(estimate, i).max()),
            "window_px": v.window_px,
            "square_px": v.square_px,
            "detector": v.detector,
        }
        for i, v in enumerate(estimate.views)
    ]
    if style is not Format.json:
        emit(parameters, ["parameter", "value", "sigma"], style)
        if style is Format.table:
            session = current_session()
            for gate in quality.gates:
                session.say(f"{'passed' if gate.passed else 'FAILED'}: {gate.sentence()}")
            for text in quality.notes:
                session.say(f"note: {text}")
        return
    shown: dict[str, Any] = {
        "calibration": name,
        "verdict": quality.verdict,
        "rms_px": estimate.bundle.rms_px(),
        "noise_px": estimate.uncertainty.noise_px,
        "birge": estimate.uncertainty.birge,
        "parameters": parameters,
        "covariance": estimate.uncertainty.covariance.tolist(),
        "gates": [g.model_dump(mode="json") for g in quality.gates],
        "views": [{**v, "residuals_px": _residuals(estimate, i)} for i, v in enumerate(views)],
        "left_out": [item.model_dump(mode="json") for item in quality.left_out],
        "notes": list(quality.notes),
    }
    emit_object(shown, style)


def _lengths(estimate: CameraEstimate, view: int) -> Any:
    import numpy as np

    return np.linalg.norm(estimate.bundle.residuals_px[view], axis=1)


def _residuals(estimate: CameraEstimate, view: int) -> list[list[float]]:
    """[corner id, u, v, du, dv] of every corner of a view, px."""
    v, r = estimate.views[view], estimate.bundle.residuals_px[view]
    rows = zip(v.ids, v.points_px, r, strict=True)
    return [[int(i), *(round(float(x), 4) for x in (*p, *d))] for i, p, d in rows]


def write_corners(estimate: CameraEstimate, out: Path) -> None:
    """Every corner that was used, with its residual, as CSV."""
    try:
        with out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["view", "corner", "u_px", "v_px", "residual_u_px", "residual_v_px"])
            for i, view in enumerate(estimate.views):
                writer.writerows([view.name, *row] for row in _residuals(estimate, i))
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}") from error
