"""Pictures of a flat calibration board at a pose, the laser's line on it, and the truth of both."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.errors import InputError
from ...schemas.scene import Light, Plane, Sensor
from .board_painting import BEHIND, paint
from .board_patterns import Board, Print
from .noise import key_of
from .rays import Floats
from .render import (
    SCALES,
    SPECKLE,
    Encoding,
    Image,
    Truth,
    add_stripe,
    ambient,
    as_truth,
    develop,
    lit_points,
)
from .rig import Pose, SimulatedRig, forward_project, unproject_all
from .scene import Scene
from .stripe import along_row
from .trace import ROW, U

#: A stripe is drawn at least this wide before it is blurred.
_NARROWEST_PX: Final = 0.2


@dataclass(frozen=True)
class BoardView:
    """A picture of a board and what is true of it.

    ``corners_px`` (N, 2) is where the board's corners are truly seen (distorted, sub-pixel),
    ``in_view`` (N,) whether that is inside the frame and on the side that is seen. ``truth`` holds each
    lit laser's stripe on the board, its ``points_mm`` in **camera** space, its amplitudes as on white.
    """

    image: Image
    corners_px: Floats
    corners_mm: Floats
    in_view: npt.NDArray[np.bool_]
    truth: dict[int, Truth]


def camera_from_board_on_table(rig: SimulatedRig, angle_rad: float, scene_from_board: Floats) -> Floats:
    """``camera_from_board`` (4, 4) of a board that is fixed in scene space, at a turntable angle."""
    pose = rig.pose(angle_rad)
    camera_from_scene = np.eye(4)
    camera_from_scene[:3, :3] = pose.scene_from_camera.T
    camera_from_scene[:3, 3] = -pose.scene_from_camera.T @ pose.camera_mm
    return camera_from_scene @ scene_from_board


class BoardCamera:
    """Takes pictures of boards with the camera and the lasers of a simulated rig.

    ``blur_px`` is the point spread of lens and sensor (standard deviation) that blurs all edges.
    """

    def __init__(
        self,
        rig: SimulatedRig,
        *,
        light: Light,
        sensor: Sensor | None = None,
        blur_px: float = 0.8,
        encoding: Encoding = "mono8",
    ) -> None:
        self.rig = rig
        self.light, self.sensor = light, sensor or Sensor()
        self.blur_px, self.encoding = blur_px, encoding
        height, width = rig.camera.height_px, rig.camera.width_px
        v, u = np.mgrid[0 : height + 1, 0 : width + 1] - 0.5
        rays = unproject_all(rig.lens, np.stack([u.ravel(), v.ravel()], axis=1))
        self._rays = rays.reshape(height + 1, width + 1, 2)

    def look(
        self,
        board: Board,
        camera_from_board: Floats,
        *,
        seed: int,
        frame: int = 0,
        lasers: Iterable[int] = (),
        exposure_us: float | None = None,
    ) -> BoardView:
        """A picture of ``board`` at a pose (4, 4), ``lasers`` lit; equal arguments give equal bytes."""
        rotation, at = _rigid(camera_from_board)
        printed = board.printed()
        albedo = self._albedo(printed, rotation, at)
        pose = Pose(rotation.T.copy(), -rotation.T @ at)
        gain = 1.0 if exposure_us is None else exposure_us / self.light.exposure_us
        picture = ambient(self.rig.camera, self.light, gain, self.encoding)
        plate, offset = _plate(printed)
        # The board stands still in board space, so that is the scene here; its middle is the origin.
        moved = Pose(pose.scene_from_camera, pose.camera_mm - offset)
        truth: dict[int, Truth] = {}
        for laser in sorted(set(lasers)):
            fan = self.rig.fan(laser)
            found, peak, sigma = lit_points(plate, self.rig, fan, moved, self.light)
            if not _faces(rotation, at):
                found, peak, sigma = found[:0], peak[:0], sigma[:0]
            wide = along_row(found, sigma)
            # The blur comes at the end, on edges and stripe alike.
            narrow = along_row(found, np.sqrt(np.maximum(sigma**2 - self.blur_px**2, _NARROWEST_PX**2)))
            points = np.column_stack([found[:, ROW], found[:, U], peak * gain * wide / narrow, narrow])
            key = key_of(seed, SPECKLE, laser, *(float(a) for a in camera_from_board.ravel()))
            add_stripe(picture, fan, points, self.sensor, key)
            made = as_truth(fan, found, peak * gain * SCALES[self.encoding], wide)
            truth[laser] = replace(made, points_mm=moved.to_camera(made.points_mm))
        picture *= albedo[:, :, None]
        if self.blur_px > 0:
            blurred = cv2.GaussianBlur(picture, (0, 0), self.blur_px, borderType=cv2.BORDER_REPLICATE)
            picture = np.asarray(blurred, np.float32).reshape(picture.shape)
        image = develop(picture, self.sensor, self.encoding, seed=seed, frame=frame)
        corners = board.corners_mm()
        corners_px, in_view = self._corners(corners, rotation, at)
        return BoardView(image, corners_px, corners, in_view, truth)

    def _albedo(self, printed: Print, rotation: Floats, at: Floats) -> npt.NDArray[np.float32]:
        camera = self.rig.camera
        out = np.full((camera.height_px, camera.width_px), np.float32(BEHIND))
        if not _faces(rotation, at):
            return out
        board_from_ray = np.linalg.inv(np.column_stack([rotation[:, 0], rotation[:, 1], at]))
        paint(self._rays, board_from_ray, printed, out)
        return out

    def _corners(
        self, corners: Floats, rotation: Floats, at: Floats
    ) -> tuple[Floats, npt.NDArray[np.bool_]]:
        points = np.column_stack([corners, np.zeros(len(corners))]) @ rotation.T + at
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = forward_project(points, self.rig.camera)
            radius = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
        camera = self.rig.camera
        inside = (u > -0.5) & (u < camera.width_px - 0.5) & (v > -0.5) & (v < camera.height_px - 0.5)
        ahead = (points[:, 2] > 0) & (radius < self.rig.view_radius) & _faces(rotation, at)
        return np.column_stack([u, v]), inside & ahead


def _faces(rotation: Floats, at: Floats) -> bool:
    """Whether the camera sees the print. The plate's back is as dark as what is behind it."""
    return bool(rotation[:, 2] @ at > 0)


def _rigid(camera_from_board: Floats) -> tuple[Floats, Floats]:
    pose = np.asarray(camera_from_board, np.float64)
    good = pose.shape == (4, 4) and np.isfinite(pose).all()
    if good:
        turn = pose[:3, :3]
        good = np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) and np.linalg.det(turn) > 0
    if not good or not np.array_equal(pose[3], [0, 0, 0, 1]):
        raise InputError(
            "camera_from_board is not a rigid transform (4, 4)",
            hint="a rotation without mirroring, a translation in mm, last row 0 0 0 1",
        )
    return pose[:3, :3], pose[:3, 3]


def _plate(printed: Print) -> tuple[Scene, Floats]:
    """The board's plate as a scene about its own middle, and where that is in board space."""
    low, high = np.array(printed.low_mm), np.array(printed.high_mm)
    x, y = (float(a) for a in high - low)
    plate = Plane(kind="plane", size_mm=(x, y), albedo=1.0)
    return Scene((plate,)), np.array([*(low + high) / 2, 0.0])
