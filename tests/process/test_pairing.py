"""Frames find their angle and their laser-off frame by time, in one pass, holding back little."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from turnscan.process.pairing import LitFrame, pair_frames
from turnscan.schemas.errors import InputError
from turnscan.schemas.events import TurntableAngle


@dataclass
class Shot:
    """A frame of one pixel whose grey value is its number."""

    frame: int
    t_ns: int
    lasers_on: tuple[int, ...] = (0,)

    def decode(self) -> np.ndarray:
        return np.full((1, 1), self.frame, np.uint8)


def angle(t_ns: int, commanded: float, reported: float | None = None) -> TurntableAngle:
    return TurntableAngle(t_ns=t_ns, commanded_rad=commanded, reported_rad=reported)


def pairs(items: list[object], *, background: bool = True) -> list[tuple[int, float, int | None]]:
    return [
        (p.frame, p.angle_rad, None if p.background is None else int(p.background[0, 0]))
        for p in pair_frames(items, with_background=background)
    ]


def test_angle_is_the_last_one_before_the_frame() -> None:
    items = [angle(0, 0.1), Shot(0, 1), Shot(1, 2), angle(3, 0.2), Shot(2, 4)]
    assert pairs(items, background=False) == [(0, 0.1, None), (1, 0.1, None), (2, 0.2, None)]


def test_reported_angle_wins_over_the_commanded_one() -> None:
    assert pairs([angle(0, 0.1, 0.11), Shot(0, 1)], background=False) == [(0, 0.11, None)]


def test_a_frame_before_any_angle_is_an_error() -> None:
    with pytest.raises(InputError, match=r"frame 7 .* has no turntable angle"):
        pairs([Shot(7, 1), angle(2, 0.1)], background=False)


@pytest.mark.parametrize("off_first", [True, False])
def test_the_off_frame_of_the_same_angle_serves_before_or_after(off_first: bool) -> None:
    items: list[object] = []
    for pose in range(3):
        items.append(angle(10 * pose, 0.1 * pose))
        on, off = Shot(2 * pose, 10 * pose + 1), Shot(2 * pose + 1, 10 * pose + 2, ())
        items += [off, on] if off_first else [on, off]
    assert pairs(items) == [(0, 0.0, 1), (2, 0.1, 3), (4, 0.2, 5)]


def test_one_off_frame_serves_the_whole_scan() -> None:
    items = [angle(0, 0.0), Shot(0, 1, ())]
    for pose in range(1, 4):
        items += [angle(10 * pose, 0.1 * pose), Shot(pose, 10 * pose + 1)]
    assert [(f, off) for f, _, off in pairs(items)] == [(1, 0), (2, 0), (3, 0)]


def test_an_off_frame_may_come_before_the_first_angle() -> None:
    assert pairs([Shot(0, 0, ()), angle(1, 0.5), Shot(1, 2)]) == [(1, 0.5, 0)]


def test_no_off_frame_is_an_error_with_a_way_out() -> None:
    with pytest.raises(InputError, match="frame 0 has no laser-off frame") as caught:
        pairs([angle(0, 0.1), Shot(0, 1), angle(2, 0.2), Shot(1, 3), Shot(2, 4, ())])
    assert 'extract.background = "none"' in str(caught.value.hint)


def test_off_frames_are_left_out_without_background() -> None:
    items = [angle(0, 0.1), Shot(0, 1, ()), Shot(1, 2)]
    assert pairs(items, background=False) == [(1, 0.1, None)]


def test_at_most_one_pose_is_held_back() -> None:
    taken: list[int] = []

    def stream() -> object:
        yield Shot(0, 0, ())
        for pose in range(1, 50):
            yield angle(10 * pose, 0.1 * pose)
            taken.append(pose)
            yield Shot(pose, 10 * pose + 1)

    seen: list[LitFrame] = []
    for lit in pair_frames(stream(), with_background=True):
        seen.append(lit)
        assert len(taken) - len(seen) <= 1
    assert len(seen) == 49


def turning(t_ns: int, reported: float) -> TurntableAngle:
    return TurntableAngle(t_ns=t_ns, commanded_rad=9.0, reported_rad=reported, moving=True)


def test_while_the_table_turns_angles_lie_between_two_reports() -> None:
    items = [
        turning(0, 0.0),
        Shot(0, 25),
        Shot(1, 50),
        turning(100, 0.4),
        Shot(2, 150),
        angle(200, 9.0, 0.5),
    ]
    found = pairs(items, background=False)
    assert [f for f, _, _ in found] == [0, 1, 2]
    assert [a for _, a, _ in found] == pytest.approx([0.1, 0.2, 0.45])


def test_after_the_last_report_of_a_turning_table_frames_have_no_angle() -> None:
    items = [turning(0, 0.0), Shot(0, 5), turning(10, 0.1), Shot(1, 15), Shot(2, 16)]
    left_out: list[int] = []
    found = list(pair_frames(items, with_background=False, left_out=left_out))
    assert [p.frame for p in found] == [0]
    assert left_out == [1, 2]


def test_at_rest_the_last_report_holds_even_after_turning() -> None:
    items = [turning(0, 0.0), Shot(0, 5), angle(10, 9.0, 0.1), Shot(1, 15), angle(20, 9.0, 0.1)]
    assert [a for _, a, _ in pairs(items, background=False)] == pytest.approx([0.05, 0.1])


def test_the_off_frame_before_a_turn_serves_all_of_it() -> None:
    items = [angle(0, 0.0), Shot(0, 1, ()), turning(2, 0.0)]
    for n in range(1, 5):
        items += [Shot(n, 10 * n), turning(10 * n + 5, 0.1 * n)]
    found = pairs(items)
    assert [(f, off) for f, _, off in found] == [(n, 0) for n in range(1, 5)]
    assert [a for _, a, _ in found] == sorted(a for _, a, _ in found)
