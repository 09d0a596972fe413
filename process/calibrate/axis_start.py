"""A first axis from single poses: two frames of one body make a screw, and the others vote on it.

Small markers have two poses that explain them nearly as well; so every pair of a body's poses is a
hypothesis only, and what counts is how well it predicts the pixels of the other frames.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ...schemas.errors import CalibrationError, InputError
from ..camera import project
from .axis_adjust import Sightings, Turning, adjust
from .pose import BoardPose, board_poses, rotation_of

Floats = npt.NDArray[np.float64]

_TRIALS = 80
_TRIED = 3
_LEAST_TURN_RAD = np.deg2rad(4.0)
_SCORED_FRAMES = 16

Poses = dict[tuple[int, int], list[BoardPose]]


def first_turning(
    sightings: Sightings, camera: Intrinsics, *, frames: int, bodies: int, seed: int
) -> Turning:
    """An axis, poses and angles near enough to adjust from; phi of frame 0 is 0.

    Raises
    ------
    CalibrationError
        Nothing was seen in two frames that it turned between.
    """
    poses = _all_poses(sightings, camera)
    rng = np.random.default_rng(seed)
    counts = [sum(1 for (_, m) in poses if m == body) for body in range(bodies)]
    found: list[tuple[float, Turning, int]] = []
    for body in np.argsort(counts)[::-1][:2]:
        if counts[body] >= 2:
            found += _hypotheses(int(body), poses, sightings, camera, rng)
    if not found:
        raise CalibrationError(
            "nothing that was seen in two frames turned between them by 4 degrees or more",
            hint="turn the table between the frames, and keep markers or board in view",
        )
    found.sort(key=lambda f: f[0])
    best: tuple[float, Turning] | None = None
    for _, rough, body in found[:_TRIED]:
        whole = _whole(rough, body, poses, sightings, camera, frames=frames, bodies=bodies)
        if whole is None:
            continue
        fitted = adjust(whole, sightings, camera, None, steps=15)
        size = float(np.median(np.linalg.norm(fitted.residual_px, axis=1)))
        if best is None or size < best[0]:
            best = (size, fitted.turning)
    if best is None:
        raise CalibrationError(
            "no single axis explains what was seen",
            hint="nothing but the table (or the head) may move between the frames",
        )
    return best[1]


def _all_poses(s: Sightings, camera: Intrinsics) -> Poses:
    out: Poses = {}
    for frame, body in sorted(set(zip(s.frame.tolist(), s.body.tolist(), strict=True))):
        mine = (s.frame == frame) & (s.body == body)
        try:
            out[frame, body] = board_poses(s.seen_px[mine], s.points_mm[mine], camera)
        except InputError:
            continue
    return out


def _pixels(points_mm: Floats, camera: Intrinsics) -> Floats:
    return np.stack(project(points_mm, camera), axis=1)


def _turn_about(direction: Floats, relative: Floats) -> float:
    """The angle about ``direction`` that comes nearest to a rotation (in Frobenius' norm)."""
    twist = np.array(
        [
            relative[2, 1] - relative[1, 2],
            relative[0, 2] - relative[2, 0],
            relative[1, 0] - relative[0, 1],
        ]
    )
    return float(np.arctan2(direction @ twist, np.trace(relative) - direction @ relative @ direction))


def _hypotheses(
    body: int, poses: Poses, sightings: Sightings, camera: Intrinsics, rng: np.random.Generator
) -> list[tuple[float, Turning, int]]:
    """Axes from pairs of frames of one body, each with its score: the median miss in px."""
    seen = [f for (f, m) in poses if m == body]
    mine = sightings.select((sightings.body == body) & np.isin(sightings.frame, seen))
    scored = np.array(seen)[np.unique(np.linspace(0, len(seen) - 1, _SCORED_FRAMES).astype(int))]
    sample = mine.select(np.isin(mine.frame, scored))
    middle = mine.points_mm.mean(axis=0)
    out: list[tuple[float, Turning, int]] = []
    for _ in range(_TRIALS):
        a, b = rng.choice(len(seen), 2, replace=False)
        one = poses[seen[a], body][rng.integers(len(poses[seen[a], body]))]
        two = poses[seen[b], body][rng.integers(len(poses[seen[b], body]))]
        relative = two.rotation @ one.rotation.T
        vector = np.asarray(cv2.Rodrigues(relative)[0], np.float64).ravel()
        angle = float(np.linalg.norm(vector))
        if angle < _LEAST_TURN_RAD or angle > np.pi - 1e-3:
            continue
        direction = vector / angle
        start, end = one.to_camera(middle[None])[0], two.to_camera(middle[None])[0]
        # The motion along the axis is noise; across it, (I - R) a = end - R start.
        shift = end - relative @ start
        shift = shift - direction * (direction @ shift)
        point = np.linalg.pinv(np.eye(3) - relative, rcond=1e-6) @ shift
        phi = {}
        for frame in scored:
            angles = [_turn_about(direction, p.rotation @ one.rotation.T) for p in poses[frame, body]]
            phi[frame] = angles
        score = _score(point, direction, one, phi, sample, camera)
        state = Turning(point, direction, one.rotation[None], one.translation_mm[None], np.zeros(1))
        out.append((score, state, body))
    out.sort(key=lambda o: o[0])
    return out[:_TRIED]


def _score(
    point: Floats,
    direction: Floats,
    base: BoardPose,
    phi: dict[int, list[float]],
    sample: Sightings,
    camera: Intrinsics,
) -> float:
    misses = []
    for frame, angles in phi.items():
        mine = sample.frame == frame
        placed = base.to_camera(sample.points_mm[mine]) - point
        best = np.inf
        for angle in angles:
            turned = placed @ rotation_of(direction * angle).T + point
            seen = _pixels(turned, camera)
            miss = float(np.sqrt(np.mean((seen - sample.seen_px[mine]) ** 2)))
            best = min(best, miss) if np.isfinite(miss) else best
        misses.append(best)
    return float(np.median(misses))


def _whole(
    rough: Turning,
    body: int,
    poses: Poses,
    sightings: Sightings,
    camera: Intrinsics,
    *,
    frames: int,
    bodies: int,
) -> Turning | None:
    """Angles for every frame and poses for every body, starting from one body's axis."""
    base = rough.rotations[0]
    phi = np.full(frames, np.nan)
    shown = dict(rough.__dict__)
    for (frame, m), options in poses.items():
        if m == body:
            phi[frame] = _least(
                [(p, _turn_about(rough.direction, p.rotation @ base.T)) for p in options],
                rough, frame, body, sightings, camera,
            )  # fmt: skip
    rotations = np.tile(np.eye(3), (bodies, 1, 1))
    translations = np.zeros((bodies, 3))
    known = {body}
    rotations[body], translations[body] = base, rough.translations_mm[0]
    while len(known) < bodies:
        fresh = [
            m
            for m in range(bodies)
            if m not in known and any(k == m and np.isfinite(phi[f]) for f, k in poses)
        ]
        if not fresh:
            return None
        m = fresh[0]
        pose = _best_base(m, poses, phi, rough, sightings, camera)
        if pose is None:
            return None
        rotations[m], translations[m] = pose
        known.add(m)
        for (frame, k), options in poses.items():
            if k == m and not np.isfinite(phi[frame]):
                phi[frame] = _turn_about(rough.direction, options[0].rotation @ rotations[m].T)
    if not np.isfinite(phi).all():
        return None
    # Frame 0 defines phi = 0: the bodies are turned to where they stand in it.
    back = rotation_of(rough.direction * phi[0])
    shown["rotations"] = back @ rotations
    shown["translations_mm"] = (translations - rough.point_mm) @ back.T + rough.point_mm
    shown["phi_rad"] = phi - phi[0]
    return Turning(**shown)


def _least(
    options: list[tuple[BoardPose, float]],
    rough: Turning,
    frame: int,
    body: int,
    sightings: Sightings,
    camera: Intrinsics,
) -> float:
    """The angle, of those that the poses of a sighting offer, that predicts its pixels best."""
    mine = (sightings.frame == frame) & (sightings.body == body)
    start = sightings.points_mm[mine] @ rough.rotations[0].T + rough.translations_mm[0] - rough.point_mm
    misses = []
    for _, angle in options:
        seen = _pixels(start @ rotation_of(rough.direction * angle).T + rough.point_mm, camera)
        miss = float(np.mean((seen - sightings.seen_px[mine]) ** 2))
        misses.append(miss if np.isfinite(miss) else np.inf)
    return options[int(np.argmin(misses))][1]


def _best_base(
    body: int, poses: Poses, phi: Floats, rough: Turning, sightings: Sightings, camera: Intrinsics
) -> tuple[Floats, Floats] | None:
    """The pose at phi = 0, turned back from one of the body's sightings, that fits all of them best."""
    seen = [f for (f, m) in poses if m == body and np.isfinite(phi[f])]
    best: tuple[float, Floats, Floats] | None = None
    for frame in seen[:: max(1, len(seen) // 12)]:
        back = rotation_of(-rough.direction * phi[frame])
        for pose in poses[frame, body]:
            rotation = back @ pose.rotation
            translation = back @ (pose.translation_mm - rough.point_mm) + rough.point_mm
            misses = []
            for other in seen[:: max(1, len(seen) // 24)]:
                mine = (sightings.frame == other) & (sightings.body == body)
                turn = rotation_of(rough.direction * phi[other])
                placed = sightings.points_mm[mine] @ rotation.T + translation - rough.point_mm
                where = _pixels(placed @ turn.T + rough.point_mm, camera)
                miss = float(np.sqrt(np.mean((where - sightings.seen_px[mine]) ** 2)))
                misses.append(miss if np.isfinite(miss) else 1e9)
            score = float(np.median(misses))
            if best is None or score < best[0]:
                best = (score, rotation, translation)
    return None if best is None else (best[1], best[2])
