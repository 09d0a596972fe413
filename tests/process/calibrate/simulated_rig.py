"""The paper's rig as numbers: what its camera would see of boards, walls, a table, with stated noise.

Camera of the paper (f = 762 px, 640 x 480, its lens), laser 300 mm to the right. Nothing is drawn:
corners and stripe points are projected and displaced.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from turnscan.process.calibrate.axis import fit_axis
from turnscan.process.calibrate.axis_adjust import Sightings
from turnscan.process.calibrate.boards import BoardView
from turnscan.process.calibrate.camera import calibrate_camera
from turnscan.process.calibrate.observed import (
    boards_of,
    one_observation,
    stripes_of,
    turning_of,
    wall_of,
)
from turnscan.process.calibrate.plane import fit_planes
from turnscan.process.calibrate.plane_consensus import PlaneView
from turnscan.process.calibrate.pose import board_poses, rotation_of
from turnscan.process.calibrate.stripe_lines import StripeLine
from turnscan.process.camera import project, undistort_points
from turnscan.schemas.board import Board
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.observations import (
    Observations,
    SeenAt,
    SeenLength,
    SeenSphere,
    SeenStripe,
)

CAMERA = Intrinsics(
    width_px=640,
    height_px=480,
    fx_px=762.2,
    fy_px=762.26,
    cx_px=296.93,
    cy_px=271.51,
    distortion=(-0.20997, 0.1649, 0.0008, -0.00001, 0.0),
)
BASE_MM = 300.0
BOARD = Board(cols=9, rows=6, square_x_mm=30, square_y_mm=30)


def truth(base_mm: float = BASE_MM, crossing_mm: float = 1500.0) -> Calibration:
    """The rig: a laser ``base_mm`` beside the camera, its sheet crossing the axis of view there."""
    theta = float(np.arctan2(crossing_mm, base_mm))
    return Calibration(
        rig="sim",
        camera=CAMERA,
        lasers=(
            LaserPlane(
                laser=0,
                normal=(float(np.sin(theta)), 0.0, float(np.cos(theta))),
                distance_mm=base_mm * float(np.sin(theta)),
            ),
        ),
        turntable=TurntableAxis(
            point_mm=(40.0, 0.0, -20.0),
            direction=(0.0, -1.0, 0.0),
            head="rotates",
            positive_turn="clockwise",
        ),
    )


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is seen, px, and how boards stand."""

    corner_px: float = 0.2
    stripe_px: float = 0.2
    camera_views: int = 20
    plane_views: int = 15
    reach_mm: tuple[float, float] = (500.0, 1500.0)
    plane_reach_mm: tuple[float, float] = (500.0, 1500.0)
    board: Board = BOARD
    tilt_rad: float = 0.6
    stripe_rows: int = 1


class Rig:
    """A simulated rig with one seed: draws views, and makes of them what the commands would save."""

    def __init__(self, seed: int, noise: Noise | None = None, true: Calibration | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        self.noise = noise or Noise()
        self.true = true or truth()

    @property
    def camera(self) -> Intrinsics:
        """The true camera."""
        return self.true.intrinsics_or_fail()

    def _pose(
        self, reach: tuple[float, float], *, at_stripe: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A pose of the board that is whole in the image: rotation, shift, true pixels."""
        points = self.noise.board.object_points_mm()
        middle = points.mean(axis=0)
        camera = self.camera
        for _ in range(10000):
            turn = rotation_of(self.rng.uniform(-1, 1, 3) * self.noise.tilt_rad)
            depth = self.rng.uniform(*reach)
            place = np.array(
                [
                    self.rng.uniform(-0.4, 0.4) * depth * 640 / 762,
                    self.rng.uniform(-0.4, 0.4) * depth * 480 / 762,
                    depth,
                ]
            )
            if at_stripe:
                plane = self.true.lasers[0]
                place[0] = (plane.distance_mm - plane.normal[2] * depth) / plane.normal[0]
                place[0] += self.rng.uniform(-60, 60)
            shift = place - turn @ middle
            u, v = project(points @ turn.T + shift, camera)
            inside = (u > 3) & (v > 3) & (u < camera.width_px - 4) & (v < camera.height_px - 4)
            if inside.all():
                return turn, shift, np.stack([u, v], axis=1)
        raise AssertionError("no board fits into the image")

    def board_views(self) -> list[BoardView]:
        """What `calibrate camera` finds."""
        out = []
        n = self.noise
        points = n.board.object_points_mm()
        for i in range(n.camera_views):
            _, _, px = self._pose(n.reach_mm, at_stripe=False)
            px = px + n.corner_px * self.rng.standard_normal(px.shape)
            out.append(
                BoardView(
                    name=f"camera{i}.png",
                    board=n.board,
                    ids=np.arange(len(points)),
                    points_px=px,
                    points_mm=points,
                    width_px=self.camera.width_px,
                    height_px=self.camera.height_px,
                    square_px=20.0,
                    window_px=5,
                    irregular_px=0.0,
                    blur_px=1.0,
                    detector="simulated",
                )
            )
        return out

    def stripe(
        self,
        facing: np.ndarray,
        offset: float,
        inside: object = None,
        *,
        laser: int = 0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of the stripe on the plane ``facing . X = offset``, a point a row, and its noise."""
        plane = self.true.lasers[laser]
        v = np.arange(4.0, self.camera.height_px - 4.0, self.noise.stripe_rows)
        u = np.full_like(v, self.camera.cx_px)
        q = plane.distance_mm * facing - offset * np.array(plane.normal)
        # The place in a row where the ray meets both planes: Newton with differences.
        for _ in range(40):
            value = self._off(u, v, q)
            slope = (self._off(u + 0.01, v, q) - value) / 0.01
            u = np.clip(u - value / slope, -400.0, 1100.0)
        x, y = undistort_points(u, v, self.camera)
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        depth = offset / (rays @ facing)
        good = np.isfinite(depth) & (depth > 0) & (u > 4) & (u < self.camera.width_px - 5)
        good &= np.abs(self._off(u, v, q)) < 1e-6 * np.abs(q).max()
        if callable(inside):
            good &= inside(rays * depth[:, None])
        u, v = u[good], v[good]
        return u + self.noise.stripe_px * self.rng.standard_normal(len(u)), v

    def _off(self, u: np.ndarray, v: np.ndarray, q: np.ndarray) -> np.ndarray:
        x, y = undistort_points(u, v, self.camera)
        return np.asarray(q[0] * x + q[1] * y + q[2])

    def plane_views(self, believed: Intrinsics) -> list[PlaneView]:
        """What `calibrate plane` finds with the camera that it believes in."""
        out: list[PlaneView] = []
        n = self.noise
        points = n.board.object_points_mm()
        far = points.max(axis=0)
        while len(out) < n.plane_views:
            turn, shift, px = self._pose(n.plane_reach_mm, at_stripe=True)

            def inside(p: np.ndarray, turn: np.ndarray = turn, shift: np.ndarray = shift) -> np.ndarray:
                flat = (p - shift) @ turn
                room = (flat[:, :2] > -20) & (flat[:, :2] < far[:2] + 20)
                return np.asarray(room.all(axis=1))

            u, v = self.stripe(turn[:, 2], float(turn[:, 2] @ shift), inside)
            if len(u) < 20:
                continue
            px = px + n.corner_px * self.rng.standard_normal(px.shape)
            line = StripeLine(
                u,
                v,
                np.full(len(u), n.stripe_px),
                np.stack(undistort_points(u, v, believed), axis=1),
                along_v=False,
                straightness_px=0.1,
                contrast_dn=80.0,
            )
            pose = board_poses(px, points, believed)[0]
            out.append(PlaneView(f"plane{len(out)}.png", pose, px, points, (line,)))
        return out

    def wall(
        self,
        distance_mm: float,
        sd_mm: float,
        *,
        heads_deg: tuple[float, ...] = (-12.0, -6.0, 0.0, 6.0, 12.0),
        tilt: tuple[float, float] = (0.03, -0.05),
        off_mm: float | None = None,
    ) -> Observations:
        """A wall seen from several angles of the head, its distance off by as much as sd_mm says.

        ``distance_mm`` is that at the first angle; ``off_mm`` sets the error instead.
        """
        axis = self.true.axis_or_fail()
        first = np.array([np.sin(tilt[0]), np.sin(tilt[1]), 1.0])
        first /= np.linalg.norm(first)
        origin, direction = np.array(axis.point_mm), np.array(axis.direction)
        seen = []
        for head in heads_deg:
            phi = -axis.turn_sign() * np.deg2rad(head - heads_deg[0])
            facing = rotation_of(phi * direction) @ first
            offset = distance_mm - first @ origin + facing @ origin
            u, v = self.stripe(facing, float(offset))
            stripe = SeenStripe(
                laser=0,
                points_px=tuple(zip(u.tolist(), v.tolist(), strict=True)),
                sigma_px=(self.noise.stripe_px,) * len(u),
            )
            seen.append(SeenAt(angle_rad=float(np.deg2rad(head)), stripe=stripe))
        off = sd_mm * float(self.rng.standard_normal()) if off_mm is None else off_mm
        return wall_of(f"wall {distance_mm:g}", distance_mm + off, sd_mm, seen, size_px=(640, 480))

    def _seen(self, points_mm: np.ndarray, angle_rad: float) -> SeenAt:
        """Points on the laser's plane, in camera space, as stripe points with noise along u."""
        u, v = project(points_mm, self.camera)
        u = u + self.noise.stripe_px * self.rng.standard_normal(len(u))
        stripe = SeenStripe(
            laser=0,
            points_px=tuple(zip(u.tolist(), v.tolist(), strict=True)),
            sigma_px=(self.noise.stripe_px,) * len(u),
        )
        return SeenAt(angle_rad=angle_rad, stripe=stripe)

    def _lit(self, depth_mm: float) -> np.ndarray:
        """The point of the laser's plane at this depth in the height of the axis of view."""
        plane = self.true.lasers[0]
        n = plane.normal
        return np.array([(plane.distance_mm - n[2] * depth_mm) / n[0], 0.0, depth_mm])

    def sphere(self, depth_mm: float, diameter_mm: float, sd_mm: float) -> SeenSphere:
        """A sphere about a lit point, seen at two angles of the head that still hit it."""
        axis, plane = self.true.axis_or_fail(), self.true.lasers[0]
        n, radius = np.array(plane.normal), 0.5 * diameter_mm
        centre = self._lit(depth_mm) + 0.2 * radius * n
        origin, direction = np.array(axis.point_mm), np.array(axis.direction)
        stripes = []
        for angle in (0.0, float(0.3 * radius / depth_mm)):
            back = rotation_of(-axis.turn_sign() * angle * direction)
            c = origin + back @ (centre - origin)
            away = float(n @ c - plane.distance_mm)
            ring = np.sqrt(radius**2 - away**2)
            across = np.cross(n, [0.0, 1.0, 0.0])
            across /= np.linalg.norm(across)
            across = -across if across[2] > 0 else across
            phi = np.linspace(-1.0, 1.0, 80)
            points = (
                c
                - away * n
                + ring * (np.cos(phi)[:, None] * across + np.sin(phi)[:, None] * np.cross(n, across))
            )
            stripes.append(self._seen(points, angle))
        stated = diameter_mm + sd_mm * float(self.rng.standard_normal())
        return SeenSphere(name="sphere", diameter_mm=stated, sd_mm=sd_mm, stripes=tuple(stripes))

    def length(self, depths_mm: tuple[float, float], sd_mm: float) -> SeenLength:
        """The distance of two lit places, the second with the head turned by 4 degrees."""
        axis = self.true.axis_or_fail()
        angle = float(np.deg2rad(4.0))
        ends = [self._lit(d) for d in depths_mm]
        origin = np.array(axis.point_mm)
        turn = rotation_of(axis.turn_sign() * angle * np.array(axis.direction))
        first, second = ends[0], origin + turn @ (ends[1] - origin)
        stated = float(np.linalg.norm(first - second)) + sd_mm * float(self.rng.standard_normal())
        return SeenLength(
            name="length",
            length_mm=stated,
            sd_mm=sd_mm,
            ends=(self._seen(ends[0][None], 0.0), self._seen(ends[1][None], angle)),
        )

    def turning(
        self, frames: int = 12, step_deg: float = 2.5, sd_deg: float = 0.5
    ) -> tuple[Sightings, np.ndarray]:
        """A board that stands in the room, seen from the turning head; and the nominal angles."""
        axis = self.true.axis_or_fail()
        n, camera = self.noise, self.camera
        points = n.board.object_points_mm()
        points = points - points.mean(axis=0)
        direction, origin = np.array(axis.direction), np.array(axis.point_mm)
        nominal = np.deg2rad(step_deg) * np.arange(frames)
        angles = nominal + np.deg2rad(sd_deg) * self.rng.standard_normal(frames)
        parts = []
        body = 0
        for k, angle in enumerate(angles):
            # Boards all around; a head that turned by an angle sees the room turned back.
            for body in range(36):
                around = rotation_of(np.array([0.0, np.deg2rad(10.0 * body), 0.0]))
                own = around @ rotation_of(np.array([0.5, -0.4 + 0.02 * body, 0.1]))
                middle = origin + around @ np.array([0.0, 20.0, 900.0])
                back = rotation_of(-axis.turn_sign() * angle * direction)
                placed = origin + (points @ own.T + middle - origin) @ back.T
                if placed[:, 2].min() < 300:
                    continue
                u, v = project(placed, camera)
                if (u > 3).all() and (v > 3).all() and (u < 636).all() and (v < 476).all():
                    px = np.stack([u, v], axis=1) + n.corner_px * self.rng.standard_normal((len(u), 2))
                    parts.append((k, body, points, px))
        sightings = Sightings(
            frame=np.concatenate([np.full(len(p[3]), p[0]) for p in parts]),
            body=np.concatenate([np.full(len(p[3]), p[1]) for p in parts]),
            points_mm=np.concatenate([p[2] for p in parts]),
            seen_px=np.concatenate([p[3] for p in parts]),
        )
        return sightings, nominal

    def sequential(
        self, *, axis: bool = False, fix: tuple[str, ...] = ("skew",)
    ) -> tuple[Calibration, list[Observations]]:
        """Camera, plane (and axis) one after the other, and what the three commands would save."""
        views = self.board_views()
        estimate = calibrate_camera(views, fix=fix)  # type: ignore[arg-type]
        camera = estimate.intrinsics
        planes = self.plane_views(camera)
        fit = fit_planes(planes, camera)[0]
        base = self.true.model_copy(
            update={"camera": camera, "lasers": (fit.laser_plane(0),), "turntable": None}
        )
        size = (640, 480)
        seen = [
            one_observation(size, boards=boards_of(estimate.views)),
            one_observation(size, boards=stripes_of(planes, [fit], [0])),
        ]
        if axis:
            sightings, nominal = self.turning()
            names = [f"axis{k}.png" for k in range(len(nominal))]
            found = fit_axis(
                sightings, names, nominal, camera, head="rotates", angle_sd_rad=float(np.deg2rad(0.5))
            )
            base = base.model_copy(update={"turntable": found.turntable_axis()})
            seen.append(one_observation(size, turning=turning_of(found, float(np.deg2rad(0.5)))))
        self.fit = fit
        return base, seen
