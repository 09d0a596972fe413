"""Step-and-shoot: turn, stand still, off frame, laser on, frames, laser off; pose after pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from ...schemas.errors import DeviceError
from .floor import Floor
from .order import Missed
from .plan import PoseWork, ShotPlan

#: So many poses failed in a row: it is not the poses.
_HOPELESS: Final = 3


def step_through(floor: Floor, work: Sequence[PoseWork]) -> None:
    """Take every pose of ``work``.

    A pose that fails is tried again, without the shots that it has already, then skipped or the end,
    as the rig file says.

    Raises
    ------
    DeviceError
        A pose failed for good (``on_failure = "stop"``), several in a row did, or a laser could not be
        switched off.
    """
    in_a_row = 0
    for number, pose in enumerate(work):
        floor.progress(number, len(work))
        error = _take(floor, pose)
        if error is None:
            in_a_row = 0
            continue
        in_a_row += 1
        degrees = math.degrees(pose.angle_rad)
        if floor.order.scan.on_failure == "stop":
            raise error
        floor.missed.append(Missed(pose.angle_rad, error.message))
        floor.remark("error", f"the pose at {degrees:g} deg was skipped: {error.message}")
        if in_a_row >= _HOPELESS:
            raise DeviceError(
                f"{in_a_row} poses in a row failed, the last at {degrees:g} deg: {error.message}",
                hint=error.hint or "turnscan rig check says what is wrong",
            ) from error
    floor.progress(len(work), len(work))


def _take(floor: Floor, pose: PoseWork) -> DeviceError | None:
    """Take one pose, with retries; what was wrong the last time if it cannot be had."""
    left = list(pose.shots)
    last: DeviceError | None = None
    for attempt in range(1 + floor.order.scan.retries):
        try:
            _attempt(floor, pose.angle_rad, left)
        except DeviceError as error:
            last = error
            floor.dark()
            again = "once more" if attempt < floor.order.scan.retries else "not again"
            floor.remark(
                "warning",
                f"pose at {math.degrees(pose.angle_rad):g} deg failed ({again}): {error.message}",
            )
            floor.retried += attempt < floor.order.scan.retries
            if left and not left[-1].lasers:
                left.pop()  # An off frame behind the last lit one serves nothing.
            if not left:
                return None
            continue
        return None
    return last


def _attempt(floor: Floor, angle_rad: float, left: list[ShotPlan]) -> None:
    """Turn there and take the shots ``left``; each is taken off the list when it is in the log."""
    devices, interrupts = floor.devices, floor.interrupts
    with interrupts.let_in():
        position = devices.turntable.move_to(angle_rad)
    floor.angle(angle_rad, position)
    while left:
        shot = left[0]
        floor.light(shot.lasers)
        floor.keep_alive()
        with interrupts.let_in():
            after_ns = devices.clock.now_ns()
            taken = devices.camera.shoot(after_ns, shot.exposure_us)
        if taken.t_ns < after_ns:
            raise DeviceError(
                f"the camera gave a frame of t_ns {taken.t_ns} when asked for one after {after_ns}",
                hint="the camera's times must come from the session's clock",
            )
        floor.frame(taken, shot.lasers, shot.exposure_us, wait=True)
        floor.recorder.settle(devices.clock.now_ns())
        left.pop(0)
    floor.light(())
    floor.recorder.settle(devices.clock.now_ns())
