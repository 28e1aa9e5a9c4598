"""One walker: the messages of a session, in order, through a journaled navigator.

The folder of a session has ``messages.log`` (what the phone sent, written before it is acknowledged), ``turns.db`` (the
order in which messages were used, and the state of the intake before each) and ``walk.journal`` (the navigator). After
the process was killed at any moment, the walk goes on from the three as if nothing had happened.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph import storage
from pdr_graph.errors import InputError, count
from pdr_graph.lifelog.cache import write
from pdr_graph.online.journal import Journal
from pdr_graph.online.navigator import Navigator
from pdr_graph.serve.intake import SENSOR_LOGGER, Intake
from pdr_graph.serve.message_log import MAGIC, Entry, read_body, read_entries
from pdr_graph.serve.publishing import path_columns, pose_json
from pdr_graph.storage import Kind, decode, encode
from pdr_graph.types import Trajectory

PATIENCE = 2.0  # [s] for which a message waits for those before it
MOST_WAITING = 64  # messages that wait for one; then it is given up
LOG, TURNS, JOURNAL, SESSION, PUBLISHED = "messages.log", "turns.db", "walk.journal", "session.json", "published.json"
RECORDINGS = ("recording.zip", "recording.gpx")  # of a finished session: of sensors, of positions alone
TURN = Kind("order of messages", 0x50445254, 2, "delete it: it is made from messages.log")
SCHEMA = (
    "CREATE TABLE turn (turn INTEGER PRIMARY KEY, offset INTEGER NOT NULL, events INTEGER NOT NULL, intake BLOB)",
)
Make = Callable[..., Navigator]


@dataclass(frozen=True)
class Turn:
    """A message that is used. number: of the message, from 1; offset: in the log [bytes]; events: in the journal before
    it; intake: the state of the intake before it, encoded.
    """

    number: int
    offset: int
    events: int
    intake: bytes


@dataclass(frozen=True)
class Session:
    """What a session is.

    id: in addresses; key: the app's name of it; name: for people; user: to whom it belongs; protocol: of its messages;
    platform: "ios" or "android" if it was stated; began: Unix time of the first message [s].
    """

    id: str
    key: str
    name: str
    user: str
    protocol: str
    platform: str
    began: float
    finished: bool = False


class LostMessagesError(InputError):
    """The log of a session has lost messages that were used already."""


class Queue:
    """Messages in the order of their identities; one waits for those before it, up to PATIENCE."""

    def __init__(self, ordered: bool):
        self._ordered, self.expected = ordered, -1
        self._waiting = list[tuple[int, int, Entry]]()
        self._arrived = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, entry: Entry) -> None:
        """Add a message that arrived."""
        self._arrived += 1
        heapq.heappush(self._waiting, (entry.identity if self._ordered else self._arrived, self._arrived, entry))

    def next(self, now: float) -> Entry | None:
        """The next message if it is its turn at the Unix time ``now`` [s], and remove it."""
        if not self._waiting or now < self.due:
            return None
        identity, _, entry = heapq.heappop(self._waiting)
        self.used(identity)
        return entry

    def used(self, identity: int) -> None:
        """Note that a message was used."""
        self.expected = max(self.expected, identity + 1)

    @property
    def due(self) -> float:
        """Unix time from which the next message may be used [s]; infinite without one."""
        if not self._waiting:
            return np.inf
        first = self._waiting[0]
        begins = self.expected < 0 and first[0] <= 1  # apps count from 0 or from 1
        if not self._ordered or begins or 0 <= first[0] <= self.expected or len(self._waiting) > MOST_WAITING:
            return -np.inf
        return min(entry.received for _, _, entry in self._waiting) + PATIENCE


class LiveWalk:
    """The estimate of one session. make: creates a navigator, with keyword arguments beside its own.

    Raises InputError if the folder's files are damaged; OSError if the disk fails.
    """

    def __init__(self, folder: Path, session: Session, make: Callable[..., Navigator], restored: Make, settings: Any):
        self.folder, self.session = folder, session
        self._make, self._restored, self._settings = make, restored, settings
        self.intake = Intake(session.protocol, session.platform)
        self._queue = Queue(session.protocol == SENSOR_LOGGER)
        self._read_until, self._used, self._turn = len(MAGIC), dict[int, None](), 0
        self._clock_error, self._refused, self._damaged = 0.0, 0, 0
        self.loss = ""  # messages that were used and are no longer in the log
        self._journal: Journal[Navigator] | None = None
        self._navigator: Navigator | None = None  # that the finalised part was read from
        self._finalised = 0  # number of rows published
        self._turns = storage.create_or_open(folder / TURNS, TURN, SCHEMA, {})
        self._turns.execute("PRAGMA synchronous = OFF")  # as of the journal: it survives the process; no wait for disks
        try:
            self._resume()
        except BaseException:
            self.close()
            raise

    def _resume(self) -> None:
        """Continue where the process ended: finish the message that was being used.

        Raises InputError if the files do not belong together, as after a power cut or from a backup of some of them.
        """
        with storage.explained(self.folder / TURNS, TURN):
            rows = self._turns.execute("SELECT turn, offset, events, intake FROM turn ORDER BY turn").fetchall()
        self._used = dict.fromkeys(row[1] for row in rows)
        if rows:
            turn = self._last_turn(rows)
            entries = {entry.offset: entry for entry in read_entries(self.folder / LOG)}
            lost = self._used.keys() - entries.keys()
            if turn.offset in lost:  # others may be damaged: the journal has their events
                raise LostMessagesError(self.folder / LOG, "", f"{count(len(lost), 'message')} less than used", "all")
            for offset in self._used:  # in their order
                if offset not in lost:
                    self._queue.used(entries[offset].identity)
            self._turn = turn.number
            self.intake = self._decoded(turn.intake, Intake)
            events = self._push(entries[turn.offset], turn.events)
            if turn.events or (self.folder / JOURNAL).exists():
                self._opened()
            known = 0 if self._journal is None else self._journal.count
            if not turn.events <= known <= turn.events + events:
                raise InputError(self.folder / JOURNAL, "", f"{known} events", f"those of {turn.number} messages")
        elif (self.folder / JOURNAL).exists():
            raise InputError(self.folder / TURNS, "", "no messages", f"those of {JOURNAL}")
        self.look()

    def _last_turn(self, rows: Sequence[tuple[int, int, int, bytes | None]]) -> Turn:
        """The last message used. Raises InputError if the rows are not as they were written."""
        *_, (number, offset, events, state) = rows
        turn = self._decoded(state or b"", Turn)
        in_order = [row[0] for row in rows] == list(range(1, len(rows) + 1)) and len(self._used) == len(rows)
        if not in_order or (number, offset, events) != (turn.number, turn.offset, turn.events):
            raise InputError(self.folder / TURNS, "", "damaged numbers of messages", "those that were written")
        return turn

    def _decoded(self, state: bytes, kind: type) -> Any:
        try:
            return decode(state, kind)
        except ValueError as error:
            raise InputError(self.folder / TURNS, "intake", str(error), "the state of an intake") from None

    def look(self) -> None:
        """Find the messages that arrived since the last look."""
        for entry in read_entries(self.folder / LOG, self._read_until):
            self._read_until = entry.end
            self._damaged += entry.skipped
            if entry.offset not in self._used:
                self._queue.add(entry)

    @property
    def due(self) -> float:
        """Unix time from which there is a message to use [s]; infinite if none waits."""
        return self._queue.due

    @property
    def waiting(self) -> int:
        """Number of messages that were not used yet."""
        return len(self._queue)

    def work(self, now: float) -> bool:
        """Use the next message if it is its turn at the Unix time ``now`` [s]; False if none is."""
        entry = self._queue.next(now)
        if entry is None:
            return False
        self._turn += 1
        events = 0 if self._journal is None else self._journal.count
        state = encode(Turn(self._turn, entry.offset, events, encode(self.intake)))
        row = (self._turn, entry.offset, events, state)
        with storage.explained(self.folder / TURNS, TURN):
            self._turns.execute("INSERT INTO turn VALUES (?, ?, ?, ?)", row)
            self._turns.execute("UPDATE turn SET intake = NULL WHERE turn = ?", (self._turn - 1,))
        self._used[entry.offset] = None
        self._push(entry, events)
        return True

    def _push(self, entry: Entry, begun: int) -> int:
        """Push the events of a message, without those that are in the journal already; returns their number.

        begun: events before it.
        """
        try:
            events = self.intake.events(read_body(self.folder / LOG, entry))
        except InputError:  # the door refuses these; one that it let pass by an older version
            self._refused += 1
            return 0
        if not events:
            return 0
        journal = self._opened()
        if journal.count < begun:
            raise InputError(self.folder / JOURNAL, "", count(journal.count, "event"), f"{begun} or more")
        for event in events[max(0, journal.count - begun) :]:
            try:
                journal.push(event)
            except (OSError, InputError):
                raise
            except Exception:  # the journal has restored the state before the event
                self._refused += 1
        at = self.intake.origin + (self.intake.latest if np.isfinite(self.intake.latest) else 0.0)
        self._clock_error = at - entry.received if self.intake.protocol == SENSOR_LOGGER else 0.0
        return len(events)

    def _opened(self) -> Journal[Navigator]:
        if self._journal is None:
            epoch = self.intake.origin
            self._journal = Journal.open(
                self.folder / JOURNAL,
                lambda: self._make(epoch=epoch),
                lambda state: self._restored(state, epoch=epoch),
                self._settings,
                durable="process",  # it is made from the messages
            )
            if self._journal.loss:  # the messages have what it lost
                raise InputError(self.folder / JOURNAL, "", self._journal.loss, "one that is whole")
        return self._journal

    def pose(self) -> dict[str, Any]:
        """The event ``pose``."""
        identity: dict[str, Any] = {"id": self.session.id, "name": self.session.name, "protocol": self.session.protocol}
        identity["message"] = self._turn
        navigator = self._opened_or_new()
        event = pose_json(identity, navigator.pose, navigator.status, navigator.frame, self._epoch)
        intake = self.intake
        event["issues"] += [f"{name}: {count(n, 'sample')} could not be used" for name, n in intake.unusable.items()]
        event["issues"] += self._issues()
        event["notes"] = list(intake.signs.notes)
        event["missing"] = [*intake.advice, *event["missing"]]
        return event | {"steps": navigator.steps, "ignored": dict(intake.ignored), "advice": list(intake.advice)}

    def _issues(self) -> Iterator[str]:
        # clock error [s] between the phone's clock and this machine's from which it is an issue
        if abs(self._clock_error) > 600.0:
            side = "ahead of" if self._clock_error > 0 else "behind"
            yield f"the phone's clock is {abs(self._clock_error) / 3600:.1f} h {side} this machine's"
        if self._refused:
            yield f"{count(self._refused, 'message')} could not be used"
        if self._damaged:
            yield f"{count(self._damaged, 'byte')} of {LOG} are damaged: the messages in them are lost"
        if self.loss:
            yield f"estimated anew from the messages that remain: {self.loss}"

    def _opened_or_new(self) -> Navigator:
        return self._make() if self._journal is None else self._journal.navigator

    @property
    def _epoch(self) -> float:
        return 0.0 if np.isnan(self.intake.origin) else self.intake.origin

    def path(self, whole: bool = False) -> dict[str, Any] | None:
        """The event ``path``; None before there is one. whole: from the first row."""
        if self._journal is None:
            return None
        navigator = self._journal.navigator
        current, new, sent = navigator.trajectory, None, 0 if whole else self._finalised
        if whole or navigator is not self._navigator:  # a snapshot has finalised more rows
            path = self._journal.trajectory
            new = _rows(path, sent, len(path) - len(current))
            self._navigator, self._finalised = navigator, len(path) - len(current)
        empty = _rows(current, 0, 0)
        columns = [path_columns(part, navigator.frame, self._epoch) for part in (new or empty, current)]
        return {"id": self.session.id, "from": sent, "finalised": columns[0], "current": columns[1]}

    def finish(self) -> tuple[dict[str, Any], dict[str, Any] | None]:
        """Use all messages, end the walk and return its last pose and its whole path; a later message resumes it."""
        while self.work(np.inf):
            pass
        pose = self.pose() | {"state": "finished"}
        if self._journal is None:
            return pose, None
        frame = self._journal.navigator.frame
        for event in self.intake.flush():  # not in the journal: a later message would complete their packet
            self._journal.navigator.push(event)
        path = self._journal.finish().trajectory
        empty = path_columns(_rows(path, 0, 0), frame, self._epoch)
        return pose, {
            "id": pose["id"],
            "from": 0,
            "finalised": path_columns(path, frame, self._epoch),
            "current": empty,
        }

    def close(self) -> None:
        """Close the files."""
        self._turns.close()
        if self._journal is not None:
            self._journal.close()
            self._journal = None


def _rows(path: Trajectory, begin: int, end: int) -> Trajectory:
    """The rows from ``begin`` to before ``end``."""
    rows = slice(begin, end)
    return Trajectory(path.time[rows], path.position[rows], path.heading[rows], path.floor[rows])


def opened(folder: Path, *arguments: Any) -> LiveWalk:
    """The walker of a folder; if its journal or order is damaged or of other options, restarted from its messages."""
    try:
        return LiveWalk(folder, *arguments)
    except InputError as error:
        for name in (TURNS, JOURNAL):
            for file in folder.glob(f"{name}*"):
                file.unlink()
        walk = LiveWalk(folder, *arguments)
        walk.loss = str(error) if isinstance(error, LostMessagesError) else ""
        return walk


def read_session(folder: Path) -> Session:
    """What the session of a folder is. Raises InputError if its file is damaged; OSError if it cannot be read."""
    file = folder / SESSION
    try:
        return storage.decode_json(file.read_text(encoding="utf-8"), Session)
    except ValueError as error:
        raise InputError(file, "", str(error), "a session: it comes back with the next message of its phone") from None


def write_session(folder: Path, session: Session) -> None:
    """Write what a session is. Raises OSError of the disk; an earlier file is then unchanged."""
    write(folder / SESSION, storage.encode_json(session).encode(), durable=True)
