"""catalog.sqlite: a projection of scans, calibrations, events and derivations, for fast answers.

It is never the truth: delete it and it is made again from the files. Planning opens it read-only. What
was copied in or removed is noticed by the names in scans/, calibrations/ and events/.
"""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from ..schemas.errors import StorageError, TurnscanError

#: Raised when the tables below change: an older file is made again.
CATALOG_VERSION = 2

_TABLES = """
CREATE TABLE scans (
    scan TEXT PRIMARY KEY, rig TEXT NOT NULL, label TEXT NOT NULL, tags TEXT NOT NULL,
    retired INTEGER NOT NULL, source TEXT NOT NULL, started_ns INTEGER NOT NULL,
    ended_ns INTEGER NOT NULL, ended TEXT NOT NULL, frames INTEGER NOT NULL,
    background_frames INTEGER NOT NULL, cameras TEXT NOT NULL, lasers TEXT NOT NULL,
    width_px INTEGER NOT NULL, height_px INTEGER NOT NULL, encoding TEXT NOT NULL,
    angle_min_rad REAL NOT NULL, angle_max_rad REAL NOT NULL, calibration TEXT,
    content_sha256 TEXT NOT NULL, frames_sha256 TEXT NOT NULL, log_bytes INTEGER NOT NULL,
    continues TEXT, document TEXT NOT NULL);
CREATE INDEX scans_by_frames ON scans (frames_sha256);
CREATE INDEX scans_by_continues ON scans (continues) WHERE continues IS NOT NULL;
CREATE TABLE calibrations (
    calibration TEXT PRIMARY KEY, rig TEXT NOT NULL, note TEXT NOT NULL, verdict TEXT NOT NULL,
    sha256 TEXT NOT NULL, document TEXT NOT NULL);
CREATE TABLE calibration_parts (
    calibration TEXT NOT NULL, role TEXT NOT NULL, part TEXT NOT NULL,
    PRIMARY KEY (calibration, role));
CREATE TABLE events (
    event TEXT PRIMARY KEY, kind TEXT NOT NULL, t_ns INTEGER NOT NULL, document TEXT NOT NULL);
CREATE TABLE derivations (
    key TEXT NOT NULL, kind TEXT NOT NULL, scan TEXT NOT NULL, recipe TEXT NOT NULL,
    recipe_name TEXT NOT NULL, calibration TEXT, rows INTEGER NOT NULL, bytes INTEGER NOT NULL,
    sha256 TEXT NOT NULL, path TEXT NOT NULL, frames INTEGER NOT NULL,
    frames_without_stripe INTEGER NOT NULL, created_ns INTEGER NOT NULL, document TEXT NOT NULL,
    PRIMARY KEY (key, scan));
CREATE INDEX derivations_by_scan ON derivations (scan, kind);
"""
TABLE_NAMES = ("scans", "calibrations", "calibration_parts", "events", "derivations")

_ATTEMPTS = 8

Row = dict[str, Any]
Answer = TypeVar("Answer")


class CatalogError(TurnscanError):
    """The catalogue is missing, of another version, or broken: it must be made again."""

    slug = "catalog"


class Catalog:
    """The file ``path``, which need not exist yet.

    ``remake`` makes it again from the archive's files; it is called when a query or an entry finds no
    catalogue that can be used, because somebody deleted it or a newer one is wanted.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.remake: Callable[[], None] | None = None

    @contextmanager
    def _shared(self, *, alone: bool) -> Iterator[None]:
        """Writers hold the archive's folder together; who replaces the file holds it ``alone``.

        Without this a catalogue that is replaced would take the entries of writers with it.
        """
        handle = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
            yield
        finally:
            os.close(handle)

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """A read-only connection: nothing on disk is touched.

        Raises
        ------
        CatalogError
            There is no catalogue that this program can use.
        """
        try:
            if self._journal.exists():
                self._roll_back()
            with closing(sqlite3.connect(f"{self.path.as_uri()}?mode=ro", uri=True, timeout=30)) as c:
                c.row_factory = sqlite3.Row
                self._check_version(c)
                yield c
        except sqlite3.DatabaseError as error:
            raise self._broken(error) from error

    @property
    def _journal(self) -> Path:
        return self.path.with_name(f"{self.path.name}-journal")

    def _roll_back(self) -> None:
        """Undo what a writer that was killed left half-done; a reader that only reads could not."""
        if not self.path.exists():
            return
        with closing(sqlite3.connect(f"{self.path.as_uri()}?mode=rw", uri=True, timeout=30)) as c:
            c.execute("SELECT count(*) FROM sqlite_master").fetchone()

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction that holds off other writers from its start.

        Raises
        ------
        CatalogError
            There is no catalogue that this program can use.
        """
        if not self.path.exists():
            raise CatalogError(f"{self.path} does not exist")
        try:
            with self._shared(alone=False), self._transaction(self.path) as c:
                self._check_version(c)
                yield c
        except sqlite3.DatabaseError as error:
            raise self._broken(error) from error

    @contextmanager
    def _transaction(self, path: Path) -> Iterator[sqlite3.Connection]:
        with closing(sqlite3.connect(path, timeout=60, isolation_level=None)) as c:
            c.row_factory = sqlite3.Row
            c.execute("BEGIN IMMEDIATE")
            try:
                yield c
                c.execute("COMMIT")
            except BaseException:
                if c.in_transaction:
                    c.execute("ROLLBACK")
                raise

    @contextmanager
    def replacing(self, aside: Path) -> Iterator[sqlite3.Connection]:
        """Fill a fresh catalogue at ``aside``, which then takes the place of the old one."""
        try:
            with self._shared(alone=True):
                with self._transaction(aside) as c:
                    create_tables(c)
                    yield c
                # Nobody writes now, so a journal is that of a writer that was killed: SQLite would
                # roll it back into the new file.
                self._journal.unlink(missing_ok=True)
                aside.replace(self.path)
        except sqlite3.DatabaseError as error:
            raise self._broken(error) from error

    def _check_version(self, c: sqlite3.Connection) -> None:
        if c.execute("PRAGMA user_version").fetchone()[0] != CATALOG_VERSION:
            raise CatalogError(f"{self.path} has another version")

    def _broken(self, error: sqlite3.DatabaseError) -> TurnscanError:
        if isinstance(error, sqlite3.OperationalError) and "full" in str(error):
            return StorageError(f"{self.path}: the disk is full", hint="free some space")
        if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
            return StorageError(f"{self.path}: {error}", hint="another process is busy with it: again")
        return CatalogError(f"{self.path}: {error}", hint="delete it: it is made again from the files")

    def ask(self, question: Callable[[sqlite3.Connection], Answer]) -> Answer:
        """The answer of the catalogue, which is made again first if it cannot be used."""
        for _ in range(_ATTEMPTS):
            try:
                with self.reading() as c:
                    return question(c)
            except CatalogError:
                if self.remake is None:
                    raise
            # Others may delete it again while it is made: a few times are no reason to give up.
            self.remake()
        with self.reading() as c:
            return question(c)

    def enter(self, entry: Callable[[sqlite3.Connection], None]) -> None:
        """Enter what was published; a catalogue that cannot be used is made again, entry included."""
        try:
            with self.writing() as c:
                entry(c)
        except CatalogError:
            if self.remake is None:
                raise
            self.remake()

    def rows(self, sql: str, values: Sequence[Any] = ()) -> list[Row]:
        """All rows of one query."""
        return self.ask(lambda c: [dict(r) for r in c.execute(sql, values)])

    def dump(self) -> dict[str, list[Row]]:
        """The whole content, ordered, for comparison."""
        return {name: self.rows(f"SELECT * FROM {name} ORDER BY 1, 2, 3") for name in TABLE_NAMES}


def create_tables(c: sqlite3.Connection) -> None:
    """Make the tables, inside the caller's transaction."""
    for statement in _TABLES.split(";"):
        if statement.strip():
            c.execute(statement)
    c.execute(f"PRAGMA user_version = {CATALOG_VERSION}")


def put(c: sqlite3.Connection, table: str, row: Row) -> None:
    """Insert or replace ``row``; lists and dicts are stored as JSON."""
    names = list(row)
    values = [
        json.dumps(v, sort_keys=True, ensure_ascii=False) if isinstance(v, (list, dict, tuple)) else v
        for v in row.values()
    ]
    marks = ", ".join("?" * len(names))
    c.execute(f"INSERT OR REPLACE INTO {table} ({', '.join(names)}) VALUES ({marks})", values)


def remove(c: sqlite3.Connection, table: str, column: str, values: Iterable[str]) -> None:
    """Delete the rows whose ``column`` is one of ``values``."""
    c.executemany(f"DELETE FROM {table} WHERE {column} = ?", [(v,) for v in values])
