"""sigma_range_mm: its shares, the joint covariance, and how often the truth is inside one sigma."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from simulated_rig import Noise, Rig

from turnscan.process.calibrate.difference import stripe_pixels
from turnscan.process.calibrate.refine import refine
from turnscan.process.camera import project, undistort_points
from turnscan.process.stages import PointChain
from turnscan.process.triangulate import intersect, range_of
from turnscan.process.uncertainty import covariance_factor, range_slopes, sigma_range_mm
from turnscan.schemas.calibration import Calibration, Joint, LaserPlane
from turnscan.schemas.errors import DocumentError
from turnscan.schemas.key import points_key
from turnscan.schemas.recipe import Extract, Recipe, Triangulate, Undistort, parse_recipe

NOISE_PX = 0.15


@cache
def document() -> Calibration:
    """A joint calibration of the simulated rig; a wall holds the far range."""
    rig = Rig(5, Noise(corner_px=0.1, stripe_px=0.1, stripe_rows=6, camera_views=10, plane_views=8))
    base, seen = rig.sequential()
    base = base.model_copy(update={"turntable": rig.true.turntable})
    return refine([*seen, rig.wall(4000.0, 2.0)], base).calibration()


def ranges(c: Calibration, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    x, y = undistort_points(u, v, c.intrinsics_or_fail())
    return range_of(intersect(x, y, c.plane_or_fail(0)))


def moved(c: Calibration, by: np.ndarray) -> Calibration:
    """The calibration with its 14 numbers (intrinsics, plane) changed."""
    camera, plane = c.intrinsics_or_fail(), c.plane_or_fail(0)
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "skew")
    changed = {n: getattr(camera, n) + float(d) for n, d in zip(names, by, strict=False)}
    lens = tuple(float(a + b) for a, b in zip(camera.distortion, by[5:10], strict=True))
    n = np.array(plane.normal) + by[10:13]
    # Beside the unit sphere n . X = h is another plane; both are scaled together.
    size = float(np.linalg.norm(n))
    other = LaserPlane(
        laser=0, normal=tuple(n / size), distance_mm=(plane.distance_mm + float(by[13])) / size
    )
    return c.model_copy(
        update={
            "camera": camera.model_copy(update={**changed, "distortion": lens}),
            "lasers": (other,),
            "joint": None,
        }
    )


def test_truth_is_inside_one_sigma_in_two_cases_of_three() -> None:
    """True rigs drawn from the stated covariance, each seen once: 64 to 72 % of true errors."""
    c = document()
    factor = covariance_factor(c.intrinsics_or_fail(), c.plane_or_fail(0), c.joint)
    rng = np.random.default_rng(11)
    inside: dict[float, list[bool]] = {}
    for _ in range(1500):
        true = moved(c, factor @ rng.standard_normal(factor.shape[1]))
        for at in (700.0, 1500.0, 4000.0, 7000.0):
            plane = true.lasers[0]
            depth = at
            x = (plane.distance_mm - plane.normal[2] * depth) / plane.normal[0]
            point = np.array([[x, rng.uniform(-0.15, 0.15) * depth, depth]])
            point[0, 0] -= plane.normal[1] * point[0, 1] / plane.normal[0]
            u, v = project(point, true.intrinsics_or_fail())
            seen = u + NOISE_PX * rng.standard_normal(1)
            off = ranges(c, seen, v) - range_of(point)
            sigma = sigma_range_mm(
                seen,
                v,
                np.full(1, NOISE_PX),
                along_v=False,
                camera=c.intrinsics_or_fail(),
                plane=c.plane_or_fail(0),
                joint=c.joint,
            )
            inside.setdefault(at, []).append(bool(abs(off[0]) <= sigma[0]))
    for at, cases in inside.items():
        assert 0.64 <= np.mean(cases) <= 0.72, at
    assert 0.66 <= np.mean([np.mean(cases) for cases in inside.values()]) <= 0.705


@pytest.mark.parametrize("along_v", [False, True])
def test_slopes_are_those_of_differences(along_v: bool) -> None:
    c = document()
    u, v = stripe_pixels(c, 0, 1200.0)
    by_pixel, slopes = range_slopes(
        u, v, along_v=along_v, camera=c.intrinsics_or_fail(), plane=c.plane_or_fail(0)
    )
    h = 1e-4
    step = (0.0, h) if along_v else (h, 0.0)
    rough = (ranges(c, u + step[0], v + step[1]) - ranges(c, u - step[0], v - step[1])) / (2 * h)
    assert by_pixel == pytest.approx(rough, rel=1e-5)
    for k in (*range(10), 13):
        h = 1e-3 if k in (0, 1, 2, 3, 13) else 1e-6
        e = h * np.eye(14)[k]
        rough = (ranges(moved(c, e), u, v) - ranges(moved(c, -e), u, v)) / (2 * h)
        assert slopes[:, k] == pytest.approx(rough, rel=1e-4, abs=1e-6 * np.abs(slopes[:, k]).max()), k


def sigma_of(c: Calibration, share: str, sigma_px: float = NOISE_PX) -> np.ndarray:
    u, v = stripe_pixels(c, 0, 2000.0)
    return sigma_range_mm(
        u,
        v,
        np.full(len(u), sigma_px),
        along_v=False,
        camera=c.intrinsics_or_fail(),
        plane=c.plane_or_fail(0),
        joint=c.joint,
        share=share,  # type: ignore[arg-type]
    )


def test_shares_add_as_squares() -> None:
    c = document()
    total, random, systematic = (sigma_of(c, s) for s in ("total", "random", "systematic"))
    assert total**2 == pytest.approx(random**2 + systematic**2)
    assert sigma_of(c, "random", 2 * NOISE_PX) == pytest.approx(2 * random)
    assert sigma_of(c, "systematic", np.nan) == pytest.approx(systematic)
    assert np.isnan(sigma_of(c, "total", np.nan)).all()


def test_independent_parts_as_a_joint_say_the_same() -> None:
    c = document()
    assert c.joint is not None
    block = np.array(c.joint.block("intrinsics", "plane/0"))
    block[:10, 10:] = 0.0
    block[10:, :10] = 0.0
    plain = Joint(order=("intrinsics", "plane/0"), covariance=tuple(map(tuple, block.tolist())))
    apart = sigma_of(c.model_copy(update={"joint": None}), "total")
    assert sigma_of(c.model_copy(update={"joint": plain}), "total") == pytest.approx(apart, rel=1e-9)
    assert (apart > 2.0 * sigma_of(c, "total")).all()


def recipe(sigma: str | None) -> Recipe:
    return Recipe.model_validate(
        {
            "name": "t",
            "stages": [
                Extract().plain(),
                Undistort().plain(),
                {"stage": "triangulate", **({} if sigma is None else {"sigma": sigma})},
            ],
        }
    )


def test_the_recipe_chooses_the_share() -> None:
    c = document()
    u, v = stripe_pixels(c, 0, 2000.0)
    # The row is whole in a table; a pixel beside the stripe is a point at another range.
    columns = {
        "frame": np.zeros(len(u), np.uint32),
        "laser": np.zeros(len(u), np.uint8),
        "row": np.round(v).astype(np.uint16),
        "angle_rad": np.zeros(len(u), np.float32),
        "u_px": u.astype(np.float32),
        "sigma_u_px": np.full(len(u), NOISE_PX, np.float32),
        "amplitude_dn": np.ones(len(u), np.float32),
        "width_px": np.ones(len(u), np.float32),
        "flags": np.zeros(len(u), np.uint16),
    }
    found = {s: PointChain(recipe(s), c).points(columns) for s in (None, "random", "systematic")}
    squares = {s: np.square(p["sigma_range_mm"].astype(float)) for s, p in found.items()}
    assert squares[None] == pytest.approx(squares["random"] + squares["systematic"])
    assert (squares["systematic"] > 0).all()


def test_keys_change_for_what_changes_the_numbers_and_for_nothing_else() -> None:
    c = document()
    assert recipe("total") == recipe(None)
    assert "sigma" not in Triangulate().plain()
    assert len({recipe(s).recipe_id() for s in (None, "random", "systematic")}) == 3

    def key(calibration: Calibration) -> tuple[str, dict[str, str]]:
        return points_key(recipe(None), stripes="0" * 64, calibration=calibration, lasers=[0])

    alone = c.model_copy(update={"joint": None})
    assert key(c)[0] != key(alone)[0]
    assert "joint" in key(c)[1]
    assert "joint" not in key(alone)[1]
    with pytest.raises(DocumentError, match="sigma"):
        parse_recipe(
            b'name = "t"\n[[stages]]\nstage = "extract"\n[[stages]]\nstage = "triangulate"\n'
            b'sigma = "both"\n',
            where="r.toml",
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": ["intrinsics", "intrinsics"]}, "stands twice"),
        ({"order": ["intrinsics", "lens"]}, "no part is called 'lens'"),
        ({"order": ["intrinsics", "plane/3"]}, "plane/3 has no covariance of its own, or is missing"),
        ({"order": ["intrinsics", "axis"]}, "covariance must be 16 x 16"),
    ],
)
def test_a_joint_part_that_does_not_fit_is_refused(change: dict[str, object], message: str) -> None:
    from turnscan.schemas.calibration import parse_calibration
    from turnscan.schemas.document import dump_json

    value = document().plain()
    value["joint"] = {**value["joint"], **change}
    with pytest.raises(DocumentError, match=message):
        parse_calibration(dump_json(value), where="c.json")
