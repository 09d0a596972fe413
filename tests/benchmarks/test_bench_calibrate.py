"""`calibrate camera` against the two OpenCV calls it stands on: 27 images of 640 x 480."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from bench import best_cpu, show

from turnscan.process.calibrate.boards import BoardView, find_board
from turnscan.process.calibrate.camera import calibrate_camera
from turnscan.schemas.board import Board

pytestmark = pytest.mark.benchmark
BOARD = Board(cols=8, rows=6, square_x_mm=40, square_y_mm=40)


def test_27_images_against_opencv_alone(test_data: Path) -> None:
    paths = sorted((test_data / "srv_turntable" / "camera_calibration").glob("*.jpg"))
    images = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in paths]
    assert len(images) == 27
    flat = BOARD.object_points_mm().astype(np.float32)

    def opencv() -> None:
        found = [cv2.findChessboardCorners(image, (8, 6))[1] for image in images]
        points = [np.asarray(c, np.float32).reshape(-1, 2) for c in found]
        cv2.calibrateCamera([flat] * 27, points, (640, 480), None, None)

    def ours() -> None:
        views = [find_board(image, BOARD) for image in images]
        assert all(isinstance(v, BoardView) for v in views)
        calibrate_camera([v for v in views if isinstance(v, BoardView)])

    took = best_cpu({"opencv": opencv, "ours": ours}, rounds=5)
    show("camera from 27 images / OpenCV alone", took["ours"] / took["opencv"], 2.0)
