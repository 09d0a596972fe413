"""Which angle belongs to which frame."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.mcap_times import in_order, most_waiting
from turnscan.schemas.events import TurntableAngle
from turnscan.store import Archive

from ..images import frames, pixels
from ..messages import cdr_writer as cdr
from ..recordings import MS, T0, Recording, times
from .importing import joint, of_kind, refused, ros_image, run, said


def test_a_table_that_turns(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(4)):
        joint(rec, t_ns - 10 * MS, 0.1 * min(i, 2))
        ros_image(rec, t_ns, pixels(i))
    path = rec.close()
    items = run(lab, path)
    assert [a.moving for a in of_kind(items, TurntableAngle)] == [None] * 4
    assert "frames between two different angles: 2" in said(items)
    items = run(lab, path, mode="continuous", again=True)
    assert [a.moving for a in of_kind(items, TurntableAngle)] == [True, True, None, None]
    assert "between two different angles" not in said(items)
    assert "between two different angles" not in said(run(lab, path, mode="step", again=True))


def test_a_joint_that_says_it_moves(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        joint(rec, t_ns, 0.1 * i, velocity=1.0)
        ros_image(rec, t_ns, pixels(i))
    assert [a.moving for a in of_kind(run(lab, rec.close()), TurntableAngle)] == [True, True, None]


def test_frames_before_the_first_angle_are_left_out_and_that_is_said(
    lab: Archive, tmp_path: Path
) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(5)):
        ros_image(rec, t_ns, pixels(i))
        if i >= 2:
            joint(rec, t_ns, 0.1)
    items = run(lab, rec.close())
    assert [f.t_ns for f in frames(items)] == list(times(5))[2:]
    assert "before the first angle: 2" in said(items)


def test_no_overlap_in_time(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        ros_image(rec, t_ns, pixels(i))
    joint(rec, T0 + 10**12, 0.1)
    path = rec.close()
    assert "--times" in refused(path, r"no overlap in time: /camera/image_raw runs from t_ns 17").hint
    refused(path, "no overlap in time", times="stamp")
    rec = Recording(tmp_path / "stale.mcap")
    ros_image(rec, T0, pixels())
    joint(rec, T0 - 120 * 10**9, 0.1)
    refused(rec.close(), "no overlap in time")


def test_stamps_of_two_clocks_are_not_paired(lab: Archive, tmp_path: Path) -> None:
    """A camera that counts from its start: log times are used, and that is said."""
    rec = Recording(tmp_path / "bag.mcap")
    for i, t_ns in enumerate(times(3)):
        joint(rec, t_ns, 0.1 * i)
        data = cdr.image(t_ns - T0 + 1, "mono8", pixels(i).tobytes(), width=64, height=48, step=64)
        rec.ros("/image", "sensor_msgs/msg/Image", t_ns + 5 * MS, data)
    path = rec.close()
    items = run(lab, path)
    assert [f.t_ns for f in frames(items)] == [t + 5 * MS for t in times(3)]
    assert "times are log times of the messages (by their stamps" in said(items)
    refused(path, "no overlap in time", times="stamp")


def test_messages_out_of_order_are_put_in_order(lab: Archive, tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap", chunk_bytes=5000)
    stamps = times(8)
    for i in (1, 0, 3, 2, 5, 7, 4, 6):
        ros_image(rec, stamps[i], pixels(i))
    for i in (7, 6, 5, 4, 3, 2, 1, 0):
        joint(rec, stamps[i], 0.1 * i)
    items = run(lab, rec.close())
    assert [f.t_ns for f in frames(items)] == list(stamps)
    for i, frame in enumerate(frames(items)):
        assert np.array_equal(frame.decode(), pixels(i))
    assert [a.t_ns for a in of_kind(items, TurntableAngle)] == list(stamps)


def test_images_too_far_out_of_order_are_refused(tmp_path: Path) -> None:
    rec = Recording(tmp_path / "bag.mcap")
    small = np.zeros((2, 2), np.uint8)
    joint(rec, T0, 0.1)
    for t_ns in reversed(times(70)):
        ros_image(rec, t_ns, small)
    assert "mcap sort" in refused(rec.close(), "up to 70 places out of order").hint


@given(st.lists(st.integers(0, 20), min_size=1, max_size=40))
def test_order_and_what_waits_for_it(values: list[int]) -> None:
    order = list(in_order(values))
    assert [values[i] for i in order] == sorted(values)
    assert all(a < b for a, b in pairwise(order) if values[a] == values[b])
    held, following, most = set(), 0, 0
    for i in range(len(values)):
        held.add(order.index(i))
        most = max(most, len(held))
        while following in held:
            held.remove(following)
            following += 1
    assert most_waiting(order) == most
    assert (most == 1) is (values == sorted(values))
