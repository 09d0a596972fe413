"""Where one laser's line crosses the middle of each row: exact, with shadows of laser and camera.

The fan of light is cast ray by ray; between two neighbours on one surface the fan angle at which the
picture of the line crosses the middle of a row is solved for, so that truth has no sampling error.
Between two neighbours on different surfaces the edge is found by halving, so that lines end where
surfaces end. For a horizontal stripe read column for row.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from .compiling import compiled
from .rays import Floats, Packed, first_hit, normal_at
from .rig import Fan, Pose, SimulatedRig, project
from .scene import Scene

#: Rays of the fan for each row: finer than the smallest thing that fills a row.
_RAYS_PER_ROW: Final = 2
#: What is nearer than this to the camera is not seen.
_NEAR_MM = 1.0
#: Halvings of the angle between two rays; four edges between two rays are found, not more.
_HALVINGS, _EDGES = 36, 4
#: Neighbours on one mesh are one surface unless their distance from the laser jumps by this part.
_JUMP = 0.02
_ITERATIONS = 60
#: Rows that are not met this well are not met at all: the line jumps there.
_EXACT_PX = 1e-9
_SOLVED_PX = 1e-11

# Columns of what the solver lists.
ROW, U, X, Y, Z, RANGE, REACH, COSINE, SHAPE, SLOPE, DEPTH = range(11)
COLUMNS: Final = 11


@compiled
def _shine(
    packed: Packed, lens: Floats, frame: Floats, fan: Floats, angle: float
) -> tuple[float, int, int, float, float]:
    """The ray at a fan angle: (distance, what, face, w, u); what is -1 where nothing is seen.

    w is the coordinate that rows count, u the one along them. ``frame`` is scene_from_camera by rows,
    the camera's place, the limit of the view, 1.0 for a horizontal stripe; ``fan`` is the emitter, the
    middle and the side of the fan, all in scene space.
    """
    c, s = math.cos(angle), math.sin(angle)
    dx, dy, dz = c * fan[3] + s * fan[6], c * fan[4] + s * fan[7], c * fan[5] + s * fan[8]
    t, what, face = first_hit(packed, fan[0], fan[1], fan[2], dx, dy, dz)
    if what < 0:
        return t, -1, 0, 0.0, 0.0
    px, py, pz = fan[0] + t * dx - frame[9], fan[1] + t * dy - frame[10], fan[2] + t * dz - frame[11]
    x = frame[0] * px + frame[3] * py + frame[6] * pz
    y = frame[1] * px + frame[4] * py + frame[7] * pz
    z = frame[2] * px + frame[5] * py + frame[8] * pz
    if z < _NEAR_MM or x * x + y * y > frame[12] * frame[12] * z * z:
        return t, -1, 0, 0.0, 0.0
    u, v = project(lens, x, y, z)
    if frame[13] > 0.0:
        return t, what, face, u, v
    return t, what, face, v, u


@compiled
def _joined(
    packed: Packed, t0: float, what0: int, face0: int, t1: float, what1: int, face1: int
) -> bool:
    """Whether two hits are on one unbroken surface."""
    if what0 < 0 or what1 < 0:
        return what0 < 0 and what1 < 0
    if what0 == what1:
        return face0 == face1
    shapes = len(packed.kind)
    if what0 < shapes or what1 < shapes:
        return False
    one_mesh = packed.owner[what0 - shapes] == packed.owner[what1 - shapes]
    return one_mesh and abs(t1 - t0) < _JUMP * min(t0, t1)


@compiled
def _rows_between(
    packed: Packed,
    lens: Floats,
    frame: Floats,
    fan: Floats,
    rows: int,
    a0: float,
    w0: float,
    a1: float,
    w1: float,
    out: Floats,
    count: int,
) -> int:
    """List the angles between two angles at which the line meets rows: row and angle, (N, 2)."""
    # Half open: a ray that meets the middle of a row exactly belongs to one of its two neighbours.
    first = max(math.floor(min(w0, w1)) + 1, 0)
    last = min(math.floor(max(w0, w1)), rows - 1)
    for row in range(first, last + 1):
        # Regula falsi; an end that stays has its error halved, so that it cannot stay long (Illinois:
        # Dowell and Jarratt, BIT 11, 1971).
        low, high, e_low, e_high = a0, a1, w0 - row, w1 - row
        angle, error = high, e_high
        for _ in range(_ITERATIONS):
            if abs(error) < _SOLVED_PX or e_high == e_low:
                break
            angle = high - e_high * (high - low) / (e_high - e_low)
            _, what, _, w, _ = _shine(packed, lens, frame, fan, angle)
            if what < 0:
                error = math.inf
                break
            error = w - row
            if (error < 0.0) != (e_high < 0.0):
                low, e_low = high, e_high
            else:
                e_low *= 0.5
            high, e_high = angle, error
        if abs(error) < _EXACT_PX and count < len(out):
            out[count, 0], out[count, 1] = row, angle
            count += 1
    return count


@compiled
def _crossings(
    packed: Packed, lens: Floats, frame: Floats, fan: Floats, rows: int, angles: Floats, out: Floats
) -> int:
    """Every crossing of the lit line with the middle of a row, seen or not; the number of them."""
    count = 0
    t0, what0, face0, w0, _ = _shine(packed, lens, frame, fan, angles[0])
    for i in range(1, len(angles)):
        a0, a1 = angles[i - 1], angles[i]
        t1, what1, face1, w1, _ = _shine(packed, lens, frame, fan, a1)
        for _ in range(_EDGES):
            if _joined(packed, t0, what0, face0, t1, what1, face1):
                break
            # The edge of the left surface lies between low (still on it) and high (off it).
            low, t_low, what_low, face_low, w_low = a0, t0, what0, face0, w0
            high, t_high, what_high, face_high, w_high = a1, t1, what1, face1, w1
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                t, what, face, w, _ = _shine(packed, lens, frame, fan, middle)
                if _joined(packed, t_low, what_low, face_low, t, what, face):
                    low, t_low, what_low, face_low, w_low = middle, t, what, face, w
                else:
                    high, t_high, what_high, face_high, w_high = middle, t, what, face, w
            if what0 >= 0:
                count = _rows_between(packed, lens, frame, fan, rows, a0, w0, low, w_low, out, count)
            a0, t0, what0, face0, w0 = high, t_high, what_high, face_high, w_high
        if what0 >= 0 and what1 >= 0 and _joined(packed, t0, what0, face0, t1, what1, face1):
            count = _rows_between(packed, lens, frame, fan, rows, a0, w0, a1, w1, out, count)
        t0, what0, face0, w0 = t1, what1, face1, w1
    return count


@compiled
def _solve(
    packed: Packed,
    lens: Floats,
    frame: Floats,
    fan: Floats,
    sheet: Floats,
    rows: int,
    across: int,
    angles: Floats,
    out: Floats,
) -> int:
    """Fill ``out`` (N, COLUMNS) with the crossings that the camera sees; the number of them."""
    found = np.empty((len(out), 2))
    crossings = _crossings(packed, lens, frame, fan, rows, angles, found)
    cx, cy, cz = frame[9], frame[10], frame[11]
    count = 0
    for n in range(crossings):
        angle = found[n, 1]
        t, what, face, w, u = _shine(packed, lens, frame, fan, angle)
        if what < 0 or abs(w - found[n, 0]) >= _EXACT_PX or u <= -0.5 or u >= across - 0.5:
            continue
        c, s = math.cos(angle), math.sin(angle)
        bx, by, bz = c * fan[3] + s * fan[6], c * fan[4] + s * fan[7], c * fan[5] + s * fan[8]
        px, py, pz = fan[0] + t * bx, fan[1] + t * by, fan[2] + t * bz
        vx, vy, vz = px - cx, py - cy, pz - cz
        distance = math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / distance, vy / distance, vz / distance
        nx, ny, nz = normal_at(packed, what, face, px, py, pz)
        lit = nx * bx + ny * by + nz * bz
        # A thin sheet is lit on one side only.
        if lit * (nx * vx + ny * vy + nz * vz) <= 0.0:
            continue
        nearest, _, _ = first_hit(packed, cx, cy, cz, vx, vy, vz)
        if nearest < distance * (1.0 - 1e-9) - 1e-6:
            continue
        # Along the line on the surface: how far u goes while w goes by a row.
        ex, ey, ez = (
            sheet[1] * nz - sheet[2] * ny,
            sheet[2] * nx - sheet[0] * nz,
            sheet[0] * ny - sheet[1] * nx,
        )
        step = 1e-4 * distance
        du, dw = 0.0, 0.0
        for sign in (-1.0, 1.0):
            qx = px + sign * step * ex - cx
            qy = py + sign * step * ey - cy
            qz = pz + sign * step * ez - cz
            pu, pv = project(
                lens,
                frame[0] * qx + frame[3] * qy + frame[6] * qz,
                frame[1] * qx + frame[4] * qy + frame[7] * qz,
                frame[2] * qx + frame[5] * qy + frame[8] * qz,
            )
            du += sign * (pv if frame[13] > 0.0 else pu)
            dw += sign * (pu if frame[13] > 0.0 else pv)
        shapes = len(packed.kind)
        out[count, ROW], out[count, U] = found[n, 0], u
        out[count, X], out[count, Y], out[count, Z] = px, py, pz
        out[count, RANGE], out[count, REACH], out[count, COSINE] = distance, t, abs(lit)
        out[count, SHAPE] = packed.name[what] if what < shapes else packed.owner[what - shapes]
        out[count, SLOPE] = du / dw
        out[count, DEPTH] = distance * (vx * frame[2] + vy * frame[5] + vz * frame[8])
        count += 1
    return count


def trace(scene: Scene, rig: SimulatedRig, fan: Fan, pose: Pose) -> Floats:
    """The lit points that the camera sees, (N, COLUMNS), sorted by row and u; see the column names."""
    horizontal = fan.stripe == "horizontal"
    size = (rig.camera.height_px, rig.camera.width_px)
    across, rows = size if horizontal else size[::-1]
    if fan.last_rad <= fan.first_rad:
        return np.empty((0, COLUMNS))
    frame = np.array(
        [*pose.scene_from_camera.ravel(), *pose.camera_mm, rig.view_radius, float(horizontal)]
    )
    towards = np.array([fan.middle, fan.side]) @ pose.scene_from_camera.T
    beam = np.concatenate([pose.to_scene(fan.emitter_mm[None])[0], *towards])
    sheet = np.cross(towards[0], towards[1])
    angles = np.linspace(fan.first_rad, fan.last_rad, _RAYS_PER_ROW * rows + 1)
    out = np.empty((8 * rows, COLUMNS))
    count = _solve(scene.packed, rig.lens, frame, beam, sheet, rows, across, angles, out)
    found = out[:count]
    return found[np.lexsort((found[:, U], found[:, ROW]))]
