"""Calibration documents: identity, normalisation, the paper's parameters, and what is refused."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.schemas.calibration import (
    Calibration,
    Intrinsics,
    LaserPlane,
    PaperCalibration,
    TurntableAxis,
    parse_calibration,
)
from turnscan.schemas.errors import CalibrationError, DocumentError, FormatVersionError


def example() -> Calibration:
    return Calibration(
        rig="r1",
        camera=Intrinsics(
            width_px=640,
            height_px=480,
            fx_px=761.74797,
            fy_px=762.26178,
            cx_px=296.92665,
            cy_px=271.50956,
            distortion=(-0.20997, 0.1649, 0.0008, -0.00001, 0.0),
        ),
        lasers=(LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=120.0),),
        turntable=TurntableAxis(point_mm=(-50.0, 0.0, -20.0), direction=(0.0, -1.0, 0.0)),
    )


def test_ids_are_pinned() -> None:
    c = example()
    assert c.calibration_id() == "c-e177ff6d2839"
    assert {k: v[:12] for k, v in c.part_ids().items()} == {
        "intrinsics": "acd673390c83",
        "plane/0": "f208f520b9fd",
        "axis": "f9ca07d9db62",
    }


def test_document_round_trips_with_the_same_id() -> None:
    c = example()
    again = parse_calibration(json.dumps(c.plain()), where="c.json")
    assert again == c
    assert again.calibration_id() == c.calibration_id()


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0.9995, 1.0005), st.floats(-1e3, 1e3))
def test_normalising_is_idempotent_and_keeps_the_plane(
    direction: tuple[float, float, float], scale: float, distance: float
) -> None:
    n = math.sqrt(sum(a * a for a in direction))
    if n < 0.1:
        return
    normal = tuple(a / n * scale for a in direction)
    plane = LaserPlane(laser=0, normal=normal, distance_mm=distance)
    assert math.isclose(sum(a * a for a in plane.normal), 1.0, abs_tol=1e-13)
    assert plane.distance_mm == pytest.approx(distance / scale, rel=1e-12, abs=1e-12)
    assert LaserPlane.model_validate(plane.plain()) == plane


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normal": [1.0, 1.0, 0.0]}, "normal has length 1.41421, expected 1"),
        ({"laser": 256}, "less than or equal to 255"),
        ({"distance_mm": "far"}, "valid number"),
        ({"covariance": [[1.0]]}, "covariance must be 4 x 4"),
        ({"spin": 1}, "Extra inputs"),
    ],
)
def test_bad_planes_name_the_field(change: dict[str, object], message: str) -> None:
    document = example().plain()
    document["lasers"][0] |= change
    with pytest.raises(DocumentError, match=message) as caught:
        parse_calibration(json.dumps(document), where="cal.json")
    assert "cal.json" in str(caught.value)


@pytest.mark.parametrize("token", ["NaN", "Infinity", "-Infinity"])
def test_not_a_number_is_refused(token: str) -> None:
    text = json.dumps(example().plain()).replace("761.74797", token)
    with pytest.raises(DocumentError, match=r"cal\.json: contains"):
        parse_calibration(text, where="cal.json")


def test_an_overflowing_number_is_refused() -> None:
    text = json.dumps(example().plain()).replace("761.74797", "1e999")
    with pytest.raises(DocumentError, match="fx_px"):
        parse_calibration(text, where="cal.json")


def test_repeated_keys_are_refused() -> None:
    with pytest.raises(DocumentError, match="stands twice"):
        parse_calibration('{"format": "a", "format": "b"}', where="cal.json")


def test_newer_version_says_so() -> None:
    document = example().plain() | {"version": 2}
    with pytest.raises(FormatVersionError, match="version 2, this turnscan reads up to 1"):
        parse_calibration(json.dumps(document), where="cal.json")


def test_other_documents_are_refused() -> None:
    with pytest.raises(DocumentError, match=r"format is None.*turnscan\.paper-calibration"):
        parse_calibration("{}", where="cal.json")
    with pytest.raises(DocumentError, match="not JSON"):
        parse_calibration("fx: 1", where="cal.json")
    with pytest.raises(DocumentError, match="expected a JSON object"):
        parse_calibration("[]", where="cal.json")


def test_covariance_must_be_one() -> None:
    eye = [[1.0 if i == j else 0.0 for j in range(4)] for i in range(4)]
    LaserPlane(laser=0, normal=(1.0, 0.0, 0.0), distance_mm=1.0, covariance=eye)
    for i, j, value, message in [
        (0, 0, -1.0, "below zero"),
        (0, 1, 0.5, "differs"),
    ]:
        bad = [row[:] for row in eye]
        bad[i][j] = value
        with pytest.raises(ValueError, match=message):
            LaserPlane(laser=0, normal=(1.0, 0.0, 0.0), distance_mm=1.0, covariance=bad)
    bad = [row[:] for row in eye]
    bad[0][1] = bad[1][0] = 1.5
    with pytest.raises(ValueError, match="correlation above 1"):
        LaserPlane(laser=0, normal=(1.0, 0.0, 0.0), distance_mm=1.0, covariance=bad)


def test_axis_along_camera_x_needs_an_x_direction() -> None:
    with pytest.raises(ValueError, match="give an x_direction"):
        TurntableAxis(point_mm=(0, 0, 400), direction=(1.0, 0.0, 0.0))
    TurntableAxis(point_mm=(0, 0, 400), direction=(1.0, 0.0, 0.0), x_direction=(0.0, 1.0, 0.0))


@pytest.mark.parametrize(
    ("head", "turn", "sign"),
    [
        ("fixed", "counterclockwise", -1),
        ("fixed", "clockwise", 1),
        ("rotates", "counterclockwise", 1),
        ("rotates", "clockwise", -1),
    ],
)
def test_turn_sign(head: str, turn: str, sign: int) -> None:
    axis = TurntableAxis(
        point_mm=(0, 0, 400), direction=(0.0, -1.0, 0.0), head=head, positive_turn=turn
    )
    assert axis.turn_sign() == sign


def test_paper_parameters_become_the_general_model() -> None:
    theta = 1.3
    paper = PaperCalibration(
        rig="xiao",
        width_px=640,
        height_px=480,
        f_px=762.0,
        cx_px=296.9,
        cy_px=271.5,
        L_mm=300.0,
        D_mm=150.0,
        theta_rad=theta,
        c_mm=12.0,
    )
    c = parse_calibration(json.dumps(paper.plain()), where="paper.json")
    assert c == paper.calibration()
    plane, axis = c.plane_or_fail(0), c.axis_or_fail()
    assert plane.normal == pytest.approx((math.sin(theta), 0.0, math.cos(theta)))
    assert plane.distance_mm == pytest.approx(300.0 * math.sin(theta))
    assert axis.point_mm == (150.0, 0.0, -12.0)
    assert axis.direction == (0.0, -1.0, 0.0)
    assert axis.turn_sign() == -1


def test_missing_parts_are_named() -> None:
    c = Calibration(rig="r1")
    with pytest.raises(CalibrationError, match=r"c-[0-9a-f]{12} of rig 'r1' has no camera"):
        c.intrinsics_or_fail()
    with pytest.raises(CalibrationError, match="has no plane of laser 3"):
        c.plane_or_fail(3)
    with pytest.raises(CalibrationError, match="has no turntable axis"):
        c.axis_or_fail()


def test_a_laser_stands_once() -> None:
    plane = example().lasers[0]
    with pytest.raises(ValueError, match="stands twice"):
        Calibration(rig="r1", lasers=(plane, plane))
