"""Boards and stripes that cannot make a calibration: one clear error each, and nothing is written."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from console import Console, Inside, every_file

from turnscan.process.calibrate.pose import rotation_of
from turnscan.process.camera import project
from turnscan.schemas.calibration import Calibration, Intrinsics, parse_calibration
from turnscan.schemas.document import dump_json

sys.path.append(str(Path(__file__).parents[1] / "process" / "calibrate"))
from rendered_chain import PRINTED, RenderedRig

BOARD = ("--pattern", "9x6", "--square-mm", "30")


@pytest.fixture
def console(tmp_path: Path) -> Console:
    return Inside(tmp_path)


@pytest.fixture(scope="module")
def rig() -> RenderedRig:
    return RenderedRig(14)


def look(
    rig: RenderedRig, depth_mm: float, turn: tuple[float, float, float], *, lit: bool, x_mm: float = 0.0
) -> np.ndarray:
    """The board's middle at a depth, turned; with ``lit`` moved to where the laser is."""
    at = np.eye(4)
    at[:3, :3] = rotation_of(np.array(turn))
    plane = rig.true.lasers[0]
    if lit:
        x_mm = (plane.distance_mm - plane.normal[2] * depth_mm) / plane.normal[0] + 15.0
    middle = np.append(PRINTED.corners_mm().mean(axis=0), 0.0)
    at[:3, 3] = np.array([x_mm, -10.0, depth_mm]) - at[:3, :3] @ middle
    lasers = (0,) if lit else ()
    return rig.boards.look(PRINTED, at, seed=7, frame=int(depth_mm), lasers=lasers).image


def write(folder: Path, images: list[np.ndarray]) -> Path:
    folder.mkdir()
    for i, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"b{i}.png"), image)
    return folder


@pytest.fixture
def camera(rig: RenderedRig, tmp_path: Path) -> Path:
    path = tmp_path / "camera.json"
    document = Calibration(rig="chain", camera=rig.true.intrinsics_or_fail())
    path.write_bytes(dump_json(document.plain()))
    return path


def test_parallel_boards_do_not_fix_a_camera(
    console: Console, rig: RenderedRig, tmp_path: Path
) -> None:
    views = [
        look(rig, 450.0 + 60.0 * i, (0.0, 0.0, 0.1 * i), lit=False, x_mm=5.0 * i) for i in range(6)
    ]
    folder = write(tmp_path / "boards", views)
    said = console.fails("calibrate", "camera", folder, *BOARD, "-o", "cal.json")
    assert "all 6 views are parallel" in said
    assert "mm at 1 m" in said
    assert "tilt the board" in said
    assert not (tmp_path / "cal.json").exists()


def test_nearly_parallel_boards_are_kept_as_failed_with_what_it_means(
    console: Console, rig: RenderedRig, tmp_path: Path
) -> None:
    views = [
        look(rig, 450.0 + 60.0 * i, (0.05 * (i % 3), 0.04 * i, 0.1 * i), lit=False, x_mm=5.0 * i)
        for i in range(6)
    ]
    folder = write(tmp_path / "boards", views)
    done = console.run("calibrate", "camera", folder, *BOARD, "-o", "cal.json")
    assert done.returncode == 1
    assert "view spread is" in done.stderr
    assert "mm at 1 m" in done.stderr
    document = parse_calibration((tmp_path / "cal.json").read_bytes(), where="cal.json")
    assert "view spread" in [g.name for _, g in document.failed_gates()]


def test_exchanged_columns_and_rows_of_square_cells_do_no_harm(
    console: Console, rig: RenderedRig, tmp_path: Path
) -> None:
    """6x9 for 9x6: the same corners, counted the other way."""
    folder = write(tmp_path / "boards", [image for _, image in rig.camera_frames()][:6])
    words = ("--square-mm", "30", "--dry-run", "--min-coverage", "0.1")
    one = console.json("calibrate", "camera", folder, "--pattern", "9x6", *words)
    two = console.json("calibrate", "camera", folder, "--pattern", "6x9", *words)
    for a, b in zip(one["parameters"], two["parameters"], strict=True):
        assert a["value"] == pytest.approx(b["value"], abs=0.05 * a["sigma"] + 1e-9)


def test_frames_without_a_stripe_make_no_plane(
    console: Console, rig: RenderedRig, camera: Path, tmp_path: Path
) -> None:
    views = [look(rig, 500.0 + 90.0 * i, (0.2, -0.1 * i, 0.0), lit=False) for i in range(5)]
    folder = write(tmp_path / "dark", views)
    said = console.fails("calibrate", "plane", folder, *BOARD, "-c", camera, "-o", "plane.json")
    assert "in 0 of 5 views" in said or "no 3 views agree" in said
    assert not (tmp_path / "plane.json").exists()


@pytest.mark.slow
def test_photographs_without_a_laser_make_no_plane(
    console: Console, test_data: Path, tmp_path: Path
) -> None:
    """Edges of a room are straight, too, and some of them agree on a plane by chance."""
    camera = Intrinsics(
        width_px=640, height_px=480, fx_px=533.3, fy_px=533.4, cx_px=342.1, cy_px=234.0,
        distortion=(-0.28, 0.03, 0.001, 0.0, 0.16),
    )  # fmt: skip
    path = tmp_path / "camera.json"
    path.write_bytes(dump_json(Calibration(rig="left", camera=camera).plain()))
    before = every_file(tmp_path)
    said = console.fails(
        "calibrate", "plane", test_data / "opencv_left", "--pattern", "9x6", "--square-mm", "25",
        "-c", path, "-o", "plane.json",
    )  # fmt: skip
    assert "agree on a plane, as edges of the scene do by chance" in said
    assert "mm away" in said
    assert every_file(tmp_path) == before


@pytest.mark.slow
def test_a_bright_edge_that_stands_still_is_no_stripe(
    console: Console, test_data: Path, tmp_path: Path
) -> None:
    """Behind these boards is a white edge of a door, in the same place of all images."""
    path = tmp_path / "camera.json"
    camera = Intrinsics(
        width_px=640, height_px=480, fx_px=620.3, fy_px=618.6, cx_px=322.9, cy_px=239.4,
        distortion=(0.1137, -0.1937, -0.0011, -0.0022, -0.0352),
    )  # fmt: skip
    path.write_bytes(dump_json(Calibration(rig="srv", camera=camera).plain()))
    before = every_file(tmp_path)
    said = console.fails(
        "calibrate", "plane", test_data / "srv_turntable" / "camera_calibration", "--pattern", "8x6",
        "--square-mm", "40", "-c", path, "-o", "plane.json",
    )  # fmt: skip
    assert "passes the camera's centre at" in said
    assert "mm off in range" in said
    assert "stand still" in said
    assert every_file(tmp_path) == before


def test_a_stripe_on_the_wall_is_not_on_the_boards(
    console: Console, rig: RenderedRig, camera: Path, tmp_path: Path
) -> None:
    """A line that stands still while the board moves is in no plane that measures."""
    views = []
    y = np.linspace(-0.5, 0.5, 2000)
    line = np.stack([0.3 + 0.05 * y, y, np.ones_like(y)], axis=1)
    u, v = project(line, rig.true.intrinsics_or_fail())
    straight = np.interp(np.arange(480.0), v, u)
    for i in range(5):
        image = look(rig, 500.0 + 90.0 * i, (0.2, -0.1 * i, 0.0), lit=False).astype(float)
        across = np.arange(640)[None, :] - straight[:, None]
        image += 160.0 * np.exp(-0.5 * (across / 1.6) ** 2)
        views.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    folder = write(tmp_path / "wall", views)
    said = console.fails("calibrate", "plane", folder, *BOARD, "-c", camera, "-o", "plane.json")
    assert "no 3 views agree" in said
    assert "on the wall" in said
    assert not (tmp_path / "plane.json").exists()


def test_boards_that_all_face_one_way_fail_the_plane_with_the_mm(
    console: Console, rig: RenderedRig, camera: Path, tmp_path: Path
) -> None:
    views = [look(rig, 580.0 + 70.0 * i, (0.3, 0.1, 0.02 * i), lit=True) for i in range(6)]
    folder = write(tmp_path / "stripes", views)
    done = console.run("calibrate", "plane", folder, *BOARD, "-c", camera, "-o", "plane.json")
    assert done.returncode == 1
    assert "tilt between boards is" in done.stderr
    assert "all boards face the same way" in done.stderr
    assert "1 % of the range would be" in done.stderr
    document = parse_calibration((tmp_path / "plane.json").read_bytes(), where="plane.json")
    assert [g.name for _, g in document.failed_gates()] == ["tilt between boards"]


def test_stripes_of_boards_in_one_plane_let_the_laser_turn(
    console: Console, rig: RenderedRig, camera: Path, tmp_path: Path
) -> None:
    views = [look(rig, 700.0 + 1.0 * i, (0.0, 0.0, 0.05 * i), lit=True) for i in range(5)]
    folder = write(tmp_path / "stripes", views)
    said = console.fails("calibrate", "plane", folder, *BOARD, "-c", camera, "-o", "plane.json")
    assert "lie nearly on one line" in said
    assert "mm at" in said
    assert "nearer and farther" in said
    assert not (tmp_path / "plane.json").exists()
