"""Plan what a recipe means for scans, derive what is missing, publish it: where process meets store.

One scan is one task: its log is read once, frames stream through the stages one by one, STRIPES are
sealed, and POINTS are derived from the sealed STRIPES. The result does not depend on the workers.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..schemas.errors import CalibrationError, InputError, TurnscanError
from ..schemas.events import TurntableAngle
from ..schemas.manifests import DerivationManifest, ScanSummary
from ..schemas.recipe import Recipe
from ..schemas.tables import POINTS, STRIPES
from ..store import Archive
from ..store.log_reader import LogFrame
from ..store.plan import Plan, stage_records
from .batches import columns_of, record_batches
from .pairing import LitFrame, pair_frames
from .stages import FrameChain, PointChain, check_size
from .workers import in_processes

if TYPE_CHECKING:
    import pyarrow as pa

LOG = logging.getLogger("turnscan")

Advance = Callable[[int, int], None]


@dataclass(frozen=True)
class Outcome:
    """What happened to one scan: what was derived, or why nothing could be."""

    scan: str
    derived: tuple[str, ...] = ()
    reasons: dict[str, str] = field(default_factory=dict)
    points: int = 0
    frames: int = 0
    frames_without_stripe: int = 0
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    error: TurnscanError | None = None


def derive(
    archive: Archive,
    scans: Sequence[ScanSummary],
    recipe: Recipe,
    calibration: str = "current",
    *,
    workers: int = 1,
    advance: Advance | None = None,
) -> Iterator[Outcome]:
    """Derive what is missing of ``recipe`` on ``scans``; outcomes in the order of ``scans``.

    ``workers`` above 1 uses that many processes, a scan each. A scan that fails gives an outcome with
    its error and stops none of the others.
    """
    total = sum(s.frames for s in scans)
    done = 0

    def step(frames: int) -> None:
        if advance is not None:
            advance(done + frames, total)

    plans = archive.plan(scans, recipe, calibration)
    if workers > 1 and len(scans) > 1:
        jobs = [(archive.root, s, p) for s, p in zip(scans, plans, strict=True)]
        outcomes = in_processes(min(workers, len(jobs)), _in_worker, jobs)
    else:
        outcomes = (_one(archive, s, p, step) for s, p in zip(scans, plans, strict=True))
    for scan, outcome in zip(scans, outcomes, strict=True):
        done += scan.frames
        step(0)
        yield outcome


def _one(
    archive: Archive,
    scan: ScanSummary,
    plan: Plan | TurnscanError,
    step: Callable[[int], None] | None,
) -> Outcome:
    if isinstance(plan, TurnscanError):
        return Outcome(scan.scan, error=plan)
    try:
        return derive_scan(archive, plan, step)
    except TurnscanError as error:
        return Outcome(scan.scan, error=error)


@cache
def _archive(root: Path) -> Archive:
    """The archive of this worker process: opened once, not for each of a thousand small scans."""
    return Archive.open(root)


def _in_worker(root: Path, scan: ScanSummary, plan: Plan | TurnscanError) -> Outcome:
    try:
        return _one(_archive(root), scan, plan, None)
    except TurnscanError as error:
        return Outcome(scan.scan, error=error)


def derive_scan(archive: Archive, plan: Plan, step: Callable[[int], None] | None = None) -> Outcome:
    """Derive and publish what ``plan`` finds missing.

    Raises
    ------
    TurnscanError
        The log, the calibration or the recipe do not allow it, or the disk refuses; nothing
        half-done is published.
    """
    if plan.done:
        return Outcome(plan.scan.scan)
    began = time.monotonic()
    name = plan.calibration.calibration_id()
    LOG.info("%s: calibration %s, %s", plan.scan.scan, name, plan.why_calibration)
    reasons = {kind: archive.why_missing(plan, kind) for kind in plan.missing}
    check_size(plan.calibration.intrinsics_or_fail(), plan.scan.width_px, plan.scan.height_px)
    stripes = plan.stripes or _derive_stripes(archive, plan, step)
    points = plan.points or _derive_points(archive, plan, stripes)
    return Outcome(
        scan=plan.scan.scan,
        derived=plan.missing,
        reasons=reasons,
        points=points.rows,
        frames=stripes.frames,
        frames_without_stripe=stripes.frames_without_stripe,
        seconds=time.monotonic() - began,
        warnings=(*stripes.warnings, *points.warnings),
    )


@dataclass
class _Tally:
    """What is counted while frames stream by, for the manifest."""

    frames: int = 0
    empty: int = 0

    def warnings(self) -> tuple[str, ...]:
        out = []
        if self.frames and self.empty == self.frames:
            out.append("no frame shows a stripe: lower extract.base_dn, or look at the frames")
        elif self.empty:
            out.append(f"{self.empty} of {self.frames} frames show no stripe")
        return tuple(out)


def _derive_stripes(
    archive: Archive, plan: Plan, step: Callable[[int], None] | None
) -> DerivationManifest:
    chain = FrameChain(plan.recipe, plan.calibration)
    with_background = plan.recipe.extract().background == "off-frame"
    tally = _Tally()
    camera = plan.scan.cameras[0]
    if len(plan.scan.cameras) > 1:
        raise InputError(
            f"scan {plan.scan.scan} has {len(plan.scan.cameras)} cameras, a calibration has one",
            hint="record or import each camera as a scan of its own",
        )

    def items() -> Iterator[Any]:
        for item in archive.log(plan.scan.scan).items():
            if isinstance(item, TurntableAngle) or (
                isinstance(item, LogFrame) and item.camera == camera
            ):
                yield item

    def parts() -> Iterator[dict[str, Any]]:
        for lit in pair_frames(items(), with_background=with_background):
            _check_frame(plan.scan, lit)
            try:
                found = chain.extract(lit.image, lit.lasers_on, lit.background)
            except (InputError, CalibrationError) as error:
                raise type(error)(
                    f"scan {plan.scan.scan}, frame {lit.frame}: {error}", hint=error.hint
                ) from error
            tally.frames += 1
            tally.empty += not any(len(points) for _, points in found)
            if step is not None:
                step(tally.frames)
            yield _stripe_columns(lit.frame, lit.t_ns, lit.angle_rad, found)

    return archive.publish(
        record_batches(STRIPES, parts()),
        **_fields(plan, "stripes"),
        frames=lambda: tally.frames,
        frames_without_stripe=lambda: tally.empty,
        warnings=tally.warnings,
    )


def _check_frame(scan: ScanSummary, lit: LitFrame) -> None:
    """A frame of another size than the scan's would be triangulated wrongly without a word."""
    height, width = lit.image.shape[:2]
    if (width, height) != (scan.width_px, scan.height_px):
        raise InputError(
            f"scan {scan.scan}, frame {lit.frame}: is {width} x {height}, the scan's first frame is "
            f"{scan.width_px} x {scan.height_px}",
            hint="a scan holds frames of one size: record or import the others as a scan of their own",
        )


def _stripe_columns(
    frame: int, t_ns: int, angle_rad: float, found: list[tuple[int, np.ndarray[Any, Any]]]
) -> dict[str, Any]:
    """One frame's stripe points of all lasers, in the order of rows."""
    points = np.concatenate([p for _, p in found])
    laser = np.concatenate([np.full(len(p), n, np.uint8) for n, p in found])
    order = np.argsort(points["row"], kind="stable")
    points, laser = points[order], laser[order]
    n = len(points)
    return {
        "frame": np.full(n, frame, np.uint32),
        "t_ns": np.full(n, t_ns, np.int64),
        "laser": laser,
        # Within one turn, where float32 is good to 3e-7 rad.
        "angle_rad": np.full(n, math.fmod(angle_rad, math.tau), np.float32),
        **{name: points[name] for name in points.dtype.names or ()},
    }


def _derive_points(archive: Archive, plan: Plan, stripes: DerivationManifest) -> DerivationManifest:
    chain = PointChain(plan.recipe, plan.calibration)

    def parts() -> Iterable[dict[str, Any]]:
        for batch in archive.read(stripes):
            yield chain.points(columns_of(batch))

    def warnings() -> tuple[str, ...]:
        if not chain.dropped:
            return ()
        return (f"{chain.dropped} of {stripes.rows} stripe points gave no scene point",)

    batches: Iterator[pa.RecordBatch] = record_batches(POINTS, parts())
    return archive.publish(
        batches,
        **_fields(plan, "points"),
        frames=stripes.frames,
        frames_without_stripe=stripes.frames_without_stripe,
        warnings=warnings,
    )


def _fields(plan: Plan, kind: str) -> dict[str, Any]:
    stripes = kind == "stripes"
    stages = plan.recipe.frame_stages() if stripes else plan.recipe.point_stages()
    return {
        "kind": kind,
        "key": plan.stripes_key if stripes else plan.points_key,
        "scan": plan.scan.scan,
        "content_sha256": plan.scan.content_sha256,
        "recipe": plan.recipe.recipe_id(),
        "recipe_document": plan.recipe.plain(),
        "calibration": None if stripes else plan.calibration.calibration_id(),
        "parts": plan.stripes_parts if stripes else plan.points_parts,
        "upstream": () if stripes else (plan.stripes_key,),
        "stages": stage_records(stages),
    }
