"""One seeded run of the whole chain in the simulated room: boards, calibration, scan, truth.

Every run has a true rig of its own, other poses of the boards, other noise, a laser of other strength
on the boards, and angles that are not quite what the controller says. Everything is found in rendered
frames by the product's public functions; truth is used to judge alone.

The criterion. A run *recovers the truth* of a part if the part's error, as a Mahalanobis distance
under its stated covariance, is one that 95.45 % of honest estimates stay below: two sigma, in as many
dimensions as the part has. At one range the error is the mean over the scan's points there, which hides
the noise of the single points, and its sigma is that of the calibration: its covariance through the
mean slopes of these points, with what the stripes' noise leaves in a mean. A run recovers the truth of
*the ranges* if these errors, over the whole scan, are less than two of their sigmas (rms over the
ranges, 0.8 to 6 m).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import gammainc

from turnscan.ingest.room.board_patterns import Chessboard
from turnscan.ingest.room.boards import BoardCamera, camera_from_board_on_table
from turnscan.ingest.room.built_in import room_calibration, room_document
from turnscan.ingest.room.render import Truth, render
from turnscan.ingest.room.rig import SimulatedRig, forward_project
from turnscan.ingest.room.scene import Scene
from turnscan.process.calibrate.axis import fit_axis
from turnscan.process.calibrate.axis_views import watch_board
from turnscan.process.calibrate.boards import BoardView, find_board
from turnscan.process.calibrate.camera import calibrate_camera
from turnscan.process.calibrate.chained import chained
from turnscan.process.calibrate.difference import parameters_of
from turnscan.process.calibrate.observed import boards_of, one_observation, stripes_of, turning_of
from turnscan.process.calibrate.plane import fit_planes
from turnscan.process.calibrate.plane_views import LaserFrame, watch
from turnscan.process.calibrate.pose import rotation_of
from turnscan.process.calibrate.refine import refine
from turnscan.process.camera import undistort_points
from turnscan.process.extract import extract_stripe
from turnscan.process.triangulate import intersect, range_of
from turnscan.process.uncertainty import covariance_factor, range_slopes
from turnscan.schemas.board import Board
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.observations import Observations
from turnscan.schemas.scene import Emitter, Light, Sensor

PRINTED = Chessboard(9, 6, 30.0)
BOARD = Board(cols=9, rows=6, square_x_mm=30, square_y_mm=30)
CAMERA_VIEWS, PLANE_VIEWS, AXIS_VIEWS = 16, 12, 11
ANGLE_SD_DEG = 0.2
AXIS_STEP_DEG = 2.5
#: Share of a normal distribution within two standard deviations.
TWO_SIGMA = 0.9545
#: Where the walls of the room are judged: ranges from one to the next, mm.
RANGES_MM = (800.0, 1500.0, 2500.0, 4000.0, 6000.0)
SCAN_ANGLES_DEG = tuple(range(0, 360, 30))


@dataclass(frozen=True)
class Judged:
    """One range of a scan: points, mean error of their range, and its stated systematic 1 sigma."""

    range_mm: float
    points: int
    mean_error_mm: float
    sigma_mm: float

    @property
    def sigmas(self) -> float:
        """The error in its own sigmas."""
        return self.mean_error_mm / self.sigma_mm


@dataclass(frozen=True)
class Run:
    """What one seed gave: each range, and of each part the share of honest estimates that are nearer.

    ``apart`` are the same ranges if camera and plane counted as independent of each other; ``refined``
    and ``refined_parts`` are those of the joint adjustment of all that the three commands saw.
    """

    seed: int
    ranges: tuple[Judged, ...]
    apart: tuple[Judged, ...]
    parts: dict[str, float]
    refined: tuple[Judged, ...]
    refined_parts: dict[str, float]

    def recovered(self) -> dict[str, bool]:
        """Part, or ``ranges``, and whether its truth was recovered: see the module.

        With ``refined`` before them those of the joint adjustment, if it was made.
        """
        out = {}
        ways = (("", self.ranges, self.parts), ("refined ", self.refined, self.refined_parts))
        for way, ranges, parts in ways:
            out |= {way + role: share < TWO_SIGMA for role, share in parts.items()}
            if ranges:
                out[way + "ranges"] = float(np.mean([r.sigmas**2 for r in ranges])) < 4.0
        return out


def true_rig(rng: np.random.Generator) -> Calibration:
    """The paper's rig as it may come out of a workshop."""
    nominal = room_calibration()
    c = nominal.intrinsics_or_fail()
    f = c.fx_px * (1.0 + 0.01 * rng.standard_normal())
    camera = Intrinsics(
        width_px=c.width_px,
        height_px=c.height_px,
        fx_px=f,
        fy_px=f * (1.0 + 1e-3 * rng.standard_normal()),
        cx_px=c.cx_px + 8.0 * rng.standard_normal(),
        cy_px=c.cy_px + 8.0 * rng.standard_normal(),
        distortion=(-0.21 + 0.01 * rng.standard_normal(), 0.165, 8e-4, -1e-5, 0.0),
    )
    plane = nominal.lasers[0]
    normal = rotation_of(0.01 * rng.standard_normal(3)) @ np.array(plane.normal)
    laser = LaserPlane(
        laser=0,
        normal=_three(normal / np.linalg.norm(normal)),
        distance_mm=plane.distance_mm + 3.0 * float(rng.standard_normal()),
    )
    axis = nominal.axis_or_fail()
    direction = rotation_of(0.01 * rng.standard_normal(3)) @ np.array(axis.direction)
    return nominal.model_copy(
        update={
            "camera": camera,
            "lasers": (laser,),
            "turntable": TurntableAxis(
                point_mm=_three(np.array(axis.point_mm) + 3.0 * rng.standard_normal(3)),
                direction=_three(direction / np.linalg.norm(direction)),
                head=axis.head,
                positive_turn=axis.positive_turn,
            ),
        }
    )


class RenderedRig:
    """The true rig of one seed, its frames of boards and of the room."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = np.random.default_rng([20, seed])
        self.true = true_rig(self.rng)
        self.sensor = Sensor(noise_dn=float(self.rng.uniform(1.0, 3.0)), speckle_contrast=0.1)
        faint = Emitter(laser=0, stripe_dn_at_1m=float(self.rng.uniform(30.0, 80.0)), line_sigma_mm=0.2)
        self.light = Light(ambient_dn=float(self.rng.uniform(110.0, 190.0)), stripe_sigma_px=1.2)
        self._boards = SimulatedRig(self.true, emitters=[faint])
        self.boards = BoardCamera(
            self._boards,
            light=self.light,
            sensor=self.sensor,
            blur_px=float(self.rng.uniform(0.6, 1.0)),
        )
        self._frame = 0

    def camera_frames(self) -> Iterator[tuple[str, np.ndarray]]:
        """The board all over the image."""
        for i in range(CAMERA_VIEWS):
            yield f"camera{i:02d}.png", self._look(self._pose((380.0, 800.0), at_stripe=False), ())

    def plane_frames(self) -> Iterator[tuple[str, np.ndarray]]:
        """The board with the stripe on it, from near to as far as its squares are clear."""
        for i in range(PLANE_VIEWS):
            yield f"plane{i:02d}.png", self._look(self._pose((450.0, 1300.0), at_stripe=True), (0,))

    def axis_frames(self) -> Iterator[tuple[str, float, np.ndarray]]:
        """A board that stands in the room, seen by the turning head; and the angle as commanded."""
        nominal = AXIS_STEP_DEG * (np.arange(AXIS_VIEWS) - AXIS_VIEWS // 2)
        while True:
            turn = rotation_of(self.rng.uniform(-1, 1, 3) * (0.5, 0.5, 0.2))
            at = np.eye(4)
            at[:3, :3] = turn
            depth = self.rng.uniform(1050.0, 1250.0)
            middle = np.append(PRINTED.corners_mm().mean(axis=0), 0.0)
            at[:3, 3] = np.array([0.0, self.rng.uniform(-60, 20), depth]) - turn @ middle
            pose = self._boards.pose(0.0)
            scene_from_camera = np.eye(4)
            scene_from_camera[:3, :3], scene_from_camera[:3, 3] = pose.scene_from_camera, pose.camera_mm
            board = scene_from_camera @ at
            angles = np.deg2rad(nominal + ANGLE_SD_DEG * self.rng.standard_normal(AXIS_VIEWS))
            poses = [camera_from_board_on_table(self._boards, float(a), board) for a in angles]
            if all(self._inside(p, 12.0) for p in poses):
                break
        for i, p in enumerate(poses):
            yield f"axis{i:02d}.png", float(nominal[i]), self._look(p, ())

    def scan_frames(self) -> Iterator[tuple[float, np.ndarray, Truth]]:
        """Frames of the room with their angle (rad) and truth."""
        document = room_document()
        scene = Scene(document.shapes)
        rig = SimulatedRig(self.true, emitters=[Emitter(laser=0, stripe_dn_at_1m=600.0)])
        for i, angle in enumerate(SCAN_ANGLES_DEG):
            made = render(
                scene,
                rig,
                math.radians(angle),
                seed=self.seed,
                frame=i,
                light=document.light,
                sensor=document.sensor,
            )
            yield math.radians(angle), made.image, made.truth[0]

    def _look(self, pose: np.ndarray, lasers: tuple[int, ...]) -> np.ndarray:
        self._frame += 1
        return self.boards.look(PRINTED, pose, seed=self.seed, frame=self._frame, lasers=lasers).image

    def _pose(self, reach_mm: tuple[float, float], *, at_stripe: bool) -> np.ndarray:
        """camera_from_board of a board that is whole in the image, tilted up to some 35 degrees."""
        camera, plane = self.true.intrinsics_or_fail(), self.true.lasers[0]
        middle = np.append(PRINTED.corners_mm().mean(axis=0), 0.0)
        while True:
            out = np.eye(4)
            out[:3, :3] = rotation_of(self.rng.uniform(-1, 1, 3) * (0.6, 0.6, 0.3))
            depth = self.rng.uniform(*reach_mm)
            x = self.rng.uniform(-0.45, 0.45) * camera.width_px / camera.fx_px * depth
            y = self.rng.uniform(-0.45, 0.45) * camera.height_px / camera.fy_px * depth
            if at_stripe:
                n = plane.normal
                x = (plane.distance_mm - n[1] * y - n[2] * depth) / n[0] + self.rng.uniform(-70, 70)
            out[:3, 3] = np.array([x, y, depth]) - out[:3, :3] @ middle
            if self._inside(out, 6.0):
                return out

    def _inside(self, pose: np.ndarray, margin_px: float) -> bool:
        """Whether all squares are in the image."""
        camera = self.true.intrinsics_or_fail()
        s = PRINTED.square_mm
        low, high = np.array([-s, -s]), np.array([PRINTED.columns * s, PRINTED.rows * s])
        flat = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
        u, v = forward_project(flat @ pose[:3, :3].T + pose[:3, 3], camera)
        size = (camera.width_px - 1 - margin_px, camera.height_px - 1 - margin_px)
        return bool(
            (u > margin_px).all()
            and (v > margin_px).all()
            and (u < size[0]).all()
            and (v < size[1]).all()
        )


def run(seed: int, *, refined: bool = True) -> Run:
    """The whole chain for one seed; without ``refined`` nothing is judged of the joint adjustment."""
    rig = RenderedRig(seed)
    document, seen = calibrated(rig)
    stripes = scanned(rig)
    joint = refine(seen, document).calibration() if refined else None
    return Run(
        seed=seed,
        ranges=tuple(judged(document, stripes)),
        apart=tuple(judged(document.model_copy(update={"joint": None}), stripes)),
        parts=nearer(document, rig.true),
        refined=tuple(judged(joint, stripes)) if joint else (),
        refined_parts=nearer(joint, rig.true) if joint else {},
    )


def nearer(document: Calibration, true: Calibration) -> dict[str, float]:
    """Of every part the share of honest estimates whose Mahalanobis distance is smaller."""
    out = {}
    for role, part in document.parts().items():
        if role == "joint":
            continue
        error = parameters_of(part) - parameters_of(true.parts()[role])
        if role == "axis":
            # The origin along the axis is a choice: beside the camera's centre for a turning head.
            axis = true.axis_or_fail()
            point, direction = np.array(axis.point_mm), np.array(axis.direction)
            error[:3] += direction * (point @ direction)
        covariance = np.array(part.covariance)  # type: ignore[attr-defined]
        unit = np.sqrt(np.diag(covariance))
        unit[unit == 0] = 1.0
        size, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
        known = size > 1e-9 * size.max()
        square = float(np.sum((axes.T @ (error / unit))[known] ** 2 / size[known]))
        out[role] = float(gammainc(known.sum() / 2.0, square / 2.0))
    return out


def calibrated(rig: RenderedRig) -> tuple[Calibration, list[Observations]]:
    """Camera, plane and axis one after the other, and what the three would save for refine."""
    views = [find_board(image, BOARD, name=name) for name, image in rig.camera_frames()]
    found = [v for v in views if isinstance(v, BoardView)]
    estimate = calibrate_camera(found)
    camera = estimate.intrinsics
    size = (camera.width_px, camera.height_px)
    document = Calibration(rig="chain", camera=camera)
    watched = watch(
        [LaserFrame(name, image) for name, image in rig.plane_frames()], BOARD, camera, channel="luma"
    )
    (plane,) = fit_planes(watched.views, camera)
    document = chained(document, [plane.follower(0)])
    seen = [
        one_observation(size, boards=boards_of(estimate.views)),
        one_observation(size, boards=stripes_of(watched.views, [plane], [0])),
    ]
    frames = list(rig.axis_frames())
    turned = watch_board([(name, image) for name, _, image in frames], BOARD, camera)
    sd = math.radians(ANGLE_SD_DEG)
    fit = fit_axis(
        turned.sightings,
        [name for name, _, _ in frames],
        np.deg2rad([angle for _, angle, _ in frames]),
        camera,
        head="rotates",
        angle_sd_rad=sd,
    )
    document = chained(document, [fit.follower()])
    seen.append(one_observation(size, turning=turning_of(fit, sd)))
    return document, seen


def scanned(rig: RenderedRig) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of all stripe points of the room away from edges: u, v, sigma px, and the true range."""
    parts = []
    for _, image, truth in rig.scan_frames():
        points = extract_stripe(image)
        single = np.bincount(truth.row, minlength=image.shape[0]) == 1
        range_mm = np.full(image.shape[0], np.nan)
        u_px = np.full(image.shape[0], np.nan)
        range_mm[truth.row], u_px[truth.row] = truth.range_mm, truth.u_px
        range_mm[~single] = np.nan
        # Near an edge of what stands in the room, or in a corner of it, the truth of a row is not one.
        bend = np.abs(np.diff(range_mm, 2, prepend=np.nan, append=np.nan)) > 2e-3 * range_mm
        rough = np.convolve(bend | ~np.isfinite(range_mm), np.ones(9), mode="same") > 0.5
        row = points["row"].astype(int)
        good = ~rough[row] & (np.abs(points["u_px"] - u_px[row]) < 1.0)
        row = row[good]
        parts.append(
            np.stack([points["u_px"][good], row + 0.0, points["sigma_u_px"][good], range_mm[row]])
        )
    u, v, sigma, true = np.concatenate(parts, axis=1)
    return u, v, sigma, true


def judged(document: Calibration, stripes: tuple[np.ndarray, ...]) -> list[Judged]:
    """Mean error of the range in every bin of :data:`RANGES_MM`, and what is stated of that mean."""
    u, v, sigma_px, true = stripes
    camera, plane = document.intrinsics_or_fail(), document.plane_or_fail(0)
    found = range_of(intersect(*undistort_points(u, v, camera), plane))
    by_pixel, slopes = range_slopes(u, v, along_v=False, camera=camera, plane=plane)
    factor = covariance_factor(camera, plane, document.joint)
    out = []
    for low, high in pairwise(RANGES_MM):
        mine = (true > low) & (true < high)
        n = int(mine.sum())
        if n < 50:
            continue
        systematic = float(np.linalg.norm(slopes[mine].mean(axis=0) @ factor))
        random = float(np.sqrt(np.sum((by_pixel[mine] * sigma_px[mine]) ** 2))) / n
        error = float(np.mean(found[mine] - true[mine]))
        out.append(Judged(float(true[mine].mean()), n, error, math.hypot(systematic, random)))
    return out


def _three(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
