"""Camera calibrations in a recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from turnscan.ingest.mcap_import import McapPlan, import_mcap, read_content
from turnscan.schemas.calibration import Calibration, Intrinsics
from turnscan.schemas.errors import (
    CalibrationError,
)
from turnscan.store import Archive

from ..images import pixels
from ..messages import cdr_writer as cdr
from ..recordings import T0, Recording
from .importing import joint, refused, ros_image

K = [300.0, 0.3, 31.5, 0.0, 301.0, 23.5, 0.0, 0.0, 1.0]
D = [-0.1, 0.02, 0.001, -0.002, 0.003]


def with_camera(path: Path, *cameras: bytes) -> Path:
    rec = Recording(path)
    joint(rec, T0, 0.1)
    for data in cameras:
        rec.ros("/camera/camera_info", "sensor_msgs/msg/CameraInfo", T0, data)
    ros_image(rec, T0, pixels())
    return rec.close()


def test_camera_info_becomes_the_snapshot(lab: Archive, tmp_path: Path) -> None:
    data = cdr.camera_info(T0, K, D)
    content = read_content(McapPlan(with_camera(tmp_path / "a.mcap", data, data), rig="r1"))
    assert content.calibration is not None
    camera = content.calibration.camera
    assert camera is not None
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (300.0, 301.0, 31.5, 23.5)
    assert camera.skew == pytest.approx(0.001, rel=1e-15)
    assert camera.distortion == tuple(D)
    summary = import_mcap(lab, content)
    assert summary.calibration == content.calibration.calibration_id()
    assert summary.rig == "r1"


@pytest.mark.parametrize(
    ("cameras", "what"),
    [
        ([cdr.camera_info(T0, [0.0] * 9, D)], "not calibrated"),
        ([cdr.camera_info(T0, K, D[:3])], "with 3 coefficients"),
        ([cdr.camera_info(T0, K, D, width=32)], "it is for 32 x 48, the images are 64 x 48"),
        ([cdr.camera_info(T0, K, D), cdr.camera_info(T0, K, D[:4])], "changes on the way"),
    ],
    ids=["zero", "short", "size", "changes"],
)
def test_cameras_that_cannot_be_kept_are_said_to_be_ignored(
    tmp_path: Path, cameras: list[bytes], what: str
) -> None:
    content = read_content(McapPlan(with_camera(tmp_path / "a.mcap", *cameras)))
    assert content.calibration is None
    (remark,) = content.remarks
    assert "camera calibration on /camera/camera_info is ignored" in remark
    assert what in remark


def test_a_given_calibration_wins(tmp_path: Path) -> None:
    path = with_camera(tmp_path / "a.mcap", cdr.camera_info(T0, K, D))
    camera = Intrinsics(width_px=64, height_px=48, fx_px=1, fy_px=1, cx_px=0, cy_px=0)
    given_one = Calibration(rig="r1", camera=camera)
    content = read_content(McapPlan(path, calibration=given_one))
    assert content.calibration == given_one
    assert "ignored: --calibration is given" in content.remarks[0]
    small = given_one.model_copy(update={"camera": camera.model_copy(update={"width_px": 60})})
    refused(path, "is for 60 x 48", CalibrationError, calibration=small)
