"""Plan what a recipe means for scans, derive what is missing, publish it: where process meets store.

One scan is one task: its log is read once, frames stream through the stages one by one into STRIPES,
and the rows of STRIPES into POINTS; both are sealed at the end. A recalibration makes POINTS of sealed
STRIPES. The result does not depend on the workers, nor on their threads.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError, InputError, TurnscanError
from ..schemas.key import stripes_key
from ..schemas.manifests import DerivationManifest, ScanSummary
from ..schemas.recipe import Recipe
from ..schemas.tables import POINTS, STRIPES
from ..store import Archive
from ..store.derivations import TableDraft
from ..store.log_digest import LogFacts
from ..store.log_follow import GrowingLog
from ..store.plan import Plan, stage_records
from .batches import columns_of, record_batches
from .finding import FrameSource, StripeFinder
from .stages import PointChain, check_size
from .striping import Tally, stripe_parts
from .workers import in_processes

if TYPE_CHECKING:
    import pyarrow as pa

LOG = logging.getLogger("turnscan")

Advance = Callable[[int, int], None]


@dataclass(frozen=True)
class LiveStart:
    """What is known of a scan when its recording begins, and what shall be derived of it.

    ``calibration`` is the one that holds now (None: none does); ``choice`` how it was chosen.
    ``width_px``, ``height_px`` and ``encoding`` are what the camera says of its frames.
    """

    scan: str
    camera: str
    recipe: Recipe
    calibration: Calibration | None
    width_px: int
    height_px: int
    encoding: str = "mono8"
    choice: str = "current"


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


#: Small scans go into the catalogue together, so that it is not written more often than this.
_ENTER_EVERY_S: Final = 0.25
#: Threads that decompress and extract beside the one that gathers: with more, their Python waits for
#: each other.
_THREADS: Final = 1


def derive(
    archive: Archive,
    scans: Sequence[ScanSummary],
    recipe: Recipe,
    calibration: str = "current",
    *,
    workers: int = 1,
    overlap: bool | None = None,
    advance: Advance | None = None,
) -> Iterator[Outcome]:
    """Derive what is missing of ``recipe`` on ``scans``; outcomes in the order of ``scans``.

    ``workers`` above 1 uses that many processes, a scan each. ``overlap`` lets threads decompress
    ahead, extract what is slow and write behind; by default where the workers leave cores to them.
    Neither changes a byte of the result. A scan that fails gives an outcome with its error and stops
    none of the others.
    """
    if overlap is None:
        overlap = 2 * workers <= (os.cpu_count() or 1)
    total = sum(s.frames for s in scans)
    done = 0

    def step(frames: int) -> None:
        if advance is not None:
            advance(done + frames, total)

    plans = archive.plan(scans, recipe, calibration)
    made: list[DerivationManifest] = []
    if workers > 1 and len(scans) > 1:
        jobs = [(archive.root, s, p, overlap) for s, p in zip(scans, plans, strict=True)]
        outcomes = _from_workers(min(workers, len(jobs)), jobs, made)
    else:
        outcomes = (_one(archive, s, p, overlap, made, step) for s, p in zip(scans, plans, strict=True))
    waiting: list[Outcome] = []
    entered_at = -math.inf
    try:
        for scan, outcome in zip(scans, outcomes, strict=True):
            done += scan.frames
            step(0)
            waiting.append(outcome)
            if time.monotonic() - entered_at >= _ENTER_EVERY_S:
                _enter(archive, made)
                yield from waiting
                waiting.clear()
                entered_at = time.monotonic()
    finally:
        # Whatever ended it: what was published is known.
        _enter(archive, made)
    yield from waiting


def _enter(archive: Archive, made: list[DerivationManifest]) -> None:
    if made:
        archive.enter(made)
        made.clear()


def _one(
    archive: Archive,
    scan: ScanSummary,
    plan: Plan | TurnscanError,
    overlap: bool,
    made: list[DerivationManifest],
    step: Callable[[int], None] | None = None,
) -> Outcome:
    if isinstance(plan, TurnscanError):
        return Outcome(scan.scan, error=plan)
    try:
        return derive_scan(archive, plan, made, overlap, step)
    except TurnscanError as error:
        return Outcome(scan.scan, error=error)


@cache
def _archive(root: Path) -> Archive:
    """The archive of this worker process: opened once, not for each of a thousand small scans."""
    return Archive.open(root)


def _in_worker(
    root: Path, scan: ScanSummary, plan: Plan | TurnscanError, overlap: bool
) -> tuple[Outcome, list[DerivationManifest]]:
    """The outcome, and what was published."""
    made: list[DerivationManifest] = []
    try:
        return _one(_archive(root), scan, plan, overlap, made), made
    except TurnscanError as error:
        return Outcome(scan.scan, error=error), made


def _from_workers(
    workers: int, jobs: list[tuple[Any, ...]], made: list[DerivationManifest]
) -> Iterator[Outcome]:
    for outcome, published in in_processes(workers, _in_worker, jobs):
        made += published
        yield outcome


def derive_scan(
    archive: Archive,
    plan: Plan,
    made: list[DerivationManifest],
    overlap: bool = True,
    step: Callable[[int], None] | None = None,
) -> Outcome:
    """Derive and publish what ``plan`` finds missing; ``overlap`` as in :func:`derive`.

    What was published is added to ``made``, for the catalogue.

    Raises
    ------
    TurnscanError
        The log, the calibration or the recipe do not allow it, or the disk refuses; nothing
        half-done is published.
    """
    if plan.done:
        return Outcome(plan.scan.scan)
    began = time.monotonic()
    LOG.info("%s: calibration %s, %s", plan.scan.scan, plan.calibration_id, plan.why_calibration)
    reasons = archive.why_missing(plan)
    check_size(plan.calibration.intrinsics_or_fail(), plan.scan.width_px, plan.scan.height_px)
    if plan.stripes is None:
        stripes, points = _derive_from_log(archive, plan, made, overlap, step)
    else:
        stripes = plan.stripes
        points = plan.points or _derive_points(archive, plan, stripes, overlap)
        if plan.points is None:
            made.append(points)
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


def _derive_from_log(
    archive: Archive,
    plan: Plan,
    made: list[DerivationManifest],
    overlap: bool,
    step: Callable[[int], None] | None,
) -> tuple[DerivationManifest, DerivationManifest]:
    """STRIPES, and POINTS of the very rows that STRIPES hold, while the log is read once."""
    tally = Tally()

    def advance(now: Tally) -> None:
        if step is not None:
            step(now.frames)

    finder = StripeFinder(plan.recipe, plan.calibration, _source_of(plan.scan))
    log = archive.log(plan.scan.scan)
    items = log.items(ahead=_THREADS, each=finder) if overlap else log.items()
    parts = stripe_parts(items, finder, tally, advance)
    with (
        archive.draft("stripes", behind=overlap) as stripes,
        archive.draft("points", behind=overlap) as draft,
    ):
        points = _Points(plan, draft)
        for batch in record_batches(STRIPES, parts):
            stripes.take(batch)
            points.take(batch)
        stripes.finish({**_fields(plan, "stripes"), **tally.fields()})
        points.finish(tally.frames, tally.empty, stripes.rows)
        made.append(stripes.publish())
        made.append(draft.publish())
    return made[-2], made[-1]


class _Points:
    """POINTS of batches of STRIPES, into a draft."""

    def __init__(self, plan: Plan, draft: TableDraft) -> None:
        self._plan = plan
        self._draft = draft
        self._chain = PointChain(plan.recipe, plan.calibration)

    def take(self, stripes: pa.RecordBatch) -> None:
        columns = self._chain.points(columns_of(stripes))
        for batch in record_batches(POINTS, [columns]):
            self._draft.take(batch)

    def finish(self, frames: int, without_stripe: int, stripes: int) -> None:
        """All ``stripes`` rows of so many frames were taken."""
        lost = self._chain.dropped
        told = (f"{lost} of {stripes} stripe points gave no scene point",) if lost else ()
        self._draft.finish(
            {
                **_fields(self._plan, "points"),
                "frames": frames,
                "frames_without_stripe": without_stripe,
                "warnings": told,
            }
        )


def _source_of(scan: ScanSummary) -> FrameSource:
    if len(scan.cameras) > 1:
        raise InputError(
            f"scan {scan.scan} has {len(scan.cameras)} cameras, a calibration has one",
            hint="record or import each camera as a scan of its own",
        )
    return FrameSource(scan.scan, scan.cameras[0], (scan.width_px, scan.height_px))


def derive_growing(
    root: Path,
    part: Path,
    start: LiveStart,
    *,
    finished: Callable[[float], bool],
    seal: Callable[[LogFacts, str], None],
    advance: Callable[[Tally], None],
) -> Outcome:
    """Derive STRIPES of a log while it is written, publish them once it is sealed, then POINTS.

    ``finished`` says when the log ``part`` is whole (:class:`GrowingLog`). ``seal`` is called with
    its facts and SHA-256, and returns when the scan is sealed and in the catalogue; only then the key
    is known. The rows come from the code that :func:`derive` runs: the table is the one it would make.

    Raises
    ------
    TurnscanError
        As :func:`derive_scan`; also if what was sealed is not what was derived (another calibration
        holds by now): then nothing is published, and :func:`derive` does it all.
    """
    archive = Archive.open(root)
    growing = GrowingLog(part, finished)
    tally = Tally()
    began = time.monotonic()
    source = FrameSource(start.scan, start.camera)
    finder = StripeFinder(start.recipe, start.calibration, source)
    parts = stripe_parts(growing.items(), finder, tally, advance)
    with archive.draft("stripes", behind=False) as draft:
        for batch in record_batches(STRIPES, parts):
            draft.take(batch)
        seal(growing.facts(), growing.log_sha256())
        plan = next(archive.plan([archive.scan(start.scan)], start.recipe, start.choice))
        if isinstance(plan, TurnscanError):
            raise plan
        _check_live(plan, start, source)
        draft.finish({**_fields(plan, "stripes"), **tally.fields()})
        stripes = draft.publish()
    archive.enter([stripes])
    LOG.info("%s: stripes sealed", plan.scan.scan)
    points = _derive_points(archive, plan, stripes, overlap=False)
    archive.enter([points])
    return Outcome(
        scan=plan.scan.scan,
        derived=("stripes", "points"),
        points=points.rows,
        frames=stripes.frames,
        frames_without_stripe=stripes.frames_without_stripe,
        seconds=time.monotonic() - began,
        warnings=(*stripes.warnings, *points.warnings),
    )


def _check_live(plan: Plan, start: LiveStart, source: FrameSource) -> None:
    """What entered the live table must be what its key says."""
    live, _ = stripes_key(
        plan.recipe,
        content_sha256=plan.scan.content_sha256,
        calibration=start.calibration,
        lasers=plan.scan.lasers,
    )
    sealed = _source_of(plan.scan)
    if live != plan.stripes_key or sealed.camera != source.camera:
        raise CalibrationError(
            f"scan {plan.scan.scan}: another calibration holds than when it began",
            hint=f"turnscan process {plan.scan.scan}",
        )
    if source.size is not None and source.size != sealed.size:
        raise InputError(f"scan {plan.scan.scan}: its first frame has another size than the others")
    check_size(plan.calibration.intrinsics_or_fail(), plan.scan.width_px, plan.scan.height_px)


def _derive_points(
    archive: Archive, plan: Plan, stripes: DerivationManifest, overlap: bool
) -> DerivationManifest:
    """POINTS of sealed STRIPES."""
    with archive.draft("points", behind=overlap) as draft:
        points = _Points(plan, draft)
        for batch in archive.read(stripes):
            points.take(batch)
        points.finish(stripes.frames, stripes.frames_without_stripe, stripes.rows)
        return draft.publish()


def _fields(plan: Plan, kind: str) -> dict[str, Any]:
    stripes = kind == "stripes"
    stages = plan.recipe.frame_stages() if stripes else plan.recipe.point_stages()
    return {
        "key": plan.stripes_key if stripes else plan.points_key,
        "scan": plan.scan.scan,
        "content_sha256": plan.scan.content_sha256,
        "recipe": plan.recipe_id,
        "recipe_document": plan.recipe.plain(),
        "calibration": None if stripes else plan.calibration_id,
        "parts": plan.stripes_parts if stripes else plan.points_parts,
        "upstream": () if stripes else (plan.stripes_key,),
        "stages": stage_records(stages),
    }
