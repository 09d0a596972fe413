"""From a rig file to a simulated camera: built-in scenes, scene files, tables; and what is wrong."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.room.built_in import BUILT_IN_CALIBRATIONS, BUILT_IN_SCENES
from turnscan.ingest.room.camera import SimulatedCamera
from turnscan.ingest.room.opening import open_scene, relit, simulated_camera, true_calibration
from turnscan.schemas.document import dump_json, validate
from turnscan.schemas.errors import CalibrationError, DocumentError, InputError
from turnscan.schemas.rig import Rig

SCENE = 'format = "turnscan.scene"\nversion = 1\n[[shapes]]\nkind = "mesh"\nfile = "part.stl"\n'


def rig_file(calibration: str | None = None, **more: Any) -> Rig:
    table = {
        "name": "sim",
        "turntable": {"driver": "simulated"},
        "lasers": [{"number": 0, "output": 1}],
        "camera": {"driver": "simulated", **more.pop("camera", {})},
        "simulated": more,
    }
    if calibration is not None:
        table["calibration"] = calibration
    return validate(Rig, table, where="rig.toml")


def build(rig: Rig, folder: Path = Path()) -> SimulatedCamera:
    return simulated_camera(
        rig,
        SystemClock(),
        actual_angle_rad=lambda _: 0.0,
        lasers_lit=lambda _: [0],
        folder=folder,
        where="rig.toml",
    )


@pytest.mark.parametrize("name", BUILT_IN_SCENES)
def test_built_in_scenes_need_nothing_else(name: str) -> None:
    """At every angle each laser is seen, somewhere between too dark and saturated."""
    calibration = BUILT_IN_CALIBRATIONS[name]()
    rig = rig_file(scene=name, seed=9)
    assert true_calibration(rig, folder=Path(), where="rig.toml") == calibration
    camera = build(rig)
    assert camera.look.seed == 9
    camera.open()
    rows = 0
    for _ in range(2):
        shot = camera.shoot(0)
        rows += len(shot.truth.lasers[0].row)
        assert shot.image.max() > 60
    assert rows > 300
    camera.close()


def test_a_scene_file_with_a_mesh_beside_it(tmp_path: Path) -> None:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "one.toml").write_text(SCENE)
    facet = struct.pack("<12fH", 0, 0, 1, -50, -50, 0, 50, -50, 0, 0, 60, 0, 0)
    (tmp_path / "scenes" / "part.stl").write_bytes(b"".ljust(80) + struct.pack("<I", 1) + facet)
    (tmp_path / "cal.json").write_bytes(dump_json(BUILT_IN_CALIBRATIONS["desk"]().plain()))
    camera = build(
        rig_file("cal.json", scene="scenes/one.toml", camera={"encoding": "mono16"}), tmp_path
    )
    info = camera.open()
    assert info.encoding == "mono16"
    shot = camera.shoot(0)
    assert len(shot.truth.lasers[0].row) > 50
    assert np.abs(shot.truth.lasers[0].points_mm[:, 2]).max() < 1e-9
    (tmp_path / "scenes" / "part.stl").unlink()
    with pytest.raises(InputError, match=r"cannot read the mesh .*part.stl"):
        build(rig_file("cal.json", scene="scenes/one.toml"), tmp_path)


def test_light_of_the_rig_file_goes_over_that_of_the_scene() -> None:
    document, _ = open_scene("desk", folder=Path(), where="rig.toml")
    changed = relit(document, {"ambient_dn": 77, "noise_dn": 0}, where="rig.toml")
    assert (changed.light.ambient_dn, changed.sensor.noise_dn) == (77, 0)
    assert changed.light.focus_mm == document.light.focus_mm
    with pytest.raises(DocumentError, match=r"rig.toml: simulated.light has no 'ambient'"):
        relit(document, {"ambient": 5}, where="rig.toml")
    with pytest.raises(DocumentError, match=r"simulated.light: noise_dn: .*\(found -1\)"):
        relit(document, {"noise_dn": -1}, where="rig.toml")


def test_what_is_wrong_in_a_rig_file(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"simulated.scene = 'gone.toml' is no built-in scene"
    ) as caught:
        build(rig_file(scene="gone.toml"), tmp_path)
    assert "desk, room" in str(caught.value.hint)
    with pytest.raises(DocumentError, match=r"rig.toml: simulated.scene: shapes.0: .*'cube'"):
        open_scene({"shapes": [{"kind": "cube"}]}, folder=tmp_path, where="rig.toml")
    table = {"shapes": [{"kind": "sphere", "radius_mm": 5}]}
    with pytest.raises(CalibrationError, match="needs a calibration, and this scene has none"):
        build(rig_file(scene=table))
    with pytest.raises(InputError, match=r"cannot read the calibration .*none.json"):
        build(rig_file("none.json", scene=table), tmp_path)
    with pytest.raises(CalibrationError, match="camera is 320 x 240, its calibration 640 x 480 px"):
        build(rig_file(camera={"width_px": 320, "height_px": 240}))
    two = rig_file().model_copy(
        update={
            "lasers": validate(
                Rig,
                {
                    **rig_file().plain(),
                    "lasers": [{"number": 0, "output": 1}, {"number": 1, "output": 2}],
                },
                where="r",
            ).lasers
        }
    )
    with pytest.raises(CalibrationError, match="no plane of laser 1"):
        build(two)
