"""The journal of a live walk: acknowledged events survive kill -9, and the walk resumes by replaying them.

One SQLite file with the settings of the walk and its events. ``push`` writes the event, commits, and only then passes
it to the navigator. A navigator is a function of its events, so that a resumed one continues exactly as one that was
never interrupted; it receives the decoded event, with the memory layout of a replayed one. Replaying takes 3 to 9 % of
the time of the walk.

A killed process loses no acknowledged event; for power cuts see ``durable``.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from pdr_graph import storage
from pdr_graph.errors import InputError, count, expect
from pdr_graph.online.interface import Event, LiveEstimator, Pose, Status, event_types
from pdr_graph.recovery import Row, Rows, checked, is_whole
from pdr_graph.storage import Kind, decode, encode, encode_and_decode
from pdr_graph.types import Estimate, Trajectory

JOURNAL_REMEDY = "finish the walk with the pdr_graph that began it, or start a new --journal"
JOURNAL = Kind("journal", 0x50445247, 4, JOURNAL_REMEDY)  # "PDRG", and of this form of file
JOURNAL_SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE event (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",
)
PUT = {table: f"INSERT OR REPLACE INTO {table} VALUES (?, ?)" for table in ("setting", "event")}
SYNCHRONOUS = {"process": "OFF", "minute": "NORMAL", "power": "FULL"}
LOG_PAGES = 2000  # of the write-ahead log until SQLite waits for the disk: a minute of a phone's sensors
Navigator = TypeVar("Navigator", bound=LiveEstimator)


@dataclass(frozen=True)
class Setting:
    """An option of the navigator: texts, numbers, None, lists and dictionaries of these."""

    value: Any


class Journal(Generic[Navigator]):
    """A navigator whose events survive the process, started or resumed by `Journal.open`. One thread at a time.

    count: events acknowledged so far by all processes. loss: what a power cut has damaged, "" if nothing; it is an
    issue of the status.
    """

    def __init__(self, path: Path, database: sqlite3.Connection, make: Callable[[], Navigator], loss: str = ""):
        self._path, self._database, self._make = path, database, make
        self._navigator = self._replayed()
        self.loss = loss and f"{loss}: the walk goes on after event {self.count}"

    @classmethod
    def open(
        cls,
        path: str | Path,
        make: Callable[[], Navigator],
        settings: Mapping[str, Any] | None = None,
        *,
        durable: Literal["process", "minute", "power"] = "minute",
    ) -> Journal[Navigator]:
        """Start a journal, or continue the walk of an existing one.

        make: returns a navigator at the start of a walk.
        settings: options of the navigator, of JSON types; they must be the same when the walk continues.
        durable: every event survives the end of the process. "minute": a power cut costs the last minute of a phone's
            events; "power": it costs nothing, and each event waits for the disk; "process": it may damage the file,
            and nothing waits.

        A damaged journal comes back to its last whole event, and ``loss`` says so; the damaged file is kept beside it.

        Raises InputError if the file is no journal, of another version or other settings, in use, or so damaged that
        no walk comes back; OSError if it cannot be written.
        """
        path, requested = Path(path), settings or {}
        first = {PUT["setting"]: [(name, encode(Setting(value))) for name, value in requested.items()]}
        whole = partial(_whole_rows, path, requested.keys())
        database, loss = checked(path, JOURNAL, JOURNAL_SCHEMA, first, _damaged_rows, whole, pages=True)
        try:
            with _explained(path):
                database.execute(f"PRAGMA wal_autocheckpoint = {LOG_PAGES}")
                database.execute(f"PRAGMA synchronous = {SYNCHRONOUS[durable]}")
                stored = dict(database.execute("SELECT name, bytes FROM setting").fetchall())
            settings_of_file = {name: _read(path, f"setting {name}", blob, Setting) for name, blob in stored.items()}
            _compare(path, {name: setting.value for name, setting in settings_of_file.items()}, requested)
            return cls(path, database, make, loss)
        except BaseException:
            database.close()
            raise

    def __repr__(self) -> str:
        return f"Journal({str(self._path)!r}, {count(self.count, 'event')})"

    def push(self, event: Event) -> None:
        """Process an event; after the return it is in the journal.

        After an exception the event is not in the journal and the navigator has its former state. Raises OSError if the
        disk is full or fails, TypeError if the event is malformed, or any error of the navigator.
        """
        expect("Journal.push, event", event, *event_types(), instead="events_of(recording)")
        navigator = self.navigator
        blob, event = encode_and_decode(event)
        self._execute(PUT["event"], self.count + 1, blob)
        try:
            navigator.push(event)
        except BaseException:  # also Ctrl-C: the navigator may have used half of the event
            self._navigator = None
            self._forget_later()
            raise
        self.count += 1

    @property
    def navigator(self) -> Navigator:
        """The navigator after all events; after one that failed, another that has replayed those before."""
        if self._navigator is None:
            self._navigator = self._replayed()
        return self._navigator

    def review(self) -> None:
        """Let the navigator do long computations in an idle moment."""
        self.navigator.review()

    @property
    def pose(self) -> Pose | None:
        """The causal pose, None before there is one."""
        return self.navigator.pose

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self.navigator.steps

    @property
    def status(self) -> Status:
        """The state of the navigator."""
        status: Any = self.navigator.status  # a dataclass
        return replace(status, issues=(*status.issues, self.loss)) if self.loss else status

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far, from its beginning."""
        return self.navigator.trajectory

    def finish(self) -> Estimate:
        """End the walk and return its estimate."""
        return self.navigator.finish()

    def close(self) -> None:
        """Close the file, so that another process can continue the walk."""
        self._database.close()

    def __enter__(self) -> Journal[Navigator]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _replayed(self) -> Navigator:
        """A new navigator after all events of the file."""
        self.count, navigator = 0, self._make()
        while (blob := self._event(self.count + 1)) is not None:
            event = _read(self._path, f"event {self.count + 1}", blob, *event_types())
            try:
                navigator.push(event)
            except Exception:  # the process ended before `push` could delete this event, which was not acknowledged
                if self._event(self.count + 2) is not None:
                    raise
                self._forget_later()
                return self._replayed()
            self.count += 1
        return navigator

    def _event(self, number: int) -> bytes | None:
        row = self._execute("SELECT bytes FROM event WHERE number = ?", number).fetchone()
        return row and row[0]

    def _forget_later(self) -> None:
        """Delete an event that is not acknowledged."""
        self._execute("DELETE FROM event WHERE number > ?", self.count)

    def _execute(self, statement: str, *values: int | bytes) -> sqlite3.Cursor:
        with _explained(self._path):
            return self._database.execute(statement, values)


def _read(path: Path, place: str, blob: bytes, *kinds: type) -> Any:
    """Decode bytes of the file as one of ``kinds``. Raises InputError if they are damaged."""
    try:
        return decode(blob, *kinds)
    except ValueError as error:
        raise InputError(path, place, str(error), "a journal that is whole") from None


def _explained(path: Path) -> AbstractContextManager[None]:
    """Translate errors of SQLite into those of this package."""
    return storage.explained(path, JOURNAL)


def _compare(path: Path, stored: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    """Raise InputError if the requested settings differ from the stored ones."""
    for name in sorted(stored.keys() | requested.keys()):
        if stored.get(name) != (wanted := encode_and_decode(Setting(requested.get(name)))[1].value):
            raise InputError(path, name, f"{stored.get(name)}", f"{wanted}, or that with which the walk began")


def _damaged_rows(database: sqlite3.Connection) -> str:
    """What is damaged or missing in a journal whose pages are whole; "" if nothing is."""
    for name, blob in database.execute("SELECT name, bytes FROM setting"):
        if not is_whole(blob):
            return f"damaged (setting {name})"
    for expected, (number, blob) in enumerate(database.execute("SELECT number, bytes FROM event ORDER BY number"), 1):
        if number != expected or not is_whole(blob):
            return f"damaged (no event {expected})" if number != expected else f"damaged (event {number})"
    return ""


def _whole_rows(path: Path, required: Collection[str], rows: Callable[[str], list[Row]]) -> tuple[Rows, str]:
    """The rows of a damaged journal up to the last whole event, and what is lost. required: settings.

    Raises InputError if no walk can go on from them: a setting or the first event is damaged.
    """
    settings, events = ({name: (name, blob) for name, blob in rows(table) if is_whole(blob)} for table in PUT)
    kept = list[Row]()
    while (event := events.get(len(kept) + 1)) is not None:
        kept.append(event)
    if not settings.keys() >= {*required} or not kept:
        place = "event 1" if settings.keys() >= {*required} else "settings"
        raise InputError(path, place, "a damaged journal", "one that is whole: start the walk anew with another file")
    found = {PUT["setting"]: list(settings.values()), PUT["event"]: kept}
    return found, "all events after the last whole one are lost"
