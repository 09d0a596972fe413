"""The archive: one folder, opened once, that everything on disk is reached through."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..schemas.archive_events import (
    AnyArchiveEvent,
    Certified,
    Restored,
    Retired,
    Tagged,
    Withdrawn,
    parse_archive_event,
)
from ..schemas.calibration import Calibration
from ..schemas.document import dump_json
from ..schemas.errors import CalibrationError, TurnscanError
from ..schemas.ids import new_ulid
from ..schemas.manifests import (
    ArchiveSettings,
    DerivationManifest,
    Kind,
    ScanSummary,
)
from ..schemas.recipe import Recipe, built_in_recipe
from . import layout
from .bytes import LocalFolder
from .calibrations import Calibrations, Dated, Effective
from .catalog import Catalog, Row, put
from .certifying import Certifying, Change, changes, consider, scans_of_rig
from .derivations import TableDraft, drafting, read_batches
from .drafts import ScanDraft
from .log_digest import LogFacts
from .log_reader import ScanLog
from .names import chain_of, scan_word
from .opening import make_folder, nearest_archive, read_settings
from .plan import KeyMaker, Keys, Plan, what_changed, why_stale
from .projection import (
    derivation_row,
    event_row,
    rebuild,
    refold,
    scan_row,
    synchronise,
)
from .timeline import Entry, timeline

if TYPE_CHECKING:
    import polars as pl
    import pyarrow as pa

#: Scans whose derivations are looked up in the catalogue at once.
_PLANNED_TOGETHER = 256


class Archive:
    """An archive on disk (docs/format.md). Make one with :meth:`init`, open it with :meth:`open`."""

    def __init__(self, root: Path, settings: ArchiveSettings) -> None:
        self.root = root
        self.settings = settings
        self.store = LocalFolder(root)
        self.catalog = Catalog(root / layout.CATALOG)
        self.catalog.remake = self.rebuild_catalog
        synchronise(self.store, self.catalog)
        self._calibrations = Calibrations(self.store, self.catalog)

    # -- opening ----------------------------------------------------------------------------------

    @classmethod
    def init(cls, folder: str | Path, *, recipe: str = "default") -> Archive:
        """Make a new archive in ``folder``, which must be empty or not exist.

        Raises
        ------
        ConflictError
            The folder holds something already.
        """
        return cls(*make_folder(Path(folder).absolute(), recipe))

    @classmethod
    def open(cls, folder: str | Path) -> Archive:
        """The archive in ``folder``.

        Raises
        ------
        NotFoundError
            There is none.
        FormatVersionError
            It was made by a newer turnscan.
        """
        root = Path(folder).absolute()
        return cls(root, read_settings(root))

    @classmethod
    def find(cls, start: str | Path = ".") -> Archive:
        """The archive in ``start`` or the nearest folder above it."""
        return cls.open(nearest_archive(Path(start).absolute()))

    def recipe(self) -> Recipe:
        """The archive's default recipe."""
        return built_in_recipe(self.settings.recipe)

    # -- scans ------------------------------------------------------------------------------------

    def new_scan(self, *, keep_part: bool = False) -> ScanDraft:
        """A draft to write a log into; see :class:`ScanDraft`."""
        return ScanDraft(self.store, keep_part=keep_part)

    def seal(self, draft: ScanDraft, facts: LogFacts, log_sha256: str | None = None) -> ScanSummary:
        """Make ``draft`` a scan for good and enter it in the catalogue."""
        if facts.calibration is not None:
            # First, so that a sealed scan never names a calibration that is not there.
            self._calibrations.add(facts.calibration)
        summary = draft.seal(facts, log_sha256)

        def enter(c: sqlite3.Connection) -> None:
            put(c, "scans", scan_row(summary))
            refold(c, summary.scan)

        self.catalog.enter(enter)
        return summary

    def same_content(self, frames_sha256: str) -> str | None:
        """A scan with the same frames, angles and lasers, if there is one."""
        rows = self.catalog.rows(
            "SELECT scan FROM scans WHERE frames_sha256 = ? ORDER BY scan", (frames_sha256,)
        )
        return str(rows[0]["scan"]) if rows else None

    def scan_rows(self, *, where: str | None = None, retired: bool = False) -> list[Row]:
        """Rows of the catalogue's scans, oldest first; ``where`` is SQL over their columns."""
        import json

        from .catalog_where import select_scans

        rows = self.catalog.ask(lambda c: select_scans(c, where=where, retired=retired))
        for row in rows:
            for name in ("tags", "cameras", "lasers"):
                row[name] = json.loads(row[name])
            row["retired"] = bool(row["retired"])
        return rows

    def scan(self, word: str) -> ScanSummary:
        """The scan that ``word`` names: an id, a unique prefix, a label, or ``latest``."""
        row = scan_word(word, self.scan_rows(retired=True))
        return ScanSummary.model_validate_json(row["document"])

    def scans(self, *, where: str | None = None) -> list[ScanSummary]:
        """Summaries of all scans that are not retired, oldest first."""
        return [ScanSummary.model_validate_json(r["document"]) for r in self.scan_rows(where=where)]

    def log(self, scan: str) -> ScanLog:
        """The log of a scan."""
        return ScanLog(self.store.local(layout.scan_file(scan, layout.LOG)))

    def chain(self, scan: str) -> list[ScanSummary]:
        """The logs of one scan that was resumed, oldest first; of any other, that log alone.

        Logs that were retired are left out, but for ``scan`` itself.
        """
        names = chain_of(scan, self.catalog.rows("SELECT scan, continues FROM scans"))
        living = {r["scan"] for r in self.scan_rows()} | {scan}
        return [self.scan(n) for n in names if n in living]

    # -- events -----------------------------------------------------------------------------------

    def record_event(self, kind: type[AnyArchiveEvent], **fields: Any) -> AnyArchiveEvent:
        """Write one archive event as a file of its own and fold it into the catalogue."""
        t_ns = time.time_ns()
        newest = self.catalog.rows("SELECT max(event) AS event FROM events")[0]["event"]
        name = new_ulid()
        # Clocks step back; an event of this archive still comes after those it can see.
        while newest is not None and name <= newest:
            name = _ulid_after(newest)
        event = kind(id=name, t_ns=t_ns, **fields).sealed()
        self.store.put_if_absent(layout.event_file(name), dump_json(event.plain()))

        def enter(c: sqlite3.Connection) -> None:
            put(c, "events", event_row(event))
            # What is certified is folded when it is asked for; other events are about one scan.
            if isinstance(event, (Tagged, Retired, Restored)):
                refold(c, event.scan)

        self.catalog.enter(enter)
        self._calibrations.forget()
        return event

    def events(self, kind: str | None = None) -> list[AnyArchiveEvent]:
        """Archive events, oldest first."""
        sql = "SELECT event, document FROM events"
        rows = self.catalog.rows(
            f"{sql} WHERE kind = ? ORDER BY event" if kind else f"{sql} ORDER BY event",
            (kind,) if kind else (),
        )
        return [parse_archive_event(r["document"].encode(), where=r["event"]) for r in rows]

    def tag(self, scan: str, tags: dict[str, str], label: str | None = None) -> None:
        """Set tags (an empty value removes one) and label of a scan."""
        self.record_event(Tagged, scan=self.scan(scan).scan, tags=tags, label=label)

    def retire(self, scan: str, *, back: bool = False, note: str = "") -> None:
        """Take a scan out of use, or back into it. Nothing is deleted."""
        self.record_event(Restored if back else Retired, scan=self.scan(scan).scan, note=note)

    # -- calibrations -----------------------------------------------------------------------------

    def add_calibration(self, calibration: Calibration) -> str:
        """Keep a calibration under its content id, which is returned; adding it again is nothing."""
        return self._calibrations.add(calibration)

    def calibration(self, word: str) -> Calibration:
        """The calibration that ``word`` names: an id or a unique prefix of one."""
        return self._calibrations.get(word)

    def calibration_rows(self) -> list[Row]:
        """Rows of the catalogue's calibrations, by id."""
        return self._calibrations.rows()

    def would_certify(
        self,
        word: str | Calibration,
        *,
        rig: str | None = None,
        from_ns: int | None = None,
        to_ns: int | None = None,
    ) -> Certifying:
        """What :meth:`certify` would mean: objections, overlaps, scans that change."""
        calibration = self.calibration(word) if isinstance(word, str) else word
        return consider(
            self.catalog,
            self.certifications(),
            calibration,
            rig=rig or calibration.rig,
            from_ns=from_ns,
            to_ns=to_ns,
        )

    def certify(
        self,
        word: str,
        *,
        rig: str | None = None,
        from_ns: int | None = None,
        to_ns: int | None = None,
        note: str = "",
        reason: str | None = None,
    ) -> Certified:
        """State that a calibration holds for a rig (its own by default) over [from_ns, to_ns).

        An equal certification that holds already is returned as it stands. ``reason`` certifies in
        spite of objections; both are kept in the event.

        Raises
        ------
        CalibrationError
            Something speaks against it (a failed acceptance limit, an unknown rig, scans with frames
            of another size), and no ``reason`` is given. Nothing is written.
        """
        meant = self.would_certify(word, rig=rig, from_ns=from_ns, to_ns=to_ns)
        if meant.standing is not None:
            return meant.standing
        name = meant.calibration.calibration_id()
        meant.check(reason)
        event = self.record_event(
            Certified,
            calibration=name,
            rig=meant.rig,
            from_ns=from_ns,
            to_ns=to_ns,
            note=note,
            objections=meant.objections or None,
            reason=reason or None,
        )
        assert isinstance(event, Certified)
        return event

    def would_withdraw(self, word: str, *, rig: str | None = None) -> tuple[Change, ...]:
        """The scans whose effective calibration :meth:`withdraw` would change. Writes nothing."""
        name = self.calibration(word).calibration_id()
        gone = {e.id for e in self._calibrations.certified(name, rig)}
        standing = self.certifications()
        left = [e for e in standing if e.id not in gone]
        out: list[Change] = []
        for each in sorted({e.rig for e in standing if e.id in gone}):
            out += changes(scans_of_rig(self.catalog, each), each, standing, left)
        return tuple(out)

    def withdraw(self, word: str, *, rig: str | None = None, note: str = "") -> list[Withdrawn]:
        """Take back every standing certification of a calibration (for ``rig``, if given)."""
        name = self.calibration(word).calibration_id()
        out = []
        for standing in self._calibrations.certified(name, rig):
            event = self.record_event(Withdrawn, calibration=name, after=standing.id, note=note)
            assert isinstance(event, Withdrawn)
            out.append(event)
        return out

    def timeline(self) -> dict[str, list[Entry]]:
        """Rig -> its certifications and when each of them holds, withdrawn ones included."""
        return timeline(self.events())

    def certifications(self) -> list[Certified]:
        """Certifications that stand, oldest first."""
        return self._calibrations.standing()

    def effective(self, scan: Dated, choice: str = "current") -> Effective:
        """The calibration that holds for ``scan``: ``current``, ``recorded``, or an id."""
        return self._calibrations.effective(scan, choice)

    # -- derivations ------------------------------------------------------------------------------

    def derivations(self, scan: str | None = None) -> list[DerivationManifest]:
        """Manifests of all derivations, or of one scan's."""
        sql = "SELECT document FROM derivations"
        rows = self.catalog.rows(
            f"{sql} WHERE scan = ? ORDER BY key" if scan else f"{sql} ORDER BY key",
            (scan,) if scan else (),
        )
        return [DerivationManifest.model_validate_json(r["document"]) for r in rows]

    def plan(
        self, scans: Sequence[ScanSummary], recipe: Recipe, choice: str = "current"
    ) -> Iterator[Plan | TurnscanError]:
        """What ``recipe`` means for each scan, in order; an error where none can be made."""
        maker = KeyMaker(recipe)
        for start in range(0, len(scans), _PLANNED_TOGETHER):
            some = scans[start : start + _PLANNED_TOGETHER]
            wanted = [self._wanted(scan, maker, choice) for scan in some]
            found = self._found([k for w in wanted if isinstance(w, tuple) for k in w[1].both])
            for scan, want in zip(some, wanted, strict=True):
                if isinstance(want, TurnscanError):
                    yield want
                    continue
                effective, keys = want
                yield Plan(
                    scan=scan,
                    recipe=recipe,
                    recipe_id=maker.recipe_id,
                    calibration=effective.calibration,
                    calibration_id=maker.calibration_id(effective.calibration),
                    why_calibration=effective.why,
                    stripes_key=keys.stripes,
                    stripes_parts=keys.stripes_parts,
                    points_key=keys.points,
                    points_parts=keys.points_parts,
                    stripes=found.get((scan.scan, keys.stripes)),
                    points=found.get((scan.scan, keys.points)),
                )

    def _wanted(
        self, scan: ScanSummary, maker: KeyMaker, choice: str
    ) -> tuple[Effective, Keys] | TurnscanError:
        try:
            effective = self.effective(scan, choice)
            return effective, maker.keys(scan, effective.calibration)
        except TurnscanError as error:
            return error

    def _found(self, keys: Sequence[str]) -> dict[tuple[str, str], DerivationManifest]:
        """(scan, key) -> manifest of what exists of ``keys``, in one look into the catalogue."""
        marks = ", ".join("?" * len(keys))
        rows = self.catalog.rows(
            f"SELECT scan, key, path, document FROM derivations WHERE key IN ({marks})", keys
        )
        # A table that somebody deleted to win room is simply derived again.
        return {
            (r["scan"], r["key"]): DerivationManifest.model_validate_json(r["document"])
            for r in rows
            if self.store.head(r["path"]) is not None
        }

    def why_stale(self, plan: Plan) -> str:
        """In one line, which input differs from what was derived before; empty if nothing does."""
        return "" if plan.done else why_stale(plan, self.derivations(plan.scan.scan))

    def why_missing(self, plan: Plan) -> dict[str, str]:
        """Kind of what is missing -> in words, which input differs from what was derived before."""
        earlier = self.derivations(plan.scan.scan)
        return {kind: what_changed(plan, kind, earlier) for kind in plan.missing}

    def draft(self, kind: Kind, *, behind: bool) -> AbstractContextManager[TableDraft]:
        """A new derivation to be written: see :func:`store.derivations.drafting`."""
        return drafting(self.store, kind, behind=behind)

    def enter(self, manifests: Sequence[DerivationManifest]) -> None:
        """Enter derivations that were published into the catalogue."""
        rows = [derivation_row(m) for m in manifests]

        def entry(c: sqlite3.Connection) -> None:
            for row in rows:
                put(c, "derivations", row)

        self.catalog.enter(entry)

    def read(self, manifest: DerivationManifest) -> Iterator[pa.RecordBatch]:
        """Rows of a derivation, a row group at a time, page checksums compared."""
        return read_batches(self.store, manifest)

    def points(
        self, where: str | None = None, recipe: str | Recipe = "default", calibration: str = "current"
    ) -> pl.LazyFrame:
        """POINTS of the scans that ``where`` selects, under one recipe and calibration choice."""
        return self._table("points", where, recipe, calibration)

    def stripes(
        self, where: str | None = None, recipe: str | Recipe = "default", calibration: str = "current"
    ) -> pl.LazyFrame:
        """STRIPES of the scans that ``where`` selects, under one recipe and calibration choice."""
        return self._table("stripes", where, recipe, calibration)

    def _table(self, kind: str, where: str | None, recipe: str | Recipe, choice: str) -> pl.LazyFrame:
        from .frames import lazy_table

        chosen = built_in_recipe(recipe) if isinstance(recipe, str) else recipe
        made = []
        for plan in self.plan(self.scans(where=where), chosen, choice):
            if isinstance(plan, CalibrationError):
                continue  # Nothing can have been derived without a calibration.
            if isinstance(plan, TurnscanError):
                raise plan
            manifest = plan.points if kind == "points" else plan.stripes
            if manifest is not None:
                made.append(manifest)
        return lazy_table(self.store, kind, made)

    # -- keeping ----------------------------------------------------------------------------------

    def rebuild_catalog(self) -> None:
        """Make catalog.sqlite again from the files."""
        rebuild(self.store, self.catalog)


def _ulid_after(text: str) -> str:
    """The ULID that follows ``text``."""
    alphabet = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
    digits = [alphabet.index(ch) for ch in text]
    for i in range(len(digits) - 1, -1, -1):
        digits[i] += 1
        if digits[i] < len(alphabet):
            break
        digits[i] = 0
    return "".join(alphabet[d] for d in digits)
