"""Images of boards, drawn point by point from the camera model, and views without images."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from turnscan.process.calibrate.boards import BoardView
from turnscan.process.calibrate.patterns import charuco_board
from turnscan.process.calibrate.projection import project_points, rotation_of
from turnscan.process.camera import undistort_points
from turnscan.schemas.board import Board
from turnscan.schemas.calibration import Intrinsics

#: fx fy cx cy skew k1 k2 p1 p2 k3 of a camera with a visible lens and a skew that OpenCV cannot have.
TRUTH = np.array([520.0, 522.0, 235.0, 182.0, 0.002, -0.22, 0.08, 0.0008, -0.0005, 0.0])
WIDTH, HEIGHT = 480, 360
_TIMES = 3

CHESS = Board(cols=9, rows=6, square_x_mm=20, square_y_mm=20)
CHARUCO = Board(
    kind="charuco",
    cols=7,
    rows=5,
    square_x_mm=24,
    square_y_mm=24,
    marker_mm=17,
    dictionary="4X4_50",
)
CIRCLE_RADIUS_MM = 7.0
CIRCLES = Board(kind="circles", cols=7, rows=5, square_x_mm=24, square_y_mm=24)
ACIRCLES = Board(kind="acircles", cols=4, rows=9, square_x_mm=16, square_y_mm=16)


def intrinsics_of(camera: np.ndarray, width: int = WIDTH, height: int = HEIGHT) -> Intrinsics:
    fx, fy, cx, cy, skew, *lens = map(float, camera)
    return Intrinsics(
        width_px=width,
        height_px=height,
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        skew=skew,
        distortion=tuple(lens),
    )


@functools.lru_cache(maxsize=1)
def _rays() -> tuple[np.ndarray, np.ndarray]:
    # A sample somewhere in each part of a pixel: on a regular grid, edges would snap to it.
    rng = np.random.default_rng(5)
    shape = (HEIGHT * _TIMES, WIDTH * _TIMES)
    u = (np.arange(shape[1]) + rng.random(shape)) / _TIMES - 0.5
    v = (np.arange(shape[0])[:, None] + rng.random(shape)) / _TIMES - 0.5
    return undistort_points(u, v, intrinsics_of(TRUTH))


def pose(board: Board, tilt_deg: tuple[float, float, float], at_mm: tuple[float, float, float]):
    """camera_from_board with the board's middle at ``at_mm`` in camera space."""
    turn = rotation_of(np.deg2rad(np.array(tilt_deg, np.float64)))
    middle = board.object_points_mm().mean(axis=0)
    return turn, np.array(at_mm, np.float64) - turn @ middle


def _texture(board: Board, x: np.ndarray, y: np.ndarray, border: bool) -> np.ndarray:
    """Brightness 0..1 at board coordinates in mm; grey outside of the sheet."""
    sx, sy = board.square_x_mm, board.square_y_mm
    right, down = board.size_mm()
    if board.kind == "chessboard":
        edge = 1.0 if border else 0.0
        inside = (x > -sx) & (x < right + sx) & (y > -sy) & (y < down + sy)
        sheet = (
            (x > -sx * (1 + edge))
            & (x < right + sx * (1 + edge))
            & (y > -sy * (1 + edge))
            & (y < down + sy * (1 + edge))
        )
        cell = (np.floor(x / sx) + np.floor(y / sy)) % 2
        return np.where(inside, cell, np.where(sheet, 1.0, 0.25))
    if board.kind == "charuco":
        step = 40
        size = (board.cols + 1) * step, (board.rows + 1) * step
        drawn = charuco_board(board).generateImage(size, None, 0, 1).astype(np.float64) / 255
        u = ((x / sx + 1) * step).astype(int)
        v = ((y / sy + 1) * step).astype(int)
        good = (u >= 0) & (u < size[0]) & (v >= 0) & (v < size[1])
        return np.where(good, drawn[np.clip(v, 0, size[1] - 1), np.clip(u, 0, size[0] - 1)], 1.0)
    row = np.clip(np.rint(y / sy), 0, board.rows - 1)
    shift, step = (row % 2, 2) if board.kind == "acircles" else (0, 1)
    col = np.clip(np.rint((x / sx - shift) / step), 0, board.cols - 1)
    off = (x - (step * col + shift) * sx) ** 2 + (y - row * sy) ** 2
    return np.where(off < CIRCLE_RADIUS_MM**2, 0.0, 1.0)


def render(
    board: Board,
    turn: np.ndarray,
    shift: np.ndarray,
    *,
    seed: int = 1,
    blur_px: float = 0.6,
    border: bool = True,
    noise_dn: float = 1.5,
) -> np.ndarray:
    """The (HEIGHT, WIDTH) uint8 image of the board."""
    xn, yn = _rays()
    # The board's plane in its own coordinates: turn.T (r d - shift) has z = 0.
    normal = turn[:, 2]
    depth = (normal @ shift) / (normal[0] * xn + normal[1] * yn + normal[2])
    inverse = turn.T
    px, py, pz = depth * xn - shift[0], depth * yn - shift[1], depth - shift[2]
    x = inverse[0, 0] * px + inverse[0, 1] * py + inverse[0, 2] * pz
    y = inverse[1, 0] * px + inverse[1, 1] * py + inverse[1, 2] * pz
    fine = _texture(board, x, y, border)
    image = fine.reshape(HEIGHT, _TIMES, WIDTH, _TIMES).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur_px)
    image = 30 + 190 * image + np.random.default_rng(seed).normal(0, noise_dn, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


#: Tilts and places that fill the image, for boards of some 180 x 120 mm.
VIEWS = (
    ((0, 0, 0), (0, 0, 330)),
    ((30, 0, 5), (-30, 15, 330)),
    ((-30, 5, 0), (30, -15, 340)),
    ((0, 32, 0), (10, 20, 350)),
    ((5, -32, 0), (-10, -20, 350)),
    ((22, 22, 10), (35, 25, 370)),
    ((-22, 20, -10), (-35, -25, 370)),
    ((20, -25, 90), (20, 0, 420)),
)


def rendered(board: Board, **how: object) -> list[np.ndarray]:
    """The board in every pose of VIEWS."""
    return [
        render(board, *pose(board, *view), seed=i, **how)  # type: ignore[arg-type]
        for i, view in enumerate(VIEWS)
    ]


def exact_points(board: Board, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Where the board's points are in the image, px."""
    return project_points(TRUTH, board.object_points_mm() @ turn.T + shift)


def made_views(
    count: int,
    *,
    noise_px: float = 0.1,
    seed: int = 0,
    board: Board = CHESS,
    camera: np.ndarray = TRUTH,
    tilt_rad: float = 0.4,
) -> list[BoardView]:
    """Views of random poses that lie whole in the image, with Gaussian noise."""
    rng = np.random.default_rng(seed)
    points = board.object_points_mm()
    views: list[BoardView] = []
    while len(views) < count:
        turn = rotation_of(rng.normal(0, tilt_rad, 3) * (1, 1, 0.3))
        at = np.array([rng.uniform(-60, 60), rng.uniform(-50, 50), rng.uniform(250, 500)])
        seen = project_points(camera, points @ turn.T + at - turn @ points.mean(axis=0))
        if (seen < 4).any() or (seen > (WIDTH - 5, HEIGHT - 5)).any():
            continue
        seen = seen + rng.normal(0, noise_px, seen.shape)
        views.append(
            BoardView(
                name=f"view{len(views)}",
                board=board,
                ids=np.arange(board.points),
                points_px=seen,
                points_mm=points,
                width_px=WIDTH,
                height_px=HEIGHT,
                square_px=20.0,
                window_px=5,
                irregular_px=0.1,
                blur_px=0.8,
                detector="made",
            )
        )
    return views
