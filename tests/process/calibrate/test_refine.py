"""The joint adjustment: exact derivatives, honest covariance, references, and what it refuses."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from posed import AXIS_DIRECTION, AXIS_POINT, turning_markers
from range_errors import range_errors, sequential_mm, systematic_mm
from simulated_rig import Noise, Rig

from turnscan.process.calibrate.axis import fit_axis
from turnscan.process.calibrate.camera import free_directions
from turnscan.process.calibrate.observed import one_observation, turning_of
from turnscan.process.calibrate.refine import Refined, held, refine
from turnscan.process.calibrate.refine_data import data_of, joined
from turnscan.process.calibrate.refine_quality import RefineLimits, refine_quality
from turnscan.process.calibrate.refine_residuals import residuals
from turnscan.process.calibrate.refine_solve import matrix_of
from turnscan.process.calibrate.refine_start import first_sigmas, first_state, with_references
from turnscan.process.calibrate.refine_state import Layout, moved
from turnscan.process.camera import undistort_points
from turnscan.process.triangulate import intersect, scene_from_turntable, turntable_from_camera
from turnscan.schemas.calibration import Calibration, parse_calibration
from turnscan.schemas.document import dump_json
from turnscan.schemas.errors import CalibrationError, DocumentError, InputError
from turnscan.schemas.observations import Observations, SeenLength, SeenSphere

FEW = Noise(corner_px=0.1, stripe_px=0.1, camera_views=6, plane_views=5, stripe_rows=8)
SIZE = (640, 480)


@cache
def small() -> tuple[Rig, Calibration, tuple[Observations, ...]]:
    """A small sequential calibration with an axis, and what it saw, all references included."""
    rig = Rig(3, FEW)
    base, seen = rig.sequential(axis=True)
    references = one_observation(
        SIZE,
        spheres=[rig.sphere(900.0, 120.0, 0.02)],
        lengths=[rig.length((800.0, 1300.0), 0.1)],
    )
    return rig, base, (*seen, rig.wall(3000.0, 1.5), references)


def test_every_derivative_is_that_of_differences() -> None:
    _, base, seen = small()
    every = joined(seen)
    assert every.turning is not None
    turning = every.turning.model_copy(update={"size_sd": 0.01})
    data = data_of(every.model_copy(update={"turning": turning}), base)
    assert data.turned is not None
    layout = Layout.of(
        free_directions(()),
        1,
        len(every.boards),
        int(data.turned.body.max()) + 1,
        len(data.turned.nominal_rad),
        1,
        1,
        len(data.board_of_stripe),
        exact_angles=False,
        sized=True,
    )
    state = with_references(data, first_state(data, base))
    sigmas = first_sigmas(data, layout, state)
    rng = np.random.default_rng(0)
    at = 1e-3 * rng.standard_normal(layout.width)

    def values(x: np.ndarray) -> np.ndarray:
        blocks = residuals(data, layout, moved(state, layout, x), sigmas)
        return np.concatenate([b.values for b in blocks])

    blocks = residuals(data, layout, moved(state, layout, at), sigmas)
    assert {b.kind for b in blocks} == {
        "corners", "stripes", "bends", "twists", "turning", "angles", "size", "wall stripes", "walls",
        "sphere stripes", "spheres", "lengths",
    }  # fmt: skip
    exact = matrix_of(blocks, layout).toarray()
    ends = np.cumsum([0, *(len(b.values) for b in blocks)])
    for k in range(layout.width):
        # A number that moves all residuals by some sigmas: not so small that rounding shows.
        step = 3e-4 / max(1.0, float(np.abs(exact[:, k]).max()) / 1e2)
        e = np.zeros(layout.width)
        e[k] = step
        rough = (values(at + e) - values(at - e)) / (2.0 * step)
        for b, i, j in zip(blocks, ends, ends[1:], strict=False):
            scale = float(np.abs(exact[i:j, k]).max())
            off = float(np.abs(rough[i:j] - exact[i:j, k]).max())
            assert off <= 2e-4 * scale + 1e-5 * np.abs(exact[:, k]).max(), (b.kind, k, off, scale)


def test_the_simulated_wall_is_flat_in_the_scene() -> None:
    """The simulation turns the head as the scene is defined, not as the adjustment believes."""
    rig = Rig(1, Noise(stripe_px=1e-9, stripe_rows=20))
    wall = rig.wall(2500.0, 1.0, off_mm=0.0).walls[0]
    axis = rig.true.axis_or_fail()
    clouds = []
    for seen in wall.stripes:
        u, v = np.array(seen.stripe.points_px).T
        p = intersect(*undistort_points(u, v, rig.camera), rig.true.lasers[0])
        clouds.append(scene_from_turntable(turntable_from_camera(axis)(p), seen.angle_rad, axis))
    points = np.concatenate(clouds)
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    assert size[2] < 1e-4 < 100.0 < size[1]


@cache
def refined() -> tuple[Rig, Calibration, Refined, Refined]:
    """Sequential, joint, and joint with a wall at 7 m."""
    rig = Rig(2, Noise(corner_px=0.1, stripe_px=0.1, stripe_rows=6))
    base, seen = rig.sequential()
    base = base.model_copy(update={"turntable": rig.true.turntable})
    return rig, base, refine(seen, base), refine([*seen, rig.wall(7000.0, 1.5)], base)


def test_joint_is_better_than_one_after_the_other_and_a_wall_better_still() -> None:
    rig, base, joint, wall = refined()
    stated = {}
    for name, c in (("joint", joint.calibration()), ("wall", wall.calibration())):
        for at in (3000.0, 7000.0):
            sigma = stated[name, at] = systematic_mm(c, at, middle=True)
            off = float(np.sqrt(np.mean(range_errors(c, rig.true, at) ** 2)))
            assert off < 3.0 * systematic_mm(c, at), (name, at, off, sigma)
    for at in (3000.0, 7000.0):
        before = sequential_mm(base, rig.fit, at, middle=True)
        assert stated["joint", at] < 0.8 * before
        assert stated["wall", at] < 0.7 * stated["joint", at]
        # Without the cross terms, what is known of camera and plane says next to nothing of a range.
        alone = joint.calibration().model_copy(update={"joint": None})
        assert systematic_mm(alone, at) > 5.0 * stated["joint", at]
    assert stated["wall", 7000.0] < 4.0
    assert joint.solution.sigmas.corner_px == pytest.approx(0.1, rel=0.08)
    assert joint.birge == wall.birge == 1.0


def test_parameters_are_within_their_covariance() -> None:
    rig, _, joint, _ = refined()
    c = rig.camera
    truth = np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.skew, *c.distortion])
    free = [0, 1, 2, 3, 5, 6, 7, 8, 9]
    off = (joint.state.camera - truth)[free]
    chi2 = off @ np.linalg.solve(joint.covariance[np.ix_(free, free)], off)
    assert chi2 < 27.9, "99.9 % of chi-square with 9 degrees of freedom"
    assert (np.diag(joint.covariance)[4]) == 0.0, "skew was held"


def test_everything_together_with_axis_and_all_references() -> None:
    rig, base, seen = small()
    found = refine(seen, base)
    document = found.calibration()
    assert document.joint is not None
    assert document.joint.order == ("intrinsics", "plane/0", "axis")
    axis, true = document.axis_or_fail(), rig.true.axis_or_fail()
    sigma = np.sqrt(np.diag(np.array(axis.covariance)))
    d = np.array(true.direction)
    gap = np.array(axis.point_mm) - np.array(true.point_mm)
    gap = gap - d * (gap @ d)
    assert (np.abs(gap)[[0, 2]] < 4.0 * sigma[[0, 2]]).all()
    assert (np.abs(np.array(axis.direction) - d)[[0, 2]] < 4.0 * sigma[[3, 5]]).all()
    assert {r.kind for r in found.references} == {"walls", "spheres", "lengths"}
    assert all(abs(r.sigmas) < 4.0 for r in found.references)
    cross = np.abs(found.covariance[:10, 14:]).max()
    assert cross > 0, "the axis follows the camera"
    again = parse_calibration(dump_json(document.plain()), where="refined.json")
    assert again.calibration_id() == document.calibration_id()


def test_the_origin_of_a_turning_head_stays_beside_the_camera() -> None:
    """As `calibrate axis` has it; where the origin is along the axis follows where the axis is."""
    _, base, seen = small()
    axis = refine(seen[:3], base).calibration().axis_or_fail()
    p, d = np.array(axis.point_mm), np.array(axis.direction)
    assert abs(p @ d) < 1e-9
    # So p.d is certain, whatever point and direction do: the covariance knows it.
    slopes = np.concatenate([d, p])
    assert slopes @ np.array(axis.covariance) @ slopes < 1e-12 * np.trace(np.array(axis.covariance))


def test_the_origin_of_a_turning_table_is_its_top_and_has_a_sigma_along_the_axis() -> None:
    rig = Rig(5, FEW)
    base, seen = rig.sequential()
    angles = np.arange(8) * np.deg2rad(45.0)
    sightings = turning_markers(rig.rng, angles, camera=rig.camera, sigma_px=0.1)
    camera = base.intrinsics_or_fail()
    found = fit_axis(sightings, [f"f{k}" for k in range(8)], angles, camera, head="fixed")
    base = base.model_copy(update={"turntable": found.turntable_axis()})
    fit = refine([*seen, one_observation(SIZE, turning=turning_of(found, 0.01))], base)
    axis = fit.calibration().axis_or_fail()
    error = np.concatenate(
        [np.array(axis.point_mm) - AXIS_POINT, np.array(axis.direction) - AXIS_DIRECTION]
    )
    covariance = np.array(axis.covariance)
    along = AXIS_DIRECTION @ covariance[:3, :3] @ AXIS_DIRECTION
    assert 0.005 < np.sqrt(along) < 1.0
    unit = np.sqrt(np.diag(covariance))
    size, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    assert (size > 1e-7).sum() == 5, "point in three, direction in two"
    off = (axes.T @ (error / unit))[size > 1e-7] / np.sqrt(size[size > 1e-7])
    assert off @ off < 20.5, "99.9 % of chi-square with 5 degrees of freedom"
    # An origin that somebody put elsewhere on the axis stays so far from the table.
    raised = base.axis_or_fail()
    moved = tuple(float(a + 30.0 * b) for a, b in zip(raised.point_mm, raised.direction, strict=True))
    base = base.model_copy(update={"turntable": raised.model_copy(update={"point_mm": moved})})
    again = refine([*seen, one_observation(SIZE, turning=turning_of(found, 0.01))], base)
    gap = np.array(again.calibration().axis_or_fail().point_mm) - np.array(axis.point_mm)
    assert gap == pytest.approx(30.0 * np.array(axis.direction), abs=1e-3)


def test_what_a_board_pulls_is_what_its_loss_changes() -> None:
    _, base, seen = small()
    two = [seen[0], seen[1]]
    plain = base.model_copy(update={"turntable": None})
    whole = refine(two, plain)
    at = 3
    name = seen[0].boards[at].name
    assert whole.data.board_names[at] == name
    fewer = seen[0].model_copy(update={"boards": seen[0].boards[:at] + seen[0].boards[at + 1 :]})
    rest = refine([fewer, seen[1]], plain)
    moved_by = rest.state.camera - whole.state.camera
    step = whole.pulls.without[list(whole.pulls.cluster).index(at)]
    foretold = whole.slopes[:10] @ step
    sigma = np.sqrt(np.diag(rest.covariance))[:4]
    assert np.abs(moved_by[:4] / sigma).max() > 0.1
    # To first order, and sigmas found anew: within a tenth of what is known at all.
    assert (np.abs(foretold[:4] - moved_by[:4]) < 0.1 * sigma).all()


def test_boards_that_bend_are_named_with_the_mm_they_cost() -> None:
    _, base, seen = small()
    rng = np.random.default_rng(1)
    boards = []
    for board in (*seen[0].boards, *Rig(4, FEW).sequential()[1][0].boards):
        px = np.array(board.points_px)
        x = np.array(board.points_mm)[:, 0] / 120.0 - 1.0
        px[:, 0] += 1.5 * rng.choice([-1.0, 1.0]) * (x**2 - np.mean(x**2))
        name = f"{len(boards)} {board.name}"
        bent = tuple((float(u), float(v)) for u, v in px)
        boards.append(board.model_copy(update={"points_px": bent, "name": name}))
    spoilt = seen[0].model_copy(update={"boards": tuple(boards)})
    fit = refine([spoilt, seen[1]], base.model_copy(update={"turntable": None}))
    assert fit.birge > 1.5
    told = [n for n in refine_quality(fit, fit.calibration(), RefineLimits()).notes if "pull" in n]
    assert len(told) == 1
    assert "ranges at 1 m would move most without" in told[0]
    assert sum(f"{b.name} " in told[0] for b in boards) >= 1
    assert "mm" in told[0]


def test_an_outlier_does_not_carry_the_solution_away() -> None:
    rig, base, joint, _ = refined()
    _, seen = Rig(2, rig.noise).sequential()
    boards = list(seen[0].boards)
    px = list(boards[4].points_px)
    px[7] = (px[7][0] + 8.0, px[7][1] - 6.0)
    boards[4] = boards[4].model_copy(update={"points_px": tuple(px)})
    spoilt = refine([seen[0].model_copy(update={"boards": tuple(boards)}), seen[1]], base)
    moved_by = (spoilt.state.camera - joint.state.camera)[:4]
    assert (np.abs(moved_by) < 0.7 * np.sqrt(np.diag(joint.covariance))[:4]).all()


def test_a_wrong_wall_contradicts_the_boards() -> None:
    rig, base, _, _ = refined()
    _, seen = Rig(2, rig.noise).sequential()
    with pytest.raises(
        CalibrationError, match=r"wall 3000 contradicts the rest: .* mm or .* sigma off"
    ):
        refine([*seen, rig.wall(3000.0, 1.5, off_mm=60.0)], base)


def test_two_walls_that_exclude_each_other() -> None:
    rig, base, _, _ = refined()
    _, seen = Rig(2, rig.noise).sequential()
    walls = [rig.wall(7000.0, 1.0, off_mm=0.0), rig.wall(6500.0, 1.0, off_mm=20.0)]
    with pytest.raises(CalibrationError, match="contradicts the rest"):
        refine([*seen, *walls], base)


def test_what_cannot_be_adjusted_is_refused() -> None:
    rig, base, seen = small()
    with pytest.raises(InputError, match="no boards"):
        refine([rig.wall(3000.0, 1.0)], base)
    with pytest.raises(InputError, match="no observations"):
        refine([], base)
    with pytest.raises(InputError, match="seen in one stripe only"):
        refine([*seen[:2], rig.wall(3000.0, 1.0, heads_deg=(0.0,))], base)
    with pytest.raises(InputError, match="different image sizes"):
        refine([seen[0], seen[1].model_copy(update={"width_px": 800})], base)
    with pytest.raises(InputError, match="hold a turning table"):
        refine([seen[2], seen[2]], base)
    with pytest.raises(InputError, match="two references are called"):
        refine([*seen[:2], seen[3], seen[3]], base)
    with pytest.raises(CalibrationError, match="no turntable axis"):
        refine([*seen[:2], seen[3]], base.model_copy(update={"turntable": None}))
    with pytest.raises(CalibrationError, match="seen on a reference, but on no board"):
        refine([seen[0], seen[3]], base)
    other = base.model_copy(
        update={
            "turntable": base.axis_or_fail().model_copy(update={"positive_turn": "counterclockwise"})
        }
    )
    with pytest.raises(CalibrationError, match="turns the other way"):
        refine(seen[:3], other)
    head = base.axis_or_fail().model_copy(update={"head": "fixed"})
    with pytest.raises(CalibrationError, match="head that is 'rotates'"):
        refine(seen[:3], base.model_copy(update={"turntable": head}))
    with pytest.raises(CalibrationError, match="do not fix all that is to be estimated"):
        board = seen[0].boards[0]
        five = [0, 8, 20, 45, 53]
        few = board.model_copy(
            update={
                "points_px": tuple(board.points_px[i] for i in five),
                "points_mm": tuple(board.points_mm[i] for i in five),
            }
        )
        one = seen[0].model_copy(update={"boards": (few,)})
        refine([one], base.model_copy(update={"lasers": (), "turntable": None}))


def test_a_board_in_two_files_counts_once() -> None:
    _, _, seen = small()
    both = joined([seen[1], seen[1], seen[0]])
    assert len(both.boards) == len(seen[0].boards) + len(seen[1].boards)
    assert joined([seen[1]]).boards == joined([seen[1], seen[1]]).boards


def test_what_a_calibration_held_is_held_again() -> None:
    _, base, _ = small()
    assert held(base.intrinsics_or_fail()) == ("skew",)
    plain = base.intrinsics_or_fail().model_copy(update={"covariance": None})
    assert held(plain) == ("skew",)
    assert held(plain.model_copy(update={"skew": 1e-3})) == ()


def test_sphere_and_length_of_other_size_are_contradictions() -> None:
    rig, base, seen = small()
    sphere: SeenSphere = rig.sphere(900.0, 120.0, 0.02)
    big = sphere.model_copy(update={"diameter_mm": 126.0})
    with pytest.raises(CalibrationError, match="sphere contradicts the rest"):
        refine([*seen[:3], one_observation(SIZE, spheres=[big])], base)
    length: SeenLength = rig.length((800.0, 1300.0), 0.1)
    wrong = length.model_copy(update={"length_mm": length.length_mm + 25.0})
    with pytest.raises(CalibrationError, match="length contradicts the rest"):
        refine([*seen[:3], one_observation(SIZE, lengths=[wrong])], base)


def test_a_part_that_is_replaced_ends_the_joint_covariance() -> None:
    _, _, joint, _ = refined()
    value = joint.calibration().plain()
    value["lasers"][0]["covariance"][3][3] *= 1.01
    with pytest.raises(DocumentError, match="joint: its covariance of plane/0 is not the part's own"):
        parse_calibration(dump_json(value), where="edited.json")
