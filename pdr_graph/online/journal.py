"""The journal of a live walk: acknowledged events survive kill -9, and the walk resumes from the journal.

One SQLite file. ``push`` writes the event, commits, and only then passes it to the navigator. Every SNAPSHOT_EVENTS
events a snapshot of the navigator replaces the events before, which bounds the size and the time to resume, and the
running navigator is *rebuilt from these bytes*, so that it continues exactly as a resumed one. For the same reason it
receives the decoded event, with the memory layout of a resumed one, and the times of snapshots depend on the numbers of
events and bytes, never on the clock.

A killed process loses no acknowledged event; for power cuts see ``durable``.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from pdr_graph import storage
from pdr_graph.errors import InputError, count, expect
from pdr_graph.online.interface import Event, Journaled, Pose, Status, event_types
from pdr_graph.online.journal_rows import LAST, PUT, Setting, damaged_rows, last_row, setting_row, whole_rows
from pdr_graph.recovery import checked
from pdr_graph.storage import Kind, decode, encode, encode_and_decode
from pdr_graph.types import Estimate, Trajectory

REMEDY = "finish the walk with the pdr_graph that began it, or start a new --journal"
JOURNAL = Kind("journal", 0x50445247, 3, REMEDY)  # "PDRG", and of this form of file
SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE event (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE snapshot (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",  # the state after that event
    "CREATE TABLE trajectory (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",  # the rows finalised by then
)


def open_store(
    path: Path, settings: Mapping[str, Any], synchronous: str
) -> tuple[sqlite3.Connection, dict[str, Any], str]:
    """Open or create the database; returns it with its settings, which are ``settings`` if it is new, and what is lost.

    Raises InputError if the file is of another kind or version, in use, or so damaged that no walk comes back; OSError
    if the disk fails.
    """
    first = {PUT["setting"]: [*(setting_row(name, value) for name, value in settings.items()), last_row(0, [])]}
    whole = partial(whole_rows, path, settings.keys())
    opened, loss = checked(path, JOURNAL, SCHEMA, first, damaged_rows, whole, pages=True)
    try:
        with explained(path):
            opened.execute("PRAGMA wal_autocheckpoint = 0")  # it is done after each snapshot instead
            opened.execute(f"PRAGMA synchronous = {synchronous}")
            rows = opened.execute("SELECT name, bytes FROM setting WHERE name != ?", (LAST,)).fetchall()
        stored = {name: read(path, f"setting {name}", blob, Setting).value for name, blob in rows}
        return opened, stored, loss
    except BaseException:
        opened.close()
        raise


def read(path: Path, place: str, blob: bytes, *kinds: type) -> Any:
    """Decode bytes of the file as one of ``kinds``. Raises InputError if they are damaged."""
    try:
        return decode(blob, *kinds)
    except ValueError as error:
        raise InputError(path, place, str(error), "a journal that is whole") from None


def explained(path: Path) -> AbstractContextManager[None]:
    """Translate errors of SQLite into those of this package."""
    return storage.explained(path, JOURNAL)


SNAPSHOT_EVENTS = 2000  # events between snapshots: a minute of a phone's sensors
SNAPSHOT_BYTES = 4 << 20  # bytes of events between snapshots; a change of it needs a new version of the journal
INTERVAL = "events between snapshots"  # name of the setting of the journal itself
SYNCHRONOUS = {"process": "OFF", "snapshot": "NORMAL", "power": "FULL"}
Navigator = TypeVar("Navigator", bound=Journaled)


class Journal(Generic[Navigator]):
    """A navigator whose events survive the process, started or resumed by `Journal.open`. One thread at a time.

    navigator: replaced at every snapshot, so do not store it. count: events acknowledged so far by all processes.
    loss: what a power cut has damaged, "" if nothing; it is an issue of the status.
    """

    def __init__(
        self,
        path: Path,
        database: sqlite3.Connection,
        make: Callable[[], Navigator],
        restored: Callable[[Any], Navigator],
        every: int,
        loss: str = "",
    ):
        self._path, self._database, self._every = path, database, every
        self._make, self._restored = make, restored
        self._resume()
        self.loss = loss and f"{loss}: the walk goes on after event {self.count}"

    @classmethod
    def open(
        cls,
        path: str | Path,
        make: Callable[[], Navigator],
        restored: Callable[[Any], Navigator],
        settings: Mapping[str, Any] | None = None,
        *,
        durable: Literal["process", "snapshot", "power"] = "snapshot",
        every: int = SNAPSHOT_EVENTS,
    ) -> Journal[Navigator]:
        """Start a journal, or continue the walk of an existing one.

        make: returns a navigator at the start of a walk; restored: returns one with the state of a snapshot.
        settings: options of the navigator, of JSON types; they must be the same when the walk continues.
        durable: every event survives the end of the process. "snapshot": a power cut costs the events since the last
            snapshot, which waits for the disk; "power": it costs nothing, and each event waits for the disk; "process":
            it may damage the file, and nothing waits.
        every: events between snapshots of a new journal; an existing one has its own.

        A damaged journal comes back to its last whole event, and ``loss`` says so; the damaged file is kept beside it.

        Raises InputError if the file is no journal, of another version or other settings, in use, or so damaged that
        no walk comes back; OSError if it cannot be written.
        """
        path, requested = Path(path), settings or {}
        database, stored, loss = open_store(path, {INTERVAL: every, **requested}, SYNCHRONOUS[durable])
        try:
            every = stored.pop(INTERVAL, every)
            _compare(path, stored, requested)
            return cls(path, database, make, restored, every, loss)
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
        blob, event = encode_and_decode(event)
        self._execute(PUT["event"], self.count + 1, blob)
        try:
            self.navigator.push(event)
        except BaseException:  # also Ctrl-C: the navigator may have used half of the event
            self._execute("DELETE FROM event WHERE number > ?", self.count)
            self._resume()
            raise
        self._acknowledge(blob)

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
        return self._from_the_beginning(self.navigator.trajectory)

    def finish(self) -> Estimate:
        """End the walk and return its estimate, with the trajectory from the beginning."""
        estimate = self.navigator.finish()
        return replace(estimate, trajectory=self._from_the_beginning(estimate.trajectory))

    def close(self) -> None:
        """Close the file, so that another process can continue the walk."""
        self._database.close()

    def __enter__(self) -> Journal[Navigator]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _resume(self) -> None:
        """Restore the navigator from the snapshot and push all later events of the file."""
        snapshot = self._execute("SELECT number, bytes FROM snapshot").fetchone()
        if snapshot is None:
            self.count, self.navigator = 0, self._make()
        else:
            self.count, state = snapshot
            kind = self._make().Checkpoint
            self.navigator = self._restored(read(self._path, f"snapshot {self.count}", state, kind))
        self._snapshot_count, self._bytes = self.count, 0
        self._parts = [number for (number,) in self._execute("SELECT number FROM trajectory ORDER BY number")]
        self._finalized: dict[int, bytes] = {}  # encoded rows that are not in the file yet, by number of events
        while (blob := self._blob_of(self.count + 1)) is not None:
            event = read(self._path, f"event {self.count + 1}", blob, *event_types())
            try:
                self.navigator.push(event)
            except Exception:  # the process ended before `push` could delete this event, which was not acknowledged
                if self._blob_of(self.count + 2) is not None:
                    raise
                self._execute("DELETE FROM event WHERE number > ?", self.count)
                return self._resume()
            self._acknowledge(blob)

    def _blob_of(self, number: int) -> bytes | None:
        row = self._execute("SELECT bytes FROM event WHERE number = ?", number).fetchone()
        return row and row[0]

    def _execute(self, statement: str, *values: int | bytes) -> sqlite3.Cursor:
        with explained(self._path):
            return self._database.execute(statement, values)

    def _acknowledge(self, blob: bytes) -> None:
        """Count an event, and take a snapshot if one is due."""
        self.count += 1
        self._bytes += len(blob)
        if self.count - self._snapshot_count >= self._every or self._bytes >= SNAPSHOT_BYTES:
            self._take_snapshot()

    def _take_snapshot(self) -> None:
        """Continue from a snapshot, and store it in place of the events before."""
        rows = self.navigator.finalized()
        state, checkpoint = encode_and_decode(self.navigator.snapshot())
        self.navigator = self._restored(checkpoint)
        self._snapshot_count, self._bytes = self.count, 0
        if len(rows):
            self._finalized[self.count] = encode(rows)
        try:
            self._store(state)
        except sqlite3.OperationalError:  # a full disk: the events stay in the file until the next snapshot
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
        else:
            self._finalized.clear()

    def _store(self, state: bytes) -> None:
        """Write a snapshot and the finalised rows, and delete the events before, in one transaction."""
        execute = self._database.execute
        execute("BEGIN")
        self._database.executemany(PUT["trajectory"], self._finalized.items())
        execute("DELETE FROM snapshot")
        execute(PUT["snapshot"], (self.count, state))
        parts = sorted({*self._parts, *self._finalized})
        execute(PUT["setting"], last_row(self.count, parts))
        execute("DELETE FROM event WHERE number <= ?", (self.count,))
        execute("COMMIT")
        self._parts = parts
        execute("PRAGMA wal_checkpoint(RESTART)")  # reuses the space of the log; truncating it would take longer

    def _from_the_beginning(self, latest: Trajectory) -> Trajectory:
        """All finalised rows, followed by ``latest``."""
        stored = dict(self._execute("SELECT number, bytes FROM trajectory ORDER BY number").fetchall())
        parts = (stored | self._finalized).items()
        return _joined([*(read(self._path, f"trajectory {n}", blob, Trajectory) for n, blob in parts), latest])


def _joined(parts: list[Trajectory]) -> Trajectory:
    """Concatenate trajectories that follow one another."""
    covariances = [part.covariance for part in parts if part.covariance is not None]
    return replace(
        parts[-1],
        time=np.concatenate([part.time for part in parts]),
        position=np.concatenate([part.position for part in parts]),
        heading=np.concatenate([part.heading for part in parts]),
        floor=tuple(label for part in parts for label in part.floor),
        covariance=np.concatenate(covariances) if len(covariances) == len(parts) else None,
    )


def _compare(path: Path, stored: dict[str, Any], requested: Mapping[str, Any]) -> None:
    """Raise InputError if the requested settings differ from the stored ones."""
    for name in sorted(stored.keys() | requested.keys()):
        if stored.get(name) != (wanted := encode_and_decode(Setting(requested.get(name)))[1].value):
            raise InputError(path, name, f"{stored.get(name)}", f"{wanted}, or that with which the walk began")
