"""Cameras of the Caltech toolbox, OpenCV and ROS are read for what they are, and others refused."""

from __future__ import annotations

import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from turnscan.process.calibrate.foreign import read_foreign_camera
from turnscan.schemas.errors import TurnscanError

#: Calibration example 1 of the Caltech toolbox, as its page prints it: values and about 3 sigma.
CALTECH = {
    "fc": [657.30254, 657.74391],
    "cc": [302.71656, 242.33386],
    "alpha_c": 0.00042,
    "kc": [-0.25349, 0.11868, -0.00028, 0.00005, 0.0],
    "fc_error": [0.28487, 0.28937],
    "cc_error": [0.59115, 0.55710],
    "alpha_c_error": 0.00019,
    "kc_error": [0.00231, 0.00942, 0.00012, 0.00012, 0.0],
    "nx": 640,
    "ny": 480,
}

ROS = """image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [600.5, 0, 320.1, 0, 601, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.001, 0.0, 0]
"""


def caltech(**changed: object) -> bytes:
    out = io.BytesIO()
    values = {**CALTECH, **changed}
    savemat(
        out, {k: np.atleast_2d(np.array(v, np.float64)).T for k, v in values.items() if v is not None}
    )
    return out.getvalue()


def test_caltech_uncertainties_are_three_sigma() -> None:
    found = read_foreign_camera(caltech(), where="Calib_Results.mat")
    camera = found.intrinsics
    assert (camera.fx_px, camera.fy_px) == (657.30254, 657.74391)
    assert (camera.width_px, camera.height_px) == (640, 480)
    assert camera.skew == 0.00042
    assert camera.distortion == (-0.25349, 0.11868, -0.00028, 0.00005, 0.0)
    assert camera.covariance is not None
    sigma = np.sqrt(np.diag(np.array(camera.covariance)))
    printed = [0.28487, 0.28937, 0.59115, 0.5571, 0.00019, 0.00231, 0.00942, 0.00012, 0.00012, 0]
    assert np.allclose(sigma * 3, printed)
    assert "divided by 3" in found.notes[0]


def test_caltech_without_uncertainties_has_no_covariance() -> None:
    without = {f"{n}_error": None for n in ("fc", "cc", "alpha_c", "kc")}
    found = read_foreign_camera(caltech(**without), where="c.mat")
    assert found.intrinsics.covariance is None
    assert "no uncertainties" in found.notes[0]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (caltech(fc=None), "no fc and cc"),
        (caltech(nx=None, ny=None), "image size"),
        (caltech()[:200], "no fc and cc|damaged"),
        (caltech()[:-40], "damaged"),
        (caltech(fc=[-1.0, 2.0]), "fx_px"),
        (caltech(kc=[0.1, 0, 0, 0, 0, 0.3]), "6 distortion coefficients"),
        (b"MATLAB 7.3 MAT-file" + bytes(600), "damaged|7.3"),
    ],
)
def test_damaged_and_other_matlab_files_are_refused(data: bytes, words: str) -> None:
    with pytest.raises(TurnscanError, match=words):
        read_foreign_camera(data, where="c.mat")


def test_the_published_opencv_file_is_read(test_data: Path) -> None:
    data = (test_data / "opencv_left" / "left_intrinsics.yml").read_bytes()
    camera = read_foreign_camera(data, where="left").intrinsics
    assert camera.fx_px == pytest.approx(535.91573396163199)
    assert camera.cy_px == pytest.approx(235.57082909788173)
    assert camera.distortion[4] == pytest.approx(0.23839153080878486)
    assert (camera.width_px, camera.height_px) == (640, 480)


def test_plain_yaml_without_a_size_needs_one(test_data: Path) -> None:
    data = (test_data / "srv_turntable" / "calibration4.yaml").read_bytes()
    with pytest.raises(TurnscanError, match="image size") as caught:
        read_foreign_camera(data, where="calibration4.yaml")
    assert "--size-px" in (caught.value.hint or "")
    camera = read_foreign_camera(data, where="calibration4.yaml", size_px=(640, 480)).intrinsics
    assert camera.fx_px == pytest.approx(620.2678375549896)
    assert camera.distortion[4] == pytest.approx(-0.03519351082447173)


def test_ros_camera_info_is_read() -> None:
    camera = read_foreign_camera(ROS.encode(), where="head.yaml").intrinsics
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (600.5, 601, 320.1, 240)
    assert camera.distortion == (0.1, -0.2, 0.001, 0.0, 0.0)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_what_opencv_writes_is_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"camera{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 1024)
    storage.write("camera_matrix", np.array([[2400.0, 2.4, 640], [0, 2410, 512], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[0.1, 0.2, 0.003, 0.004, 0.5]]))
    storage.release()
    camera = read_foreign_camera(path.read_bytes(), where=path.name).intrinsics
    assert (camera.width_px, camera.fx_px, camera.cy_px) == (1280, 2400.0, 512.0)
    assert camera.skew == pytest.approx(0.001)
    assert camera.distortion == (0.1, 0.2, 0.003, 0.004, 0.5)


def test_nested_lists_in_json_are_read() -> None:
    value = {"camera": {"K": [[500, 0, 320], [0, 501, 240], [0, 0, 1]], "D": [0.1, 0.0, 0.0, 0.0]}}
    data = json.dumps(value).encode()
    camera = read_foreign_camera(data, where="k.json", size_px=(640, 480)).intrinsics
    assert camera.fy_px == 501
    assert camera.distortion == (0.1, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "camera matrix|neither"),
        (b"\xff\xfe\x00", "no calibration in text form"),
        (b"{", "not JSON"),
        (b"{}", "no camera matrix"),
        (b"hello: [1, 2", "neither YAML|no camera matrix"),
        (ROS.replace("plumb_bob", "equidistant").encode(), "equidistant"),
        (
            ROS.replace("[600.5, 0,", "[600.5, 7,").replace("0, 601", "3, 601").encode(),
            "no camera matrix",
        ),
        (ROS.replace("600.5", "-600.5").encode(), "no camera matrix"),
        (b'{"K": [[1,0],[0,1]], "D": [0], "width": 3, "height": 4}', "no camera matrix"),
    ],
)
def test_other_files_are_refused(data: bytes, words: str) -> None:
    with pytest.raises(TurnscanError, match=words):
        read_foreign_camera(data, where="camera")


def test_a_size_that_contradicts_the_file_is_refused() -> None:
    with pytest.raises(TurnscanError, match="640 x 480 px, not 1280 x 960"):
        read_foreign_camera(ROS.encode(), where="head.yaml", size_px=(1280, 960))
