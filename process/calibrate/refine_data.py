"""The observations of a joint adjustment as arrays: corners, stripes, turning bodies, references."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Calibration
from ...schemas.errors import CalibrationError, InputError
from ...schemas.observations import (
    Observations,
    SeenAt,
    SeenBoard,
    SeenStripe,
    SeenTurning,
)

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Corners:
    """Points of flat boards, one a row: the board, the place on it, the pixel."""

    board: Ints
    points_mm: Floats
    seen_px: Floats


@dataclass(frozen=True)
class Lit:
    """Stripe points, one a row: what they lie on (by number), laser (by place in the calibration).

    ``phi_rad`` is how far what they lie on seems to have turned about the axis, right-handed.
    """

    on: Ints
    laser: Ints
    phi_rad: Floats
    u_px: Floats
    v_px: Floats
    sigma_px: Floats
    along_v: Bools


@dataclass(frozen=True)
class Turned:
    """Points of bodies that turn, one a row, and what is known of the angles and of their size.

    ``nominal_rad`` are signed as phi is: right-handed about the axis, as seen from the camera.
    """

    frame: Ints
    body: Ints
    points_mm: Floats
    seen_px: Floats
    nominal_rad: Floats
    sd_rad: float
    size_sd: float


@dataclass(frozen=True)
class Known:
    """Stated values of the references of one kind, and their sds."""

    names: tuple[str, ...]
    value_mm: Floats
    sd_mm: Floats


@dataclass(frozen=True)
class Data:
    """Everything that was seen. ``ends`` has two rows a length, ``on`` is the length's number.

    Of every point of ``stripes``: the stripe's own number in ``stripe``, and in ``along`` where on it
    the point is, from -1 to 1. ``board_of_stripe`` (Q,) is the board under each stripe.
    """

    width_px: int
    height_px: int
    board_names: tuple[str, ...]
    corners: Corners
    stripes: Lit
    stripe: Ints
    along: Floats
    board_of_stripe: Ints
    turned: Turned | None
    wall_points: Lit
    walls: Known
    sphere_points: Lit
    spheres: Known
    ends: Lit
    lengths: Known


def joined(several: Sequence[Observations]) -> Observations:
    """All observations as one; a board that stands in two files with equal pixels counts once.

    Raises
    ------
    InputError
        They are of different image sizes, hold two turnings, or name two references alike.
    """
    if not several:
        raise InputError(
            "no observations were given", hint="calibrate camera ... --observations F.json"
        )
    sizes = {(o.width_px, o.height_px) for o in several}
    if len(sizes) > 1:
        shown = ", ".join(f"{w} x {h} px" for w, h in sorted(sizes))
        raise InputError(
            f"the observations are of different image sizes: {shown}",
            hint="one camera at one resolution is adjusted at a time",
        )
    turnings = [o.turning for o in several if o.turning is not None]
    if len(turnings) > 1:
        raise InputError(
            f"{len(turnings)} files hold a turning table", hint="give the observations of one axis only"
        )
    boards: dict[tuple[object, ...], SeenBoard] = {}
    for seen in (b for o in several for b in o.boards):
        # The frames of two commands may be the same ones.
        key = (seen.points_px, seen.points_mm)
        old = boards.setdefault(key, seen)
        stripes = old.stripes + tuple(s for s in seen.stripes if s not in old.stripes)
        boards[key] = old.model_copy(update={"stripes": stripes})
    first = several[0]
    out = Observations(
        width_px=first.width_px,
        height_px=first.height_px,
        boards=tuple(boards.values()),
        turning=turnings[0] if turnings else None,
        walls=tuple(w for o in several for w in o.walls),
        spheres=tuple(s for o in several for s in o.spheres),
        lengths=tuple(x for o in several for x in o.lengths),
        inputs=tuple(dict.fromkeys(i for o in several for i in o.inputs)),
    )
    names = [w.name for w in out.walls]
    names += [b.name for b in out.spheres]
    names += [x.name for x in out.lengths]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(f"two references are called {twice[0]!r}", hint="give each a name of its own")
    return out


def check_references(seen: Observations) -> None:
    """Refuse references that say nothing.

    Raises
    ------
    InputError
        A wall or sphere holds too few stripe points, or a wall is seen in a single stripe.
    """
    for kind, least, these in (("wall", 3, seen.walls), ("sphere", 4, seen.spheres)):
        for one in these:
            points = sum(len(s.stripe.points_px) for s in one.stripes)
            if points < least:
                raise InputError(
                    f"{one.name} holds {points} stripe points, a {kind} needs {least}",
                    hint="give the stripe over all rows that show it",
                )
    for wall in seen.walls:
        if len({(s.angle_rad, s.stripe.laser) for s in wall.stripes}) < 2:
            raise InputError(
                f"{wall.name} is seen in one stripe only: the wall could turn about it, and its "
                "distance says nothing",
                hint="turn the head (or light another laser) and take the wall at two angles or more",
            )


def data_of(seen: Observations, start: Calibration) -> Data:
    """The observations as arrays, for the lasers and the axis of ``start``.

    Raises
    ------
    CalibrationError
        ``start`` is for another image size, or lacks a laser or the axis that an observation needs.
    """
    camera = start.intrinsics_or_fail()
    if (camera.width_px, camera.height_px) != (seen.width_px, seen.height_px):
        raise CalibrationError(
            f"the observations are of {seen.width_px} x {seen.height_px} px, the calibration is for "
            f"{camera.width_px} x {camera.height_px} px",
            hint="use the calibration of this camera at this resolution",
        )
    lasers = {p.laser: i for i, p in enumerate(start.lasers)}
    sign = -start.turntable.turn_sign() if start.turntable is not None else 0

    def lit(items: Iterable[tuple[int, SeenStripe, float]]) -> Lit:
        rows = list(items)
        for _, stripe, phi in rows:
            if stripe.laser not in lasers:
                start.plane_or_fail(stripe.laser)
            if phi and not sign:
                start.axis_or_fail()
        counts = [len(s.points_px) for _, s, _ in rows]
        pixels = [np.array(s.points_px, np.float64) for _, s, _ in rows]
        px = np.concatenate(pixels) if rows else np.zeros((0, 2))
        return Lit(
            on=np.repeat(np.array([on for on, _, _ in rows], np.int64), counts),
            laser=np.repeat(np.array([lasers[s.laser] for _, s, _ in rows], np.int64), counts),
            phi_rad=np.repeat(np.array([sign * phi for _, _, phi in rows], np.float64), counts),
            u_px=px[:, 0],
            v_px=px[:, 1],
            sigma_px=np.array([x for _, s, _ in rows for x in s.sigma_px], np.float64),
            along_v=np.repeat(np.array([s.along_v for _, s, _ in rows], np.bool_), counts),
        )

    counts = [len(b.points_px) for b in seen.boards]
    empty = np.zeros((0, 3))
    corners = Corners(
        board=np.repeat(np.arange(len(seen.boards)), counts),
        points_mm=np.concatenate([empty, *(np.array(b.points_mm) for b in seen.boards)]),
        seen_px=np.concatenate([empty[:, :2], *(np.array(b.points_px) for b in seen.boards)]),
    )
    each = [(i, s) for i, b in enumerate(seen.boards) for s in b.stripes]
    return Data(
        width_px=seen.width_px,
        height_px=seen.height_px,
        board_names=tuple(b.name for b in seen.boards),
        corners=corners,
        stripes=lit((i, s, 0.0) for i, s in each),
        stripe=np.repeat(np.arange(len(each)), [len(s.points_px) for _, s in each]),
        along=np.concatenate([np.zeros(0), *(_along(s) for _, s in each)]),
        board_of_stripe=np.array([i for i, _ in each], np.int64),
        turned=None if seen.turning is None else _turned(seen.turning, sign, start),
        wall_points=lit(
            (i, s.stripe, s.angle_rad - w.stripes[0].angle_rad)
            for i, w in enumerate(seen.walls)
            for s in w.stripes
        ),
        walls=Known(
            tuple(w.name for w in seen.walls),
            np.array([w.distance_mm for w in seen.walls]),
            np.array([w.sd_mm for w in seen.walls]),
        ),
        sphere_points=lit(
            (i, s.stripe, s.angle_rad) for i, b in enumerate(seen.spheres) for s in b.stripes
        ),
        spheres=Known(
            tuple(b.name for b in seen.spheres),
            np.array([b.diameter_mm for b in seen.spheres]),
            np.array([b.sd_mm for b in seen.spheres]),
        ),
        ends=lit((i, *_mean(e)) for i, x in enumerate(seen.lengths) for e in x.ends),
        lengths=Known(
            tuple(x.name for x in seen.lengths),
            np.array([x.length_mm for x in seen.lengths]),
            np.array([x.sd_mm for x in seen.lengths]),
        ),
    )


def _along(s: SeenStripe) -> Floats:
    """Place of the points along their stripe, -1 and 1 at its ends."""
    rows = np.array([p[0] if s.along_v else p[1] for p in s.points_px], np.float64)
    half = 0.5 * float(np.ptp(rows))
    return (rows - rows.min() - half) / max(half, 1e-9)


def _mean(end: SeenAt) -> tuple[SeenStripe, float]:
    """The middle of a short piece of stripe, as one point."""
    s = end.stripe
    u, v = (float(m) for m in np.mean(np.array(s.points_px), axis=0))
    sigma = float(np.sqrt(np.square(s.sigma_px).sum())) / len(s.sigma_px)
    one = SeenStripe(laser=s.laser, points_px=((u, v),), sigma_px=(sigma,), along_v=s.along_v)
    return one, end.angle_rad


def _turned(seen: SeenTurning, sign: int, start: Calibration) -> Turned:
    axis = start.axis_or_fail()
    if axis.head != seen.head:
        raise CalibrationError(
            f"the axis' observations are of a head that is {seen.head!r}, the calibration says "
            f"{axis.head!r}",
            hint="give the calibration that calibrate axis made from these observations",
        )
    frames = sorted({s.frame for s in seen.sightings})
    bodies = sorted({s.body for s in seen.sightings})
    counts = [len(s.points_px) for s in seen.sightings]
    nominal = np.array([seen.angles_rad[f] for f in frames])
    return Turned(
        frame=np.repeat([frames.index(s.frame) for s in seen.sightings], counts),
        body=np.repeat([bodies.index(s.body) for s in seen.sightings], counts),
        points_mm=np.concatenate([np.array(s.points_mm) for s in seen.sightings]),
        seen_px=np.concatenate([np.array(s.points_px) for s in seen.sightings]),
        nominal_rad=sign * nominal,
        sd_rad=seen.angle_sd_rad,
        size_sd=seen.size_sd,
    )
