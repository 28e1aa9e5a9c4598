"""The lifelog: one SQLite file of recordings and of what was made of them, which one process at a time may open.

Beside it, in ``STORE.d``, lies what it is made from: what each recording was observed to tell, copies of recordings if
they are asked for, and days on their way into the store. All but the copies can be made again from the recordings.
The tables may be read with any SQLite client; only `Store` writes them, a transaction for each thing that is done.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from pdr_graph import database
from pdr_graph.database import Kind
from pdr_graph.errors import InputError
from pdr_graph.gait.profile import Profile
from pdr_graph.lifelog import rows
from pdr_graph.lifelog.day import Day

LIFELOG = Kind("lifelog", 0x5044524C, 1)  # "PDRL", and of this form of file
SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, value TEXT)",
    "CREATE TABLE version (name TEXT PRIMARY KEY, value TEXT)",  # of the programs that built it last
    # as of Entry
    """CREATE TABLE recording (hash TEXT PRIMARY KEY, person TEXT, path TEXT, plan TEXT, fixes TEXT, walker TEXT,
        floor TEXT, begins REAL, observation TEXT, epoch REAL, duration REAL, steps INTEGER, refusal TEXT)""",
    "CREATE TABLE phone (transmitter TEXT PRIMARY KEY, person TEXT)",  # who carries what others' logs hear
    *rows.SCHEMA,
    # why a day could not be built, of the last build
    "CREATE TABLE failure (person TEXT, date TEXT, said TEXT, PRIMARY KEY (person, date))",
)
ZONE = "zone"
TOGETHER = "together"
SETTINGS = {ZONE: "UTC", TOGETHER: ""}  # whose midnights part the days; of what the days in one graph were made
Execute = Callable[[str, Sequence[Any]], sqlite3.Cursor]


@dataclass(frozen=True)
class Entry:
    """A recording, as the lifelog knows it.

    hash: of its content; person; path: where it is; plan, fixes, walker: paths of files, "" without one; floor: label
    where it began, "" if unknown; begins: Unix time of its start [s], None if it says so itself.
    observation: key of what it was observed to tell, "" before that; then epoch: Unix time of its start [s],
    duration [s] and number of steps. refusal: why it could not be observed the last time that was tried, "" if it
    could.
    """

    hash: str
    person: str
    path: str
    plan: str = ""
    fixes: str = ""
    walker: str = ""
    floor: str = ""
    begins: float | None = None
    observation: str = ""
    epoch: float | None = None
    duration: float | None = None
    steps: int | None = None
    refusal: str = ""


@dataclass(frozen=True)
class Built:
    """A day that is in the store. key: of all that it was made of; recordings: their hashes; profile: at its end."""

    key: str
    recordings: tuple[str, ...]
    profile: Profile | None


class Store:
    """An open lifelog. folder: ``STORE.d``, which need not be there. A context manager."""

    def __init__(self, path: Path, new: bool = False):
        """Open the file; new: make it, if there is none.

        Raises InputError if it is no lifelog, of a newer version, damaged, in use or missing; OSError of the disk.
        """
        if not new and not path.exists():
            raise InputError(path, "", "no such file", "a lifelog, as pdr-graph lifelog add makes it")
        self.path, self.folder = path, folder_of(path)
        begins = {"INSERT INTO setting VALUES (?, ?)": list(SETTINGS.items())}
        self._database = database.create_or_open(path, LIFELOG, SCHEMA, begins)
        self._database.execute("PRAGMA synchronous = NORMAL")  # outlives kill -9; a power cut costs the last days

    def entries(self) -> tuple[Entry, ...]:
        """All recordings, in order of hash."""
        return tuple(Entry(*row) for row in self._all("SELECT * FROM recording ORDER BY hash"))

    def setting(self, name: str) -> str:
        """What is set."""
        return self._all("SELECT value FROM setting WHERE name = ?", name)[0][0]

    def days(self) -> dict[tuple[str, str], Built]:
        """What is built, by person and date, in this order."""
        profiles, days = self._all("SELECT * FROM profile"), self._all("SELECT * FROM day ORDER BY person, date")
        with self._whole("days"):
            known = {(person, date): rows.profile_of(row) for person, date, *row in profiles}
            return {
                (person, date): Built(key, tuple(json.loads(recordings)), known.get((person, date)))
                for person, date, key, recordings in days
            }

    def day(self, person: str, date: str) -> Day | None:
        """A person's day, None where none is built."""
        if not self._all("SELECT 1 FROM day WHERE person = ? AND date = ?", person, date):
            return None

        def read(table: str) -> list[Any]:
            columns = "SELECT * FROM {} WHERE person = ? AND date = ? ORDER BY rowid"
            return [row[2:] for row in self._all(columns.format(table), person, date)]

        with self._whole(f"{person}, {date}"):
            return rows.day_of(person, date, read)

    def failures(self) -> tuple[tuple[str, str, str], ...]:
        """Person, date and what was said, of each day that the last build could not build."""
        return tuple(self._all("SELECT person, date, said FROM failure ORDER BY person, date"))

    def put(self, *entries: Entry) -> None:
        """Add recordings, or change what is known of them."""
        with self._transaction() as execute:
            for entry in entries:
                execute(_insert("recording", len(fields(Entry))), astuple(entry))

    def phones(self) -> dict[str, str]:
        """Whose phone or tag a Bluetooth transmitter is."""
        return dict(self._all("SELECT transmitter, person FROM phone ORDER BY transmitter"))

    def carries(self, person: str, transmitter: str) -> None:
        """Note what a person carries."""
        with self._transaction() as execute:
            execute(_insert("phone", 2), (transmitter, person))

    def set(self, name: str, value: str) -> None:
        """Change a setting."""
        with self._transaction() as execute:
            execute(_insert("setting", 2), (name, value))

    def built_with(self, versions: dict[str, str]) -> None:
        """Note the versions of programs."""
        with self._transaction() as execute:
            for row in versions.items():
                execute(_insert("version", 2), row)

    def begin(self, forgotten: Iterable[tuple[str, str]]) -> None:
        """Forget what failed the last time, and these days, whose recordings are of other days now."""
        with self._transaction() as execute:
            execute("DELETE FROM failure", ())
            for person, date in forgotten:
                _forget(execute, person, date)

    def take(self, made: rows.Rows) -> None:
        """Put a day in the place of what was there of it."""
        [(person, date, *_)] = made["day"]
        with self._transaction() as execute:
            _forget(execute, person, date)
            for table, its in made.items():
                for row in its:
                    execute(_insert(table, len(row)), row)

    def failed(self, person: str, date: str, said: str) -> None:
        """Note why a day could not be built; what was there of it stays."""
        with self._transaction() as execute:
            execute(_insert("failure", 3), (person, date, said))

    def close(self) -> None:
        """Let another process open it."""
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _all(self, statement: str, *values: Any) -> list[Any]:
        with database.explained(self.path, LIFELOG):
            return self._database.execute(statement, values).fetchall()

    @contextmanager
    def _whole(self, place: str) -> Iterator[None]:
        """Say of rows that were damaged that they are."""
        try:
            yield
        except InputError:
            raise
        except (ValueError, TypeError, LookupError) as error:
            raise InputError(self.path, place, f"{error}", "a lifelog that is whole") from None

    @contextmanager
    def _transaction(self) -> Iterator[Execute]:
        """All or nothing."""
        with database.explained(self.path, LIFELOG):
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database.execute
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:  # a full disk may have ended it
                    self._database.execute("ROLLBACK")
                raise


def folder_of(path: Path) -> Path:
    """Where a lifelog's other files are."""
    return path.resolve().with_name(f"{path.name}.d")


def _forget(execute: Execute, person: str, date: str) -> None:
    for table in (*rows.TABLES, "failure"):
        execute(f"DELETE FROM {table} WHERE person = ? AND date = ?", (person, date))


def _insert(table: str, columns: int) -> str:
    return f"INSERT OR REPLACE INTO {table} VALUES ({', '.join('?' * columns)})"
