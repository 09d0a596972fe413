"""A commented rig file to start from, made from the models, so that it never lags behind them."""

from __future__ import annotations

import json
from typing import Any, Literal

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from .rig import (
    FORMAT,
    VERSION,
    CameraSettings,
    Dialect,
    Fault,
    LaserSettings,
    ScanSettings,
    Simulated,
    TurntableSettings,
)

_WIDTH = 100


def rig_template(driver: Literal["serial", "simulated"], dialect: Dialect, name: str) -> str:
    """TOML text that ``parse_rig`` accepts as it stands.

    What must be decided stands as a value; every other setting as a comment with its default.
    """
    simulated = driver == "simulated"
    board: dict[str, Any] = {"driver": driver, "dialect": dialect}
    if simulated:
        camera: dict[str, Any] = {"driver": "simulated"}
    else:
        board["port"] = "/dev/ttyUSB0"
        camera = {"driver": "v4l2", "device": 0}
    about = "simulated, needs no hardware" if simulated else "see docs/controllers.md"
    parts = [
        f"# A rig of turnscan: {about}.",
        "# Lines that begin with # show what else can be set, with the default. Check it with",
        "#     turnscan rig check rig.toml",
        "",
        f"format = {_toml(FORMAT)}",
        f"version = {VERSION}",
        f"name = {_toml(name)}",
        '# calibration = "calibration.json"  # recorded with each scan; relative to this file',
        "",
        *_table("[turntable]", TurntableSettings, board, leave_out=() if not simulated else ("port",)),
        *_table("[[lasers]]", LaserSettings, {"number": 0, "output": 1}),
        *_table("[camera]", CameraSettings, camera),
        *_table("[scan]", ScanSettings, {"from_deg": 0.0, "to_deg": 360.0, "step_deg": 1.0}),
    ]
    if simulated:
        parts += _table("[simulated]", Simulated, {"scene": "room"}, leave_out=("faults",))
        parts += ["# What goes wrong, as often as you like:", "# [[simulated.faults]]"]
        parts += [
            line if line.startswith("#") else f"# {line}"
            for line in _table("", Fault, {"kind": "lost-reply"})
            if line
        ]
    return "\n".join(parts).rstrip() + "\n"


def _table(
    title: str, model: type[BaseModel], values: dict[str, Any], leave_out: tuple[str, ...] = ()
) -> list[str]:
    lines = [title] if title else []
    for name, field in model.model_fields.items():
        if name in leave_out:
            continue
        default = field.get_default(call_default_factory=True)
        if name in values:
            text = f"{name} = {_toml(values[name])}"
        elif default is None or default is PydanticUndefined:
            text = f"# {name} ="
        else:
            text = f"# {name} = {_toml(default)}"
        about = field.description
        if about and len(text) + len(about) + 4 <= _WIDTH:
            text += f"  # {about}"
        elif about:
            lines.append(f"# {about}:")
        lines.append(text)
    return [*lines, ""]


def _toml(value: Any) -> str:
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }" if value else "{}"
    return json.dumps(value, ensure_ascii=False)
