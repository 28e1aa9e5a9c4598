"""The store of a lifelog: one SQLite file of recordings and reconstructed days, opened by one process at a time.

The folder ``STORE.d`` beside it has observations, copies of recordings if requested, and days that are not stored yet.
Everything except the copies can be rebuilt from the recordings. Any SQLite client may read the tables; only `Store`
writes them, one transaction per operation.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph import storage
from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import InputError, count
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Profile
from pdr_graph.lifelog.day import Day, Outing, Segment, Stay
from pdr_graph.storage import Kind, compress, decode_json, decompress, encode_json
from pdr_graph.types import Trajectory

DAY_SCHEMA = (
    # key: of all that a day is made of; recordings: hashes, JSON
    "CREATE TABLE day (person TEXT, date TEXT, key TEXT, recordings TEXT, PRIMARY KEY (person, date))",
    # epoch: Unix time at 0 [s]; frame, recordings, notes and missing: JSON
    """CREATE TABLE outing (person TEXT, date TEXT, outing INTEGER, source TEXT, epoch REAL, steps INTEGER, plan TEXT,
        frame TEXT, recordings TEXT, notes TEXT, missing TEXT, PRIMARY KEY (person, date, outing))""",
    # start, stop: from the outing's epoch [s]; distance [m]
    """CREATE TABLE segment (person TEXT, date TEXT, outing INTEGER, segment INTEGER, kind TEXT, start REAL, stop REAL,
        distance REAL, PRIMARY KEY (person, date, outing, segment))""",
    # bytes: as of storage.compress
    """CREATE TABLE trajectory (person TEXT, date TEXT, outing INTEGER, bytes BLOB,
        PRIMARY KEY (person, date, outing))""",
    # x, y [m] in the outing's frame; heading [rad], NULL where unknown
    """CREATE TABLE stay (person TEXT, date TEXT, outing INTEGER, stay INTEGER, start REAL, stop REAL, passing INTEGER,
        x REAL, y REAL, var_x REAL, cov_xy REAL, var_y REAL, heading REAL, floor TEXT,
        PRIMARY KEY (person, date, outing, stay))""",
    """CREATE TABLE facing (person TEXT, date TEXT, outing INTEGER, stay INTEGER, rank INTEGER, name TEXT,
        probability REAL, PRIMARY KEY (person, date, outing, stay, rank))""",
    # at the end of the day; covariance: 3 × 3 in the order of the coefficients, JSON
    """CREATE TABLE profile (person TEXT, date TEXT, E_length REAL, E_straight REAL, E_corner REAL, covariance TEXT,
        residual REAL, speed REAL, PRIMARY KEY (person, date))""",
)
TABLES = ("day", "outing", "segment", "trajectory", "stay", "facing", "profile")  # tables with rows of a day
Rows = dict[str, list[tuple[Any, ...]]]


@dataclass(frozen=True)
class DayRows:
    """The rows of a day by table, on their way from a worker to the store."""

    tables: Rows


def rows_of(day: Day, key: str, recordings: Sequence[str]) -> Rows:
    """The rows of a day by table. key: hash of its inputs; recordings: content hashes."""
    own = (day.person, day.date)
    rows: Rows = {name: [] for name in TABLES}
    rows["day"].append((*own, key, json.dumps(list(recordings))))
    for n, outing in enumerate(day.outings):
        _add(rows, (*own, n), outing)
    if day.profile is not None:
        rows["profile"].append((*own, *profile_row(day.profile)))
    return rows


def day_of(person: str, date: str, read: Callable[[str], Sequence[Sequence[Any]]]) -> Day:
    """The day whose rows `rows_of` returned. read: returns the rows of a table in order, without person and date.

    Raises ValueError if the rows are invalid.
    """
    tables = {name: read(name) for name in TABLES}
    found = [profile_of(row) for row in tables["profile"]]
    outings = tuple(_outing(row, tables) for row in tables["outing"])
    return Day(person, date, outings, found[0] if found else None)


def profile_row(profile: Profile) -> tuple[Any, ...]:
    """Row of a profile for its table."""
    covariance = json.dumps(profile.covariance.tolist())
    return (profile.E_length, profile.E_straight, profile.E_corner, covariance, profile.residual, profile.speed)


def profile_of(row: Sequence[Any]) -> Profile:
    """Profile from a row of its table."""
    length, straight, corner, covariance, residual, speed = row
    length, straight, corner, residual, speed = map(_number, (length, straight, corner, residual, speed))
    return Profile(length, straight, corner, np.array(json.loads(covariance)), residual, speed)


def _add(rows: Rows, own: tuple[str, str, int], outing: Outing) -> None:
    """Add the rows of one outing."""
    texts = [json.dumps(list(lines)) for lines in (outing.recordings, outing.notes, outing.missing)]
    frame = encode_json(outing.frame)
    rows["outing"].append((*own, outing.source, outing.epoch, outing.steps, outing.plan, frame, *texts))
    rows["trajectory"].append((*own, compress(outing.trajectory)))
    for n, s in enumerate(outing.segments):
        rows["segment"].append((*own, n, s.kind, s.start, s.end, s.distance))
    for n, stay in enumerate(outing.stays):
        place = (*stay.position.tolist(), *stay.covariance.ravel()[[0, 1, 3]].tolist())
        rows["stay"].append((*own, n, stay.start, stay.end, int(stay.passing), *place, stay.heading, stay.floor))
        rows["facing"] += [(*own, n, rank, name, p) for rank, (name, p) in enumerate(stay.facing)]


def _outing(row: Sequence[Any], tables: Mapping[str, Sequence[Sequence[Any]]]) -> Outing:
    """The outing of a row of its table, with its rows in the other tables."""
    number, source, epoch, steps, plan, frame, *texts = row
    recordings, notes, missing = (tuple(json.loads(lines)) for lines in texts)
    own = {name: [r[1:] for r in tables[name] if r[0] == number] for name in TABLES[2:]}
    [(track,)] = own["trajectory"]
    return Outing(
        recordings=recordings,
        source=source,
        epoch=epoch,
        frame=decode_json(frame, Frame),
        plan=plan,
        trajectory=decompress(track, Trajectory),
        segments=tuple(Segment(kind, *map(_number, numbers)) for _, kind, *numbers in own["segment"]),
        stays=tuple(_stay(r, own["facing"]) for r in own["stay"]),
        steps=steps,
        notes=notes,
        missing=missing,
    )


def _stay(row: Sequence[Any], facing: Sequence[Sequence[Any]]) -> Stay:
    """The stay of a row of its table; facing: the rows of its outing."""
    number, start, stop, passing, *numbers, floor = row
    x, y, var_x, cov_xy, var_y, heading = map(_number, numbers)
    names = tuple((name, probability) for stay, _, name, probability in facing if stay == number)
    covariance = np.array([[var_x, cov_xy], [cov_xy, var_y]])
    return Stay(start, stop, bool(passing), np.array([x, y]), covariance, heading, floor, names)


def _number(value: float | None) -> float:
    """A number from SQLite, which stores NaN as NULL."""
    return float("nan") if value is None else value


REMEDY = "add the recordings to a new store, pdr-graph lifelog add NEW …, or read this one with the older pdr_graph"
LIFELOG = Kind(
    "lifelog",
    0x5044524C,  # "PDRL"
    3,
    REMEDY,
    {2: ("ALTER TABLE recording ADD beacons TEXT DEFAULT ''", "ALTER TABLE recording ADD ranges TEXT DEFAULT ''")},
)
SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, value TEXT)",
    "CREATE TABLE version (name TEXT PRIMARY KEY, value TEXT)",  # of the programs that built it last
    # an Entry with its options; '' for one that is not given, but NULL for begins
    """CREATE TABLE recording (hash TEXT PRIMARY KEY, person TEXT, path TEXT, plan TEXT, fixes TEXT, beacons TEXT,
        ranges TEXT, walker TEXT, floor TEXT, begins REAL, observation TEXT, epoch REAL, duration REAL, steps INTEGER,
        refusal TEXT)""",
    "CREATE TABLE phone (transmitter TEXT PRIMARY KEY, person TEXT)",  # owner of each transmitter in the logs of others
    *DAY_SCHEMA,
    # days that the last build could not build; said: the reason
    "CREATE TABLE failure (person TEXT, date TEXT, said TEXT, PRIMARY KEY (person, date))",
)
ZONE = "zone"
TOGETHER = "together"
SETTINGS = {ZONE: "UTC", TOGETHER: ""}  # time zone of the days; key of the last joint estimate
Execute = Callable[[str, Sequence[Any]], sqlite3.Cursor]


@dataclass(frozen=True)
class RecordingOptions:
    """What is read or assumed with a recording; None: not given.

    plan: floor plan; fixes, beacons, ranges, walker: files as of `inputs.Options`; floor: label of the floor at the
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


FILES = ("plan", "fixes", "beacons", "ranges", "walker")  # options that are paths


@dataclass(frozen=True)
class Entry(OneLineRepr):
    """The lifelog's entry for a recording.

    hash: of its content; person; path: of the recording; options: what is read with it.
    observation: key of the observation, "" if there is none yet; epoch: Unix time of its start [s], duration [s] and
    number of steps. refusal: why the last observation failed, "" if it succeeded.
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

    @property
    def row(self) -> dict[str, Any]:
        """The entry by columns of its table."""
        options = {name: str(value) for name, value in self.options.given.items()}
        options = dict.fromkeys((*FILES, "floor"), "") | options | {"begins": self.options.begins}
        return {name: value for name, value in vars(self).items() if name != "options"} | options

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Entry:
        """The entry with these columns."""
        given = {name: Path(row[name]) for name in FILES if row[name]}
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

    def __init__(self, path: Path, new: bool = False):
        """Open a lifelog; new: create it if it does not exist.

        Raises InputError if it is not a lifelog, of a newer version, damaged, in use or missing; OSError of the disk.
        """
        if not new and not path.exists():
            raise InputError(path, "", "no such file", "a lifelog: create it with pdr-graph lifelog add")
        self.path, self.folder = path, folder_of(path)
        begins = {"INSERT INTO setting VALUES (?, ?)": list(SETTINGS.items())}
        self._database = storage.create_or_open(path, LIFELOG, SCHEMA, begins)
        self._database.execute("PRAGMA synchronous = NORMAL")  # survives kill -9; a power cut loses the last days

    def entries(self) -> tuple[Entry, ...]:
        """Entries of all recordings, ordered by hash."""
        names = [name for _, name, *_ in self._all("PRAGMA table_info(recording)")]
        rows = self._all(f"SELECT {', '.join(names)} FROM recording ORDER BY hash")
        return tuple(Entry.of_row(dict(zip(names, row, strict=True))) for row in rows)

    def setting(self, name: str) -> str:
        """Value of a setting."""
        return self._all("SELECT value FROM setting WHERE name = ?", name)[0][0]

    def days(self) -> dict[tuple[str, str], StoredDay]:
        """Stored days by (person, date), in this order."""
        profiles, days = self._all("SELECT * FROM profile"), self._all("SELECT * FROM day ORDER BY person, date")
        with self._reading("days"):
            known = {(person, date): profile_of(row) for person, date, *row in profiles}
            return {
                (person, date): StoredDay(key, tuple(json.loads(recordings)), known.get((person, date)))
                for person, date, key, recordings in days
            }

    def day(self, person: str, date: str) -> Day | None:
        """A day of a person; None if it is not stored."""
        if not self._all("SELECT 1 FROM day WHERE person = ? AND date = ?", person, date):
            return None

        def read(table: str) -> list[Any]:
            columns = "SELECT * FROM {} WHERE person = ? AND date = ? ORDER BY rowid"
            return [row[2:] for row in self._all(columns.format(table), person, date)]

        with self._reading(f"{person}, {date}"):
            return day_of(person, date, read)

    def failures(self) -> tuple[tuple[str, str, str], ...]:
        """Person, date and reason of each day that failed in the last build."""
        return tuple(self._all("SELECT person, date, said FROM failure ORDER BY person, date"))

    def put(self, *entries: Entry) -> None:
        """Insert or replace entries of recordings."""
        with self._transaction() as execute:
            for entry in entries:
                row = entry.row
                execute(_insert("recording", len(row), f" ({', '.join(row)})"), tuple(row.values()))

    def phones(self) -> dict[str, str]:
        """Map Bluetooth transmitter -> person who carries it."""
        return dict(self._all("SELECT transmitter, person FROM phone ORDER BY transmitter"))

    def put_phone(self, person: str, transmitter: str) -> None:
        """Store that a person carries a Bluetooth transmitter."""
        with self._transaction() as execute:
            execute(_insert("phone", 2), (transmitter, person))

    def put_setting(self, name: str, value: str) -> None:
        """Change a setting."""
        with self._transaction() as execute:
            execute(_insert("setting", 2), (name, value))

    def put_versions(self, versions: dict[str, str]) -> None:
        """Store the versions of packages."""
        with self._transaction() as execute:
            for row in versions.items():
                execute(_insert("version", 2), row)

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
        with self._transaction() as execute:
            execute(_insert("failure", 3), (person, date, reason))

    def close(self) -> None:
        """Close the file, so that another process may open it."""
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _all(self, statement: str, *values: Any) -> list[Any]:
        with storage.explained(self.path, LIFELOG):
            return self._database.execute(statement, values).fetchall()

    @contextmanager
    def _reading(self, place: str) -> Iterator[None]:
        """Raise InputError instead of the errors that damaged rows cause; place: in the message."""
        try:
            yield
        except InputError:
            raise
        except (ValueError, TypeError, LookupError) as error:
            raise InputError(
                self.path, place, f"{error}", "an undamaged lifelog: restore a backup, or build it again"
            ) from None

    @contextmanager
    def _transaction(self) -> Iterator[Execute]:
        """A transaction, rolled back on any error."""
        with storage.explained(self.path, LIFELOG):
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
