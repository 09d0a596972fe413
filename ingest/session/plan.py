"""What a scan consists of: poses, the shots at each, and what is missing of it. Pure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ...schemas.rig import ScanSettings

#: Two commanded angles closer than this are the same pose.
SAME_RAD = 1e-6
_WHOLE = 1e-9


@dataclass(frozen=True)
class ShotPlan:
    """One exposure at a pose: the lasers that are lit (none: the off frame), and how long."""

    lasers: tuple[int, ...]
    exposure_us: float | None = None


def pose_angles(scan: ScanSettings) -> tuple[float, ...]:
    """Angles of step-and-shoot, rad: from ``from_deg`` by ``step_deg`` up to ``to_deg``.

    ``to_deg`` itself is a pose if a step falls on it, unless it closes whole turns.
    """
    span = scan.to_deg - scan.from_deg
    count = math.floor(abs(span) / scan.step_deg + _WHOLE) + 1
    turns = abs(span) / 360.0
    whole_turns = abs(turns - round(turns)) < _WHOLE
    if whole_turns and abs((count - 1) * scan.step_deg - abs(span)) < _WHOLE * abs(span):
        count -= 1
    step = math.copysign(scan.step_deg, span)
    return tuple(math.radians(scan.from_deg + i * step) for i in range(count))


def shots_of_pose(scan: ScanSettings, lasers: Sequence[int]) -> tuple[ShotPlan, ...]:
    """The shots at each pose: for every exposure the off frame first, then each laser.

    So the last laser-off frame before a lit one has the same exposure: processing pairs them so.
    """
    together = scan.lasers == "together"
    lit = [tuple(lasers)] if together else [(n,) for n in lasers]
    out = []
    for exposure in scan.exposures_us or (None,):
        if scan.off_frame:
            out.append(ShotPlan((), exposure))
        out += [ShotPlan(each, exposure) for each in lit for _ in range(scan.frames_per_pose)]
    return tuple(out)


@dataclass(frozen=True)
class Taken:
    """A frame that an earlier log of the scan holds."""

    commanded_rad: float
    lasers: tuple[int, ...]
    exposure_us: float | None


def missing_shots(
    angle_rad: float, shots: Sequence[ShotPlan], taken: Iterable[Taken]
) -> tuple[ShotPlan, ...]:
    """Those of ``shots`` that no frame in ``taken`` at this pose stands for.

    A lit shot that is missing brings its off frame back with it: what it is subtracted from should be
    of the same moment.
    """
    exposures = [s.exposure_us for s in shots if s.exposure_us is not None]
    have: Counter[ShotPlan] = Counter()
    for frame in taken:
        if abs(frame.commanded_rad - angle_rad) <= SAME_RAD:
            exposure = None
            if exposures and frame.exposure_us is not None:
                exposure = min(exposures, key=lambda e: abs(e - (frame.exposure_us or 0.0)))
            have[ShotPlan(frame.lasers, exposure)] += 1
    lit_missing = []
    for shot in shots:
        if shot.lasers:
            if have[shot] > 0:
                have[shot] -= 1
            else:
                lit_missing.append(shot)
    if not lit_missing:
        return ()
    wanted = {s.exposure_us for s in lit_missing}
    left = Counter(lit_missing)
    out = []
    for shot in shots:
        if not shot.lasers:
            if shot.exposure_us in wanted:
                out.append(shot)
        elif left[shot] > 0:
            left[shot] -= 1
            out.append(shot)
    return tuple(out)


@dataclass(frozen=True)
class PoseWork:
    """A pose and the shots that are still to be taken there."""

    angle_rad: float
    shots: tuple[ShotPlan, ...]


def work_of(
    scan: ScanSettings, lasers: Sequence[int], taken: Sequence[Taken] = ()
) -> tuple[PoseWork, ...]:
    """Poses that lack shots, in order."""
    shots = shots_of_pose(scan, lasers)
    by_pose: Mapping[int, list[Taken]] = _by_pose(taken)
    out = []
    for angle in pose_angles(scan):
        near = round(angle / SAME_RAD)
        here = [t for k in (near - 1, near, near + 1) for t in by_pose.get(k, ())]
        missing = missing_shots(angle, shots, here) if here else shots
        if missing:
            out.append(PoseWork(angle, missing))
    return tuple(out)


def _by_pose(taken: Sequence[Taken]) -> dict[int, list[Taken]]:
    out: dict[int, list[Taken]] = {}
    for frame in taken:
        out.setdefault(round(frame.commanded_rad / SAME_RAD), []).append(frame)
    return out


@dataclass(frozen=True)
class Sweep:
    """One turn of continuous rotation: from where to where, with which lasers lit."""

    from_rad: float
    to_rad: float
    lasers: tuple[int, ...]

    @property
    def span_rad(self) -> float:
        """How far it turns."""
        return abs(self.to_rad - self.from_rad)


def sweeps_of(
    scan: ScanSettings, lasers: Sequence[int], reached: Mapping[tuple[int, ...], float] | None = None
) -> tuple[Sweep, ...]:
    """The turns of a continuous scan; ``reached`` says how far earlier logs got with each."""
    first, last = math.radians(scan.from_deg), math.radians(scan.to_deg)
    lit = [tuple(lasers)] if scan.lasers == "together" else [(n,) for n in lasers]
    out = []
    for each in lit:
        begin = (reached or {}).get(each, first)
        done = (begin - first) / (last - first)
        if done < 1 - _WHOLE:
            out.append(Sweep(begin if done > 0 else first, last, each))
    return tuple(out)


def frames_of(scan: ScanSettings, work: Sequence[PoseWork], sweeps: Sequence[Sweep], fps: float) -> int:
    """How many frames the work gives; in continuous rotation at ``fps``."""
    if scan.mode == "step":
        return sum(len(w.shots) for w in work)
    seconds = sum(math.degrees(s.span_rad) / scan.speed_deg_s for s in sweeps)
    return math.ceil(seconds * min(fps, scan.max_fps or fps)) + len(sweeps)
