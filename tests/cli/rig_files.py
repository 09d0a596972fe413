"""Rig files of a small simulated rig, for the tests of ``turnscan record``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from turnscan.schemas.calibration import PaperCalibration
from turnscan.schemas.document import dump_json

#: Nothing random: what is recorded again is the same to the last bit.
NO_NOISE = {"exposure_us": 1000.0, "noise_dn": 0.0, "shot_dn_per_dn": 0.0}


def write_rig(
    folder: Path, *, scan: dict[str, Any] | None = None, simulated: dict[str, Any] | None = None
) -> Path:
    """rig.toml and its calibration in ``folder``: 160 x 120 frames of the built-in room."""
    made = PaperCalibration(
        rig="sim",
        width_px=160,
        height_px=120,
        f_px=190.0,
        cx_px=80.0,
        cy_px=60.0,
        L_mm=300.0,
        D_mm=150.0,
        theta_rad=math.atan2(1.0, 0.4),
        c_mm=40.0,
    ).calibration()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.json").write_bytes(dump_json(made.plain()))
    tables: dict[str, dict[str, Any]] = {
        "turntable": {
            "driver": "simulated",
            "dialect": "turnscan",
            "settle_ms": 0,
            "speed_deg_s": 180,
            "acceleration_deg_s2": 2000,
            "gear_ratio": 10,
            "timeout_s": 1.0,
        },
        "camera": {"driver": "simulated", "timeout_s": 2.0, "exposure_us": 1000},
        "scan": {"to_deg": 30, "step_deg": 2, **(scan or {})},
        "simulated": {"time_scale": 5, "light": NO_NOISE, **(simulated or {})},
    }
    lines = [
        'format = "turnscan.rig"',
        "version = 1",
        'name = "sim"',
        'calibration = "calibration.json"',
    ]
    for name, values in tables.items():
        lines += ["", f"[{name}]", *(f"{k} = {_toml(v)}" for k, v in values.items())]
    lines += ["", "[[lasers]]", "number = 0", "output = 1", ""]
    path = folder / "rig.toml"
    path.write_text("\n".join(lines))
    return path


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value)
