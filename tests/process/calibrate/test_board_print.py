"""A board made white: its print is gone, the stripe is not, and corners beside the stripe are out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from rendered_chain import BOARD, PRINTED, RenderedRig

from turnscan.ingest.room.boards import BoardCamera, BoardView
from turnscan.ingest.room.built_in import room_calibration
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.process.calibrate.board_print import EDGE_PX, whitened
from turnscan.process.calibrate.boards import BoardView as BoardFound
from turnscan.process.calibrate.boards import NoBoard, find_board
from turnscan.process.calibrate.plane_views import LaserFrame, watch
from turnscan.process.calibrate.pose import BoardPose, board_poses, rotation_of
from turnscan.process.calibrate.stripe_lines import StripeLine, find_stripe_lines
from turnscan.schemas.board import Board
from turnscan.schemas.scene import Emitter, Light, Sensor

CAMERA = room_calibration().intrinsics_or_fail()


def look(lasers: tuple[int, ...], *, stripe_dn: float = 30.0) -> BoardView:
    emitter = Emitter(laser=0, stripe_dn_at_1m=stripe_dn, line_sigma_mm=0.2)
    rig = SimulatedRig(room_calibration(), emitters=[emitter])
    boards = BoardCamera(rig, light=Light(ambient_dn=150, stripe_sigma_px=1.2), sensor=Sensor())
    at = np.eye(4)
    at[:3, :3] = rotation_of(np.array([0.2, -0.25, 0.1]))
    middle = np.append(PRINTED.corners_mm().mean(axis=0), 0.0)
    at[:3, 3] = np.array([20.0, 10.0, 700.0]) - at[:3, :3] @ middle
    return boards.look(PRINTED, at, seed=4, lasers=lasers)


def pose_of(view: BoardView) -> BoardPose:
    return board_poses(view.corners_px, BOARD.object_points_mm(), CAMERA)[0]


def off_px(line: StripeLine, view: BoardView) -> np.ndarray:
    truth = view.truth[0]
    return line.u_px - np.interp(line.v_px, truth.row, truth.u_px)


def test_the_squares_become_white_and_the_rest_stays() -> None:
    dark = look(())
    found = whitened(dark.image, BOARD, pose_of(dark), CAMERA)
    assert found is not None
    changed = found.grey != dark.image
    # Half of the squares were black, at a twentieth of the white.
    assert changed.sum() > 10_000
    beside = found.edge_px > 40
    assert beside.sum() > 20_000
    assert not changed[beside].any()
    low, high = dark.corners_px.min(axis=0), dark.corners_px.max(axis=0)
    inner = np.s_[round(low[1]) + 40 : round(high[1]) - 40, round(low[0]) + 60 : round(high[0]) - 60]
    assert dark.image[inner].std() > 50
    # Noise is left, and what shading varies within a square.
    assert found.grey[inner].std() < 4
    assert found.grey[inner].mean() == pytest.approx(150, abs=4)


def test_corners_lie_on_edges() -> None:
    view = look(())
    found = whitened(view.image, BOARD, pose_of(view), CAMERA)
    assert found is not None
    u, v = np.rint(view.corners_px).astype(int).T
    assert (found.edge_px[v, u] < EDGE_PX).all()
    # Half-way between four corners is half a square away from the next edge.
    grid = view.corners_px.reshape(6, 9, 2)
    middle = (grid[1:, 1:] + grid[:-1, :-1]).reshape(-1, 2) / 2
    u, v = np.rint(middle).astype(int).T
    assert (found.edge_px[v, u] > 8.0).all()


def test_what_is_no_chessboard_stays() -> None:
    circles = Board(kind="circles", cols=9, rows=6, square_x_mm=30, square_y_mm=30)
    view = look(())
    assert whitened(view.image, circles, pose_of(view), CAMERA) is None


def test_a_stripe_fainter_than_the_squares_is_found_in_its_place() -> None:
    view = look((0,))
    found = whitened(view.image, BOARD, pose_of(view), CAMERA)
    assert found is not None
    lines = find_stripe_lines(found.grey, CAMERA, edge_px=found.edge_px)
    mine = [line for line in lines if abs(np.median(off_px(line, view))) < 0.5]
    assert len(mine) == 1
    off = off_px(mine[0], view)
    assert len(off) > 40
    assert abs(off.mean()) < 3.0 * mine[0].sigma_px.mean() / np.sqrt(len(off))
    assert off.std() < 1.5 * mine[0].sigma_px.mean()
    u, v = np.rint(mine[0].u_px).astype(int), np.rint(mine[0].v_px).astype(int)
    assert found.edge_px[v, u].min() > EDGE_PX + 2.0


@pytest.mark.parametrize("pairs", [False, True])
def test_corners_that_the_stripe_pulls_are_left_out(pairs: bool) -> None:
    lit, dark = look((0,), stripe_dn=90.0), look(())
    frames = [LaserFrame("a", lit.image, dark.image if pairs else None)]
    (view,) = watch(frames, BOARD, CAMERA, channel="luma").views
    place = view.board_mm[:, :2] @ (1.0 / 30.0 * np.array([1.0, 9.0]))
    true = lit.corners_px[np.rint(place).astype(int)]
    assert np.linalg.norm(view.corners_px - true, axis=1).max() < 0.3
    if pairs:
        assert len(true) == 54
    else:
        truth = lit.truth[0]
        near = np.abs(true[:, 0] - np.interp(true[:, 1], truth.row, truth.u_px)) < 10
        assert 27 <= len(true) < 54
        assert not near.any()


def bright_frames(count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Boards lit by a laser that outshines the room: images, and where the corners are."""
    rig = RenderedRig(2)
    bright = Emitter(laser=0, stripe_dn_at_1m=250.0, line_sigma_mm=0.2)
    sim = SimulatedRig(rig.true, emitters=[bright])
    camera = BoardCamera(sim, light=rig.light, sensor=rig.sensor, blur_px=0.8)
    for i in range(count):
        pose = rig._pose((450.0, 1300.0), at_stripe=True)
        seen = camera.look(PRINTED, pose, seed=2, frame=i, lasers=(0,))
        yield seen.image, seen.corners_px


def test_a_bright_stripe_along_a_column_of_corners_costs_these_alone() -> None:
    camera = RenderedRig(2).true.intrinsics_or_fail()
    refused = 0
    for image, corners in bright_frames(6):
        if isinstance(find_board(image, BOARD), BoardFound):
            continue
        refused += 1
        (view,) = watch([LaserFrame("lit.png", image)], BOARD, camera, channel="luma").views
        assert len(view.corners_px) >= 40
        # Every corner that is kept is where it should be.
        off = np.linalg.norm(view.corners_px[:, None] - corners[None], axis=2).min(axis=1)
        assert off.max() < 0.2
    assert refused >= 3, "whole grids are refused for one bright stripe"


def test_a_hidden_column_lets_no_broken_grid_in() -> None:
    """On both sides of the stripe the grid is regular, but the sides do not go together."""
    dark = look(())
    found = find_board(dark.image, BOARD)
    assert isinstance(found, BoardFound)
    middle = found.points_px.reshape(6, 9, 2)[:, 4, 0].mean()
    hidden = np.zeros(dark.image.shape, np.bool_)
    hidden[:, int(middle) - 12 : int(middle) + 13] = True
    plain = find_board(dark.image, BOARD, hidden=hidden)
    assert isinstance(plain, BoardFound)
    assert not plain.whole
    broken = dark.image.copy()
    lower = np.roll(dark.image, round(0.45 * found.square_px), axis=0)
    broken[:, int(middle) :] = lower[:, int(middle) :]
    assert isinstance(find_board(broken, BOARD, hidden=hidden), NoBoard)
    hidden[:, : int(middle) + 60] = True
    few = find_board(dark.image, BOARD, hidden=hidden)
    assert isinstance(few, NoBoard)
    assert "a stripe hides" in few.reason
