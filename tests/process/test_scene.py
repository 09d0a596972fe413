"""The compiled pass from stripe points to scene points: what its steps say, wherever a point lies."""

from __future__ import annotations

import math

import numpy as np
import pytest

from turnscan.process.camera import undistort_points
from turnscan.process.stages import PointChain
from turnscan.process.triangulate import (
    intersect,
    range_of,
    scene_from_turntable,
    turntable_from_camera,
)
from turnscan.process.uncertainty import covariance_factor, range_slopes
from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from turnscan.schemas.errors import CalibrationError
from turnscan.schemas.recipe import Extract, Recipe, Triangulate, Undistort

MADE = ("x_mm", "y_mm", "z_mm", "range_mm", "sigma_range_mm")


def spread(sizes: list[float], seed: int) -> tuple[tuple[float, ...], ...]:
    """A full covariance whose standard deviations are about ``sizes``."""
    mixed = np.random.default_rng(seed).normal(0, 1, (len(sizes), len(sizes)))
    mixed *= np.array(sizes)[:, None] / math.sqrt(len(sizes))
    return tuple(map(tuple, (mixed @ mixed.T).tolist()))


def document(*, uncertain: bool = True, k1: float = -0.2) -> Calibration:
    """Two lasers, a lens with skew, a tilted axis."""
    camera = Intrinsics(
        width_px=640,
        height_px=480,
        fx_px=800.0,
        fy_px=790.0,
        cx_px=315.0,
        cy_px=245.0,
        skew=0.001,
        distortion=(k1, 0.05, 0.001, -0.002, 0.01),
        covariance=spread([1, 1, 1, 1, 1e-5, 1e-3, 5e-3, 1e-4, 1e-4, 5e-3], 1) if uncertain else None,
    )
    planes = [
        LaserPlane(
            laser=laser,
            normal=normal,
            distance_mm=distance,
            covariance=spread([1e-3, 1e-3, 1e-3, 0.1], laser) if uncertain else None,
        )
        for laser, normal, distance in ((0, (0.6, 0.0, 0.8), 150.0), (3, (-0.28, 0.0, 0.96), 200.0))
    ]
    axis = TurntableAxis(point_mm=(5.0, 10.0, 400.0), direction=(0.0, -0.8, -0.6), head="fixed")
    return Calibration(rig="two", camera=camera, lasers=tuple(planes), turntable=axis)


def recipe(sigma: str | None = None, orientation: str = "vertical", **limits: float) -> Recipe:
    stages = (
        Extract(orientation=orientation),  # type: ignore[arg-type]
        Undistort(),
        Triangulate(sigma=sigma, **limits),  # type: ignore[arg-type]
    )
    return Recipe(name="t", stages=stages)


def stripes(kind: type, rows: int = 1500, seed: int = 2) -> dict[str, np.ndarray]:
    """Stripe points of both lasers in one order of rows, several frames."""
    rng = np.random.default_rng(seed)
    return {
        "frame": np.sort(rng.integers(0, 4, rows)).astype(np.uint32),
        "laser": rng.choice([0, 3], rows).astype(np.uint8),
        "row": rng.integers(0, 480, rows).astype(np.uint16),
        "angle_rad": np.sort(rng.choice([0.1, 0.7, 2.0, 5.5], rows)).astype(kind),
        "u_px": rng.uniform(20, 620, rows).astype(kind),
        "sigma_u_px": rng.uniform(0.01, 0.3, rows).astype(kind),
        "amplitude_dn": rng.uniform(20, 200, rows).astype(kind),
        "width_px": rng.uniform(1, 4, rows).astype(kind),
        "flags": np.zeros(rows, np.uint16),
    }


def expected(
    columns: dict[str, np.ndarray], c: Calibration, share: str, *, along_v: bool
) -> dict[str, np.ndarray]:
    """The columns by the formulas of the single steps, in NumPy and float64."""
    along, across = columns["u_px"].astype(float), columns["row"].astype(float)
    u, v = (across, along) if along_v else (along, across)
    camera, axis = c.intrinsics_or_fail(), c.axis_or_fail()
    out = {name: np.full(len(u), np.nan) for name in MADE}
    for plane in c.lasers:
        mine = columns["laser"] == plane.laser
        p = intersect(*undistort_points(u[mine], v[mine], camera), plane)
        turned = turntable_from_camera(axis)(p)
        scene = scene_from_turntable(turned, columns["angle_rad"][mine].astype(float), axis)
        by_pixel, slopes = range_slopes(u[mine], v[mine], along_v=along_v, camera=camera, plane=plane)
        random = (by_pixel * columns["sigma_u_px"][mine].astype(float)) ** 2
        systematic = np.square(slopes @ covariance_factor(camera, plane, None)).sum(axis=1)
        total = {"total": random + systematic, "random": random, "systematic": systematic}
        values = (*scene.T, range_of(p), np.sqrt(total[share]))
        for name, value in zip(MADE, values, strict=True):
            out[name][mine] = value
    return out


@pytest.mark.parametrize("share", ["total", "random", "systematic"])
@pytest.mark.parametrize("orientation", ["vertical", "horizontal"])
def test_it_is_what_the_single_steps_give(share: str, orientation: str) -> None:
    c, columns = document(), stripes(np.float64)
    found = PointChain(recipe(share, orientation), c).points(columns)
    wanted = expected(columns, c, share, along_v=orientation == "horizontal")
    seen = np.isfinite(wanted["range_mm"])
    assert seen.sum() > 700
    assert len(found["range_mm"]) == seen.sum()
    size = np.abs(wanted["range_mm"][seen]).max()
    for name in MADE:
        small = 1e-12 * (wanted[name][seen].max() if name == "sigma_range_mm" else size)
        assert np.allclose(found[name], wanted[name][seen], rtol=1e-12, atol=small), name


def test_the_tables_types_hold_the_nearest_values() -> None:
    c, columns = document(), stripes(np.float32)
    found = PointChain(recipe(), c).points(columns)
    wanted = PointChain(recipe(), c).points(
        {n: v.astype(float) if v.dtype == np.float32 else v for n, v in columns.items()}
    )
    for name in MADE:
        assert found[name].dtype == np.float32
        assert np.array_equal(found[name], wanted[name].astype(np.float32)), name


@pytest.mark.parametrize("uncertain", [False, True])
@pytest.mark.parametrize("k1", [-0.2, -0.5])
def test_a_point_does_not_depend_on_its_place_or_its_neighbours(uncertain: bool, k1: float) -> None:
    """With k1 = -0.5 some pixels belong to no ray, or lie near the fold, where more steps are taken."""
    c = document(uncertain=uncertain, k1=k1)
    columns = stripes(np.float32)
    columns["flags"] = np.arange(1500).astype(np.uint16)
    whole = PointChain(recipe(), c).points(columns)
    for some in (slice(1, None), slice(7, 600), slice(511, 514), slice(1499, None)):
        part = PointChain(recipe(), c).points({n: v[some] for n, v in columns.items()})
        same = np.isin(whole["flags"], columns["flags"][some])
        for name in ("flags", *MADE):
            assert part[name].tobytes() == whole[name][same].tobytes(), (some, name)


def test_lasers_apart_are_the_lasers_together() -> None:
    c, columns = document(), stripes(np.float32)
    columns["flags"] = np.arange(1500).astype(np.uint16)
    whole = PointChain(recipe(), c).points(columns)
    for laser in (0, 3):
        mine = columns["laser"] == laser
        part = PointChain(recipe(), c).points({n: v[mine] for n, v in columns.items()})
        for name in ("flags", *MADE):
            assert np.array_equal(part[name], whole[name][whole["laser"] == laser]), (laser, name)


def test_limits_leave_out_what_lies_beyond_them() -> None:
    c, columns = document(), stripes(np.float64)
    free = PointChain(recipe(), c)
    every = free.points(columns)
    radius = np.hypot(every["x_mm"], every["y_mm"])
    chain = PointChain(recipe(min_range_mm=220.0, max_range_mm=600.0, max_radius_mm=300.0), c)
    found = chain.points(columns)
    inside = (every["range_mm"] >= 220) & (every["range_mm"] <= 600) & (radius <= 300)
    assert 0 < inside.sum() < len(radius)
    assert np.array_equal(found["x_mm"], every["x_mm"][inside])
    assert chain.dropped == free.dropped + (~inside).sum()


def test_a_laser_without_a_plane_is_told_by_its_number() -> None:
    columns = stripes(np.float32)
    columns["laser"][77] = 2
    with pytest.raises(CalibrationError, match="no plane of laser 2"):
        PointChain(recipe(), document()).points(columns)
    none = document().model_copy(update={"lasers": ()})
    with pytest.raises(CalibrationError, match="no plane of laser 0"):
        PointChain(recipe(), none).points(columns)


def test_no_points_give_no_points() -> None:
    chain = PointChain(recipe(), document())
    assert len(chain.points(stripes(np.float32, 0))["x_mm"]) == 0
    assert chain.dropped == 0
