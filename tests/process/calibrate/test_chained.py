"""The joint covariance of parts that follow each other: closed form, replaced parts, what stays."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_rig import truth

from turnscan.process.calibrate.chained import Follower, chained
from turnscan.process.uncertainty import covariance_factor
from turnscan.schemas.calibration import Calibration, parse_calibration
from turnscan.schemas.document import dump_json

RNG = np.random.default_rng(7)


def spread(size: int) -> np.ndarray:
    a = RNG.standard_normal((size, size))
    return a @ a.T


C, K, A = spread(10), spread(4), spread(6)
B_PLANE, B_AXIS = RNG.standard_normal((4, 10)), RNG.standard_normal((6, 10))


def camera_only(covariance: np.ndarray | None = C) -> Calibration:
    true = truth()
    stated = None if covariance is None else tuple(map(tuple, covariance.tolist()))
    camera = true.intrinsics_or_fail().model_copy(update={"covariance": stated})
    return Calibration(rig="chain", camera=camera)


def plane(own: np.ndarray = K, by: np.ndarray | None = B_PLANE, laser: int = 0) -> Follower:
    part = truth().lasers[0].model_copy(update={"laser": laser})
    return Follower(part, own, None if by is None else {"intrinsics": by})


def axis(by: np.ndarray | None = B_AXIS) -> Follower:
    part = truth().axis_or_fail().model_copy(update={"covariance": tuple(map(tuple, A.tolist()))})
    return Follower(part, A, None if by is None else {"intrinsics": by})


def test_two_followers_of_one_camera() -> None:
    made = chained(chained(camera_only(), [plane()]), [axis()])
    assert made.joint is not None
    assert made.joint.order == ("intrinsics", "plane/0", "axis")
    follow = np.concatenate([np.eye(10), B_PLANE, B_AXIS])
    expected = follow @ C @ follow.T
    expected[10:14, 10:14] += K
    expected[14:, 14:] += A
    assert np.array(made.joint.covariance) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    # A document that can be written and read: each part states its own block.
    assert parse_calibration(dump_json(made.plain()), where="c.json") == made


def test_errors_that_follow_each_other_cancel() -> None:
    """A number that camera and plane change in opposite ways is as good as the plane alone."""
    made = chained(camera_only(), [plane(own=np.zeros((4, 4)))])
    camera, laser = made.intrinsics_or_fail(), made.lasers[0]
    slopes = np.concatenate([-B_PLANE.T @ np.ones(4), np.ones(4)])
    together = np.linalg.norm(slopes @ covariance_factor(camera, laser, made.joint))
    apart = np.linalg.norm(slopes @ covariance_factor(camera, laser))
    assert together < 1e-6 * apart


def test_a_part_that_is_estimated_anew_forgets_the_old_one() -> None:
    first = chained(camera_only(), [plane(), plane(laser=1)])
    again = chained(first, [plane(own=4.0 * K)])
    assert again.joint is not None
    assert again.joint.order == ("intrinsics", "plane/1", "plane/0")
    assert [p.laser for p in again.lasers] == [0, 1]
    block = np.array(again.joint.block("plane/0"))
    assert block == pytest.approx(4.0 * K + B_PLANE @ C @ B_PLANE.T)
    # Two planes that follow one camera have its errors in common.
    cross = np.array(again.joint.block("plane/1", "plane/0"))[:4, 4:]
    assert cross == pytest.approx(B_PLANE @ C @ B_PLANE.T)
    assert first.joint is not None
    assert again.joint.block("intrinsics", "plane/1") == first.joint.block("intrinsics", "plane/1")


def test_what_nobody_knows_is_not_claimed() -> None:
    exact = chained(camera_only(None), [plane(), axis()])
    assert exact.joint is None
    assert np.array(exact.lasers[0].covariance) == pytest.approx(K)
    assert np.array(exact.axis_or_fail().covariance) == pytest.approx(A)
    # An axis in the laser's scale states its own covariance; camera and plane keep theirs.
    sized = chained(chained(camera_only(), [plane()]), [axis(by=None)])
    assert sized.joint is not None
    assert sized.joint.order == ("intrinsics", "plane/0")
    assert np.array(sized.axis_or_fail().covariance) == pytest.approx(A)
    # A plane of an older document, without cross terms, does not get any.
    old = camera_only().model_copy(update={"lasers": (truth().lasers[0],)})
    made = chained(old, [plane(laser=1)])
    assert made.joint is not None
    assert made.joint.order == ("intrinsics", "plane/1")
