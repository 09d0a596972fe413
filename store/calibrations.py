"""The calibrations of an archive, and which one holds for a scan.

``current`` is the newest certification of the scan's rig that covers the scan's start and was not
withdrawn, else the snapshot in the log. ``recorded`` is that snapshot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ..schemas.archive_events import Certified, parse_archive_event
from ..schemas.calibration import Calibration, parse_calibration
from ..schemas.document import dump_json
from ..schemas.errors import CalibrationError
from . import layout
from .bytes import LocalFolder
from .catalog import Catalog, Row
from .fold import standing_certifications
from .names import calibration_word
from .projection import put_calibration, read_calibration


class Dated(Protocol):
    """What decides which calibration holds: a scan summary, or what is known of one in the making."""

    @property
    def scan(self) -> str:
        """The scan's id."""

    @property
    def rig(self) -> str:
        """The rig's name."""

    @property
    def started_ns(self) -> int:
        """When it began."""

    @property
    def calibration(self) -> str | None:
        """Id of the calibration recorded with it."""


@dataclass(frozen=True)
class Effective:
    """A calibration and why it is the one."""

    calibration: Calibration
    why: str


class Calibrations:
    """Content-addressed documents and the certifications that stand."""

    def __init__(self, store: LocalFolder, catalog: Catalog) -> None:
        self._store = store
        self._catalog = catalog
        self._known: dict[str, Calibration] = {}
        self._standing: list[Certified] | None = None

    def add(self, calibration: Calibration) -> str:
        """Keep a document under its content id."""
        name = calibration.calibration_id()
        self._store.put_if_absent(layout.calibration_file(name), dump_json(calibration.plain()))
        self._catalog.enter(lambda c: put_calibration(c, calibration))
        return name

    def rows(self) -> list[Row]:
        """Rows of the catalogue, by id."""
        return self._catalog.rows("SELECT * FROM calibrations ORDER BY calibration")

    def get(self, word: str) -> Calibration:
        """The document that ``word`` names, read from its file and checked against its id."""
        return read_calibration(self._store, calibration_word(word, self.rows()))

    def forget(self) -> None:
        """Events changed: read them again when asked."""
        self._standing = None

    def standing(self) -> list[Certified]:
        """Certifications that were not withdrawn, oldest first."""
        if self._standing is None:
            rows = self._catalog.rows(
                "SELECT event, document FROM events WHERE kind IN ('certified', 'withdrawn')"
            )
            events = [parse_archive_event(r["document"].encode(), where=r["event"]) for r in rows]
            self._standing = standing_certifications(events)
        return self._standing

    def certified(self, name: str, rig: str | None) -> list[Certified]:
        """Standing certifications of one calibration; a CalibrationError if there are none."""
        found = [e for e in self.standing() if e.calibration == name and rig in (None, e.rig)]
        if not found:
            raise CalibrationError(
                f"calibration {name} is not certified" + (f" for rig {rig!r}" if rig else ""),
                hint="turnscan calibration list shows which are",
            )
        return found

    def effective(self, scan: Dated, choice: str) -> Effective:
        """The calibration that holds for ``scan``: ``current``, ``recorded``, or an id.

        Raises
        ------
        CalibrationError
            None holds.
        """
        if choice == "current":
            fitting = [e for e in self.standing() if e.rig == scan.rig and e.covers(scan.started_ns)]
            if fitting:
                newest = fitting[-1]
                return Effective(self._cached(newest.calibration), f"certified by {newest.id}")
        if choice in ("current", "recorded"):
            if scan.calibration is None:
                raise none_holds(scan, choice)
            return Effective(self._cached(scan.calibration), "recorded in the log")
        return Effective(self.get(choice), "named")

    def _cached(self, name: str) -> Calibration:
        """By id, from the catalogue, so that planning opens no file."""
        if name not in self._known:
            rows = self._catalog.rows(
                "SELECT document FROM calibrations WHERE calibration = ?", (name,)
            )
            self._known[name] = (
                parse_calibration(rows[0]["document"], where=name)
                if rows
                else read_calibration(self._store, name)
            )
        return self._known[name]


def none_holds(scan: Dated, choice: str) -> CalibrationError:
    """The error for a scan that no calibration holds for."""
    if choice == "recorded":
        return CalibrationError(
            f"scan {scan.scan} was recorded without a calibration",
            hint="use --calibration current or name one (turnscan calibration list)",
        )
    return CalibrationError(
        f"no calibration holds for scan {scan.scan} of rig {scan.rig!r}",
        hint=f"turnscan calibration add FILE --certify --rig {scan.rig}, or process --calibration ID",
    )
