"""The store of a lifelog: one SQLite file of recordings and reconstructed days, opened by one process at a time.

The folder ``STORE.d`` beside it has observations, copies of recordings if requested, and days that are not stored yet.
Everything except the copies can be rebuilt from the recordings. Any SQLite client may read the tables; only `Store`
writes them, one transaction per operation.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sqlite3
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

from pdr_graph.apps.lifelog.day import DAY_SCHEMA, TABLES, Day, Rows, day_of, profile_of
from pdr_graph.apps.lifelog.facts import Correction, Guess
from pdr_graph.errors import InputError, check_not_special, count
from pdr_graph.gait.walker import Profile
from pdr_graph.recovery import DataLossWarning, Kind, Row, copied, explained, open_database, write_lock
from pdr_graph.types import OneLineRepr

REMEDY = "add the recordings to a new store, pdr-graph lifelog add NEW …, or read this one with the older pdr_graph"
FACTS = (
    # what the person says of a time, from start to stop (Unix times [s]); made: Unix time; value: JSON
    """CREATE TABLE correction (number INTEGER PRIMARY KEY AUTOINCREMENT, person TEXT, made REAL, kind TEXT, start REAL,
        stop REAL, value TEXT)""",
    # what another program guessed (Google's visits and activities), kept as such; start, stop: Unix times [s]
    """CREATE TABLE guess (person TEXT, source TEXT, start REAL, stop REAL, kind TEXT, name TEXT, latitude REAL,
        longitude REAL, probability REAL, PRIMARY KEY (person, source, start, stop, kind, name))""",
)
COMPARED = "(ifnull({0}probability, -1), ifnull({0}latitude, -99), ifnull({0}longitude, -999))"
PUT_GUESS = f"""INSERT INTO guess VALUES ({", ".join("?" * 9)}) ON CONFLICT DO UPDATE SET
    probability = excluded.probability, latitude = excluded.latitude, longitude = excluded.longitude
    WHERE {COMPARED.format("excluded.")} > {COMPARED.format("guess.")}"""
SUMMED = ("setting", "phone", "recording", "correction", "guess", "day")  # with a column of checksums in version 5
STORE_SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, value TEXT)",
    "CREATE TABLE version (name TEXT PRIMARY KEY, value TEXT)",  # of the programs that built it last
    # an Entry with its options; '' for one that is not given, but NULL for begins
    """CREATE TABLE recording (hash TEXT PRIMARY KEY, person TEXT, path TEXT, plan TEXT, fixes TEXT, beacons TEXT,
        ranges TEXT, walker TEXT, floor TEXT, begins REAL, observation TEXT, epoch REAL, duration REAL, steps INTEGER,
        refusal TEXT, zone TEXT DEFAULT '')""",
    "CREATE TABLE phone (transmitter TEXT PRIMARY KEY, person TEXT)",  # owner of each transmitter in the logs of others
    *DAY_SCHEMA,
    *FACTS,
    # days that the last build could not build; said: the reason
    "CREATE TABLE failure (person TEXT, date TEXT, said TEXT, PRIMARY KEY (person, date))",
)
# Tables of a damaged lifelog that a build cannot make, and how many of their first columns are never NULL
KEPT = {"setting": 2, "recording": 3, "correction": 7, "guess": 6, "phone": 2}
ZONE = "zone"
TOGETHER = "together"
WAYS_FILE = "paths"
SOURCES = "imported: "  # and a person: the paths that were imported, JSON
# Time zone of the days, "" for that of each place; key of the last joint estimate; file of ways outdoors, "" for none
SETTINGS = {ZONE: "", TOGETHER: "", WAYS_FILE: ""}
Execute = Callable[[str, Sequence[Any]], sqlite3.Cursor]


@dataclass(frozen=True)
class RecordingOptions:
    """What is read or assumed with a recording; None: not given.

    plan: floor plan; fixes, beacons, ranges, walker: files as of `options.Options`; floor: label of the floor at the
    start; begins: Unix time of the start [s], for a recording without a date.
    """

    plan: Path | None = None
    fixes: Path | None = None
    beacons: Path | None = None
    ranges: Path | None = None
    walker: Path | None = None
    floor: str | None = None
    begins: float | None = None

    @property
    def given(self) -> dict[str, Any]:
        """The options that are given, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def files(self) -> dict[str, Path]:
        """The files that are given, by the name of the option."""
        return {name: value for name, value in self.given.items() if isinstance(value, Path)}

    def updated(self, other: RecordingOptions) -> RecordingOptions:
        """These options with those that `other` gives in their place."""
        return replace(self, **other.given)


PATH_OPTIONS = ("plan", "fixes", "beacons", "ranges", "walker")  # options that are paths


@dataclass(frozen=True)
class Entry(OneLineRepr):
    """The lifelog's entry for a recording.

    hash: of its content; person; path: of the recording; options: what is read with it.
    observation: key of the observation, "" if there is none yet; epoch: Unix time of its start [s], duration [s] and
    number of steps; zone: time zone of where it began, "" if unknown. refusal: why the last observation failed, "" if
    it succeeded.
    """

    hash: str
    person: str
    path: str
    options: RecordingOptions = RecordingOptions()
    observation: str = ""
    epoch: float | None = None
    duration: float | None = None
    steps: int | None = None
    refusal: str = ""
    zone: str = ""

    def overlaps(self, start: float, end: float) -> bool:
        """True if the recording has been observed and touches the time from `start` to `end` (Unix times [s])."""
        return self.epoch is not None and self.epoch <= end and self.epoch + (self.duration or 0.0) >= start

    @property
    def row(self) -> dict[str, Any]:
        """The entry by columns of its table."""
        options = {name: str(value) for name, value in self.options.given.items()}
        options = dict.fromkeys((*PATH_OPTIONS, "floor"), "") | options | {"begins": self.options.begins}
        return {name: value for name, value in vars(self).items() if name != "options"} | options

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Entry:
        """The entry with these columns."""
        given = {name: Path(row[name]) for name in PATH_OPTIONS if row[name]}
        options = RecordingOptions(**given, floor=row["floor"] or None, begins=row["begins"])
        names = [field.name for field in fields(cls) if field.name != "options"]
        return cls(**{name: row[name] for name in names}, options=options)

    def _summary(self) -> list[str]:
        duration = [] if self.duration is None else [f"{self.duration:.1f} s"]
        return [repr(self.person), self.path, *map(str, self.options.given), *duration, *filter(None, [self.refusal])]


@dataclass(frozen=True)
class StoredDay(OneLineRepr):
    """A stored day. key: hash of its inputs; recordings: content hashes; profile: of the walker at its end."""

    key: str
    recordings: tuple[str, ...]
    profile: Profile | None

    def _summary(self) -> list[str]:
        return [self.key[:8], count(len(self.recordings), "recording")]


class Store:
    """An open lifelog, a context manager. folder: ``STORE.d``, which may not exist."""

    def __init__(self, path: Path, new: bool = False, thorough: bool = False, reads: bool = False):
        """Open a lifelog; new: create it if it does not exist; thorough: examine all of it, which reads it once; reads:
        while another process writes, open a copy of what is stored, changes of which are lost.

        Of a damaged one the rows that can be read are recovered, but days, which a build makes again, with a
        `DataLossWarning`; the damaged file is kept beside it.
        Raises InputError if it is not a lifelog, of a newer version, damaged beyond that, in use or missing; OSError of
        the disk.
        """
        if not new and not path.exists():
            raise InputError(path, "", "no such file", "a lifelog: create it with pdr-graph lifelog add")
        self.path, self.folder = path, folder_of(path)
        check_not_special(path, "a lifelog, or a name that is not taken")
        self._lock = write_lock(path, LIFELOG, wait=not reads)
        if self._lock is None:
            self._database, loss = copied(path, LIFELOG), ""
        else:
            try:
                self._database, loss = open_database(path, LIFELOG, pages=thorough)
            except BaseException:
                os.close(self._lock)
                raise
        if loss:
            advice = f"pdr-graph lifelog add of recordings that are lost, then pdr-graph lifelog build {path}"
            warnings.warn(DataLossWarning(f"{loss}; next: {advice}"), stacklevel=2)
        self._database.execute("PRAGMA secure_delete = ON")  # deleted rows are overwritten

    def entries(self) -> tuple[Entry, ...]:
        """Entries of all recordings, ordered by hash."""
        names = [name for _, name, *_ in self._all("PRAGMA table_info(recording)")]
        rows = self._all(f"SELECT {', '.join(names)} FROM recording ORDER BY hash")
        return tuple(Entry.of_row(dict(zip(names, row, strict=True))) for row in rows)

    def setting(self, name: str) -> str:
        """Value of a setting."""
        found = self._all("SELECT value FROM setting WHERE name = ?", name)
        return found[0][0] if found else SETTINGS.get(name, "")  # lost with a damaged page

    def days(self) -> dict[tuple[str, str], StoredDay]:
        """Stored days by (person, date), in this order."""
        profiles = self._all("SELECT * FROM profile")
        days = self._all("SELECT person, date, key, recordings FROM day ORDER BY person, date")
        known, stored = dict[tuple[str, str], Profile](), dict[tuple[str, str], StoredDay]()
        for person, date, *row in profiles:
            with self._reading_day(person, date):
                known[person, date] = profile_of(row)
        for person, date, key, recordings in days:
            with self._reading_day(person, date):
                stored[person, date] = StoredDay(key, tuple(json.loads(recordings)), known.get((person, date)))
        return stored

    def day(self, person: str, date: str) -> Day | None:
        """A day of a person; None if it is not stored."""
        if not self._all("SELECT 1 FROM day WHERE person = ? AND date = ?", person, date):
            return None

        def read(table: str) -> list[Any]:
            columns = "SELECT * FROM {} WHERE person = ? AND date = ? ORDER BY rowid"
            return [row[2:] for row in self._all(columns.format(table), person, date)]

        with self._reading_day(person, date):
            return day_of(person, date, read)

    def day_hash(self, person: str, date: str) -> str:
        """Hash of the stored rows of a day."""
        return self.day_hashes(person, date, date)[date]

    def day_hashes(self, person: str, first: str = "", last: str = "9999-12-31") -> dict[str, str]:
        """Hash of the stored rows of each day of a person by date, from one date to another, both included."""
        digests = defaultdict[str, Any](hashlib.sha256)
        for table in TABLES:
            select = f"SELECT * FROM {table} WHERE person = ? AND date BETWEEN ? AND ? ORDER BY date"  # as its key
            with explained(self.path, LIFELOG):
                for row in self._database.execute(select, (person, first, last)):
                    digest = digests[row[1]]
                    digest.update(repr([value for value in row if not isinstance(value, bytes)]).encode())
                    digest.update(b"".join(value for value in row if isinstance(value, bytes)))
        return {date: digest.hexdigest() for date, digest in digests.items()}

    def failures(self) -> tuple[tuple[str, str, str], ...]:
        """Person, date and reason of each day that failed in the last build."""
        return tuple(self._all("SELECT person, date, said FROM failure ORDER BY person, date"))

    def put(self, *entries: Entry) -> None:
        """Insert or replace entries of recordings."""
        with self._transaction() as execute:
            for entry in entries:
                row = entry.row
                execute(_insert("recording", len(row), f" ({', '.join(row)})"), tuple(row.values()))

    def delete(self, *hashes: str) -> None:
        """Delete entries of recordings; the next build deletes what was made from them."""
        self._write("DELETE FROM recording WHERE hash = ?", *((name,) for name in hashes))

    def people(self) -> list[str]:
        """All persons of whom there are recordings, corrections or guesses."""
        tables = " UNION ".join(f"SELECT person FROM {table}" for table in ("recording", "correction", "guess"))
        return sorted(person for (person,) in self._all(tables))

    def guesses(self, person: str, start: float = -math.inf, stop: float = math.inf) -> tuple[Guess, ...]:
        """Guesses of other programs that touch a time (Unix times [s]), in time order."""
        columns = ", ".join(field.name for field in fields(Guess))
        order = "ORDER BY start, stop, source, kind, name"
        where = "WHERE person = ? AND start <= ? AND stop >= ?"
        rows = self._all(f"SELECT {columns} FROM guess {where} {order}", person, stop, start)
        return tuple(map(Guess.of_row, rows))

    def put_guesses(self, person: str, guesses: Iterable[Guess]) -> int:
        """Insert guesses; returns how many are new. Of two that differ in place or probability alone, the larger stays,
        so that the order of insertion does not matter.
        """
        with self._transaction() as execute:
            before = execute("SELECT count(*) FROM guess", ()).fetchone()[0]
            for guess in guesses:
                execute(PUT_GUESS, (person, *astuple(guess)))
            return execute("SELECT count(*) FROM guess", ()).fetchone()[0] - before

    def delete_guesses(self, person: str, start: float, stop: float) -> None:
        """Delete the guesses that touch a time (Unix times [s])."""
        self._write("DELETE FROM guess WHERE person = ? AND start <= ? AND stop >= ?", (person, stop, start))

    def phones(self) -> dict[str, str]:
        """Map Bluetooth transmitter -> person who carries it."""
        return dict(self._all("SELECT transmitter, person FROM phone ORDER BY transmitter"))

    def put_phone(self, person: str, transmitter: str) -> None:
        """Store that a person carries a Bluetooth transmitter."""
        self._write(_insert("phone", 2, " (transmitter, person)"), (transmitter, person))

    def corrections(self, person: str | None = None) -> tuple[Correction, ...]:
        """Corrections of a person, of all persons by default, in the order in which they were made."""
        rows = self._all("SELECT number, person, made, kind, start, stop, value FROM correction ORDER BY number")
        try:
            return tuple(c for c in map(Correction.of_row, rows) if person in (None, c.person))
        except (ValueError, TypeError) as error:
            raise InputError(self.path, "corrections", f"{error}", "an undamaged lifelog: restore a backup") from None

    def put_correction(self, correction: Correction) -> int:
        """Insert a correction, or replace that of the same number; returns its number."""
        return self._write(_insert("correction", 7), correction.row)

    def delete_correction(self, number: int) -> None:
        """Delete a correction."""
        self._write("DELETE FROM correction WHERE number = ?", (number,))

    def delete_days(self, days: Iterable[tuple[str, str]]) -> None:
        """Delete days (person, date)."""
        with self._transaction() as execute:
            for person, date in days:
                _delete_day(execute, person, date)

    def delete_person(self, person: str) -> None:
        """Delete all rows of a person."""
        with self._transaction() as execute:
            for table in (*TABLES, "failure", "recording", "phone", "correction", "guess"):
                execute(f"DELETE FROM {table} WHERE person = ?", (person,))
            execute("DELETE FROM setting WHERE name = ?", (SOURCES + person,))

    def compact(self) -> None:
        """Write the file anew without what was deleted."""
        self._all("VACUUM")

    def put_setting(self, name: str, value: str) -> None:
        """Change a setting."""
        self._write(_insert("setting", 2, " (name, value)"), (name, value))

    def lasting_setting(self, name: str, value: str) -> str:
        """The value of a setting, which is `value` for ever if it has none: two processes get the same one."""
        self._write("INSERT OR IGNORE INTO setting (name, value) VALUES (?, ?)", (name, value))
        return self.setting(name)

    def put_versions(self, versions: dict[str, str]) -> None:
        """Store the versions of packages."""
        self._write(_insert("version", 2), *versions.items())

    def begin_build(self, obsolete: Iterable[tuple[str, str]]) -> None:
        """Delete the failures of the last build, and days (person, date) whose recordings belong to other days now."""
        with self._transaction() as execute:
            execute("DELETE FROM failure", ())
            for person, date in obsolete:
                _delete_day(execute, person, date)

    def put_day(self, rows: Rows) -> None:
        """Replace the stored rows of a day."""
        [(person, date, *_)] = rows["day"]
        with self._transaction() as execute:
            _delete_day(execute, person, date)
            for table, table_rows in rows.items():
                for row in table_rows:
                    execute(_insert(table, len(row)), row)

    def put_failure(self, person: str, date: str, reason: str) -> None:
        """Store why a day failed; its earlier rows are kept."""
        self._write(_insert("failure", 3), (person, date, reason))

    def close(self) -> None:
        """Close the file, so that another process may open it."""
        self._database.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _all(self, statement: str, *values: Any) -> list[Any]:
        with explained(self.path, LIFELOG):
            return self._database.execute(statement, values).fetchall()

    def _write(self, statement: str, *rows: Sequence[Any]) -> int:
        """Execute a statement with the values of each row, in one transaction; returns the number of the last row."""
        with self._transaction() as execute:
            return max([0, *(execute(statement, row).lastrowid or 0 for row in rows)])

    @contextmanager
    def _reading_day(self, person: str, date: str) -> Iterator[None]:
        """Raise InputError if the rows of a day are damaged; it is deleted, so that the next build makes it again."""
        try:
            yield
        except InputError:
            raise
        except (ValueError, TypeError, LookupError) as error:
            self.delete_days([(person, date)])
            self.put_failure(person, date, f"damaged rows ({error})")
            expected = "those that were written: pdr-graph lifelog build makes the day again"
            raise InputError(self.path, f"{person}, {date}", f"damaged rows ({error})", expected) from None

    @contextmanager
    def _transaction(self) -> Iterator[Execute]:
        """A transaction, rolled back on any error."""
        with explained(self.path, LIFELOG):
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database.execute
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:  # a full disk may have ended it
                    self._database.execute("ROLLBACK")
                raise


def folder_of(path: Path) -> Path:
    """Path of the folder ``STORE.d`` of a lifelog."""
    return path.resolve().with_name(f"{path.name}.d")


def _delete_day(execute: Execute, person: str, date: str) -> None:
    """Delete the rows of a day from all tables."""
    for table in (*TABLES, "failure"):
        execute(f"DELETE FROM {table} WHERE person = ? AND date = ?", (person, date))


def _insert(table: str, columns: int, names: str = "") -> str:
    """The statement that inserts or replaces a row; names: of the columns, as ``(a, b)``, by default all in order."""
    return f"INSERT OR REPLACE INTO {table}{names} VALUES ({', '.join('?' * columns)})"


def _rows_kept(read: Callable[..., list[Row]]) -> tuple[dict[str, list[Row]], str]:
    """The rows of a damaged lifelog that can be read, by the statement that inserts them, and how many they are."""
    kept, counts = dict[str, list[Row]](), list[str]()
    with closing(sqlite3.connect(":memory:")) as empty:
        for statement in STORE_SCHEMA:
            empty.execute(statement)
        for table, known in KEPT.items():
            columns = ", ".join(row[1] for row in empty.execute(f"PRAGMA table_info({table})"))
            if rows := [row for row in read(table, columns) if None not in row[:known]]:
                kept[_insert(table, len(rows[0]), f" ({columns})")] = rows
                counts.append(f"{count(len(rows), 'row')} of {table}")
    return kept, f"recovered: {', '.join(counts)}; a build makes the days again"


LIFELOG = Kind(
    "lifelog",
    0x5044524C,  # "PDRL"
    6,
    STORE_SCHEMA,
    {"INSERT INTO setting (name, value) VALUES (?, ?)": list(SETTINGS.items())},
    {
        2: ("ALTER TABLE recording ADD beacons TEXT DEFAULT ''", "ALTER TABLE recording ADD ranges TEXT DEFAULT ''"),
        3: (*FACTS, "ALTER TABLE recording ADD zone TEXT DEFAULT ''"),
        4: (*(f"ALTER TABLE {table} ADD sum INTEGER" for table in SUMMED), "CREATE TABLE total (name TEXT)"),
        5: (*(f"ALTER TABLE {table} DROP COLUMN sum" for table in SUMMED), "DROP TABLE total"),
    },
    REMEDY,
    ": pdr-graph lifelog build recovers what is left of it",
    _rows_kept,
    shared=True,
)
