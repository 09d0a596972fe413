"""rig.toml: what is accepted, and one clear error for what is not."""

from __future__ import annotations

from typing import Any

import pytest

from turnscan.schemas.errors import DocumentError, FormatVersionError
from turnscan.schemas.rig import TurntableSettings, parse_rig
from turnscan.schemas.rig_template import rig_template

HEAD = 'format = "turnscan.rig"\nversion = 1\nname = "desk"\n'
TABLE = '[turntable]\ndriver = "simulated"\n'
LASER = "[[lasers]]\nnumber = 0\noutput = 1\n"
CAMERA = '[camera]\ndriver = "simulated"\n'


def rig(
    *, head: str = HEAD, table: str = TABLE, laser: str = LASER, camera: str = CAMERA, more: str = ""
) -> Any:
    return parse_rig((head + table + laser + camera + more).encode(), where="rig.toml")


@pytest.mark.parametrize("driver", ["serial", "simulated"])
@pytest.mark.parametrize("dialect", ["turnscan", "horus", "grbl"])
def test_the_template_is_a_rig_file_as_it_stands(driver: Any, dialect: Any) -> None:
    text = rig_template(driver, dialect, "desk")
    made = parse_rig(text.encode(), where="template")
    assert made.turntable.dialect == dialect
    assert made.turntable.driver == driver
    assert max(map(len, text.splitlines())) <= 104


def test_every_setting_of_the_template_can_be_uncommented() -> None:
    """With its default, where it has one: the comments are real settings, and real defaults."""
    text = rig_template("simulated", "turnscan", "desk")
    lines = []
    for line in text.split("# What goes wrong")[0].splitlines():
        name = line.removeprefix("# ").split(" ")[0]
        setting = line.startswith("# ") and " = " in line and "= #" not in line.replace("  ", " ")
        lines.append(line[2:] if setting and name.isidentifier() and name != "calibration" else line)
    full = "\n".join(lines)
    assert full.count("\n# ") < text.count("\n# ") - 20
    assert parse_rig(full.encode(), where="full") == parse_rig(text.encode(), where="template")


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"table": TABLE + "speed = 3\n"}, "turntable.speed"),
        ({"more": "[scan]\nstep = 3\n"}, "scan.step"),
        ({"more": '[sacn]\nmode = "step"\n'}, "sacn"),
        ({"table": TABLE + "settle_ms = 250000\n"}, "1000 times too large"),
        ({"table": TABLE + "timeout_s = 2000\n"}, "1000 times too large"),
        ({"table": TABLE + "timeout_s = 0.002\n"}, "1000 times too small"),
        ({"camera": CAMERA + "exposure_us = 5\n"}, "1000 times too small"),
        ({"camera": CAMERA + "exposure_us = 2000000000\n"}, "1000 times too large"),
        ({"table": TABLE + "speed_deg_s = nan\n"}, "turntable.speed_deg_s"),
        ({"table": TABLE + "speed_deg_s = -3\n"}, "not plausible"),
        ({"table": TABLE + "min_deg = 10\nmax_deg = 5\n"}, "min_deg 10 is not below max_deg 5"),
        ({"table": TABLE + "min_deg = 10\n"}, "the scan turns from 0 to 360 deg"),
        ({"table": TABLE + "min_deg = 0\nbacklash_deg = 1\n"}, "taking up the backlash"),
        ({"table": TABLE + "tolerance_deg = 0.001\n"}, "below half a microstep"),
        ({"table": TABLE + "baud = 1234\n"}, "turntable.baud"),
        ({"table": TABLE + 'dialect = "marlin"\n'}, "turntable.dialect"),
        ({"table": '[turntable]\ndriver = "serial"\n'}, "needs a port"),
        ({"table": TABLE + 'port = "/dev/ttyUSB0"\n'}, "leave out port"),
        ({"table": '[turntable]\nport = "/dev/ttyUSB0"\n'}, "simulated camera looks at"),
        ({"laser": LASER + LASER}, "the same number stands twice"),
        ({"laser": LASER + "[[lasers]]\nnumber = 1\noutput = 1\n"}, "the same output"),
        ({"table": TABLE + 'dialect = "grbl"\n', "laser": LASER.replace("= 1", "= 2")}, "grbl boards"),
        ({"laser": ""}, "lasers"),
        ({"camera": '[camera]\ndriver = "v4l2"\n'}, "needs device"),
        ({"camera": '[camera]\ndriver = "stream"\nurl = "http://c/"\npath = "x"\n'}, "takes no path"),
        ({"camera": CAMERA + "width_px = 640\n"}, "go together"),
        ({"camera": CAMERA + 'encoding = "rgb8"\n'}, "camera.encoding"),
        ({"more": "[scan]\nto_deg = 0\n"}, "nothing to scan"),
        ({"more": "[scan]\nto_deg = 5\nstep_deg = 6\n"}, "longer than the whole scan"),
        ({"more": '[scan]\nmode = "continuous"\nexposures_us = [100]\n'}, "must stand still"),
        ({"more": '[[simulated.faults]]\nkind = "gremlin"\n'}, "kind"),
        ({"head": HEAD.replace("desk", "my desk")}, "name"),
        ({"head": HEAD.replace("turnscan.rig", "turnscan.recipe")}, "format"),
        ({"head": "format = [\n"}, "not TOML"),
        (
            {
                "table": '[turntable]\nport = "p"\n',
                "camera": '[camera]\ndriver = "images"\npath = "x"\n',
                "more": "[simulated]\nseed = 1\n",
            },
            "no driver is",
        ),
    ],
)
def test_bad_input_is_one_clear_error(changed: dict[str, str], says: str) -> None:
    with pytest.raises(DocumentError) as caught:
        rig(**changed)
    assert says in str(caught.value)
    assert "rig.toml" in str(caught.value)


def test_a_newer_version_is_not_guessed_at() -> None:
    with pytest.raises(FormatVersionError):
        rig(head=HEAD.replace("version = 1", "version = 2"))


def test_the_gear() -> None:
    table = TurntableSettings(driver="simulated", steps_per_turn=200, microsteps=16, gear_ratio=9.0)
    assert table.microsteps_per_degree == 80
    assert table.take_up_deg == 0
    loose = table.model_copy(update={"backlash_deg": 1.0})
    assert loose.take_up_deg > 1.0
