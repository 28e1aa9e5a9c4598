"""One walker: the messages of a session, in order, through a navigator; at its end the recording.

The folder of a session has ``messages.log``: what the phone sent, written before it is acknowledged. Everything else is
a function of it, so that after the process was killed at any moment the same messages lead to the same walk. The
recording of a finished session is a zip as Sensor Logger exports it, or a GPX track.
"""

from __future__ import annotations

import heapq
import time
import zipfile
from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

import numpy as np

from pdr_graph import storage
from pdr_graph.apps.lifelog.cache import write
from pdr_graph.apps.serve import sensor_messages
from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.publishing import path_columns, pose_json
from pdr_graph.apps.serve.sensor_messages import SENSOR_LOGGER, USED_COLUMNS, Intake
from pdr_graph.errors import InputError, count
from pdr_graph.io import gpx
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.io.writers import cell
from pdr_graph.online.interface import Event
from pdr_graph.online.journal import END, MESSAGES, Entry, RecordLog, read_body, read_entries
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Trajectory

LONGEST_WAIT = 2.0  # [s] for which a message waits for those before it
MOST_PARTS = 100  # of a path, in memory
MOST_WAITING = 64  # messages that wait for one; then it is given up
OF_RECEIVERS = -(1 << 62)  # identities of what receivers hear are negative, and grow: none waits for another
LOG, SESSION, PUBLISHED = "messages.log", "session.json", "published.json"
NOT_RECORDED = "the recording could not be completed"
RECORDINGS = ("recording.zip", "recording.gpx")  # of a finished session: of sensors, of positions alone


@dataclass(frozen=True)
class Session:
    """What a session is.

    id: in addresses; key: the app's name of it; name: for people; user: to whom it belongs; protocol: of its messages;
    platform: "ios" or "android" if it was stated; began: Unix time of the first message [s];
    phone: the app's name of it, if it states one; recorded: False from its end until its recording is made.
    """

    id: str
    key: str
    name: str
    user: str
    protocol: str
    platform: str
    began: float
    finished: bool = False
    phone: str = ""
    recorded: bool = True


class Numbers:
    """A set of numbers, as ranges: of numbers that follow one another it needs 16 bytes."""

    def __init__(self) -> None:
        self._begins, self._ends = array("q"), array("q")  # ends are not in their range

    def __contains__(self, number: int) -> bool:
        before = bisect_right(self._begins, number)
        return before > 0 and number < self._ends[before - 1]

    def add(self, number: int) -> None:
        """Add a number that is not in the set."""
        at = bisect_right(self._begins, number)
        joins_before = at > 0 and self._ends[at - 1] == number
        joins_after = at < len(self._begins) and self._begins[at] == number + 1
        if joins_before and joins_after:
            self._ends[at - 1] = self._ends[at]
            del self._begins[at], self._ends[at]
        elif joins_before:
            self._ends[at - 1] += 1
        elif joins_after:
            self._begins[at] -= 1
        else:
            self._begins.insert(at, number)
            self._ends.insert(at, number + 1)


class MessageLog(RecordLog):
    """The log of a session, open for appending; ``identities`` of all its messages.

    It is also the queue between the process that receives and the one that estimates: waiting messages cost no memory.
    Raises InputError if the file is no log.
    """

    def __init__(self, path: Path):
        super().__init__(path, MESSAGES)
        self.identities = Numbers()
        try:
            for entry in read_entries(path):
                if entry.identity not in self.identities:
                    self.identities.add(entry.identity)
        except BaseException:
            self.close()
            raise

    def add(self, identity: int, received: float, body: bytes) -> bool:
        """Append a message; False if one of this identity is there already. Raises OSError if the disk fails."""
        if identity in self.identities:
            return False
        self.append(identity, received, body)
        self.identities.add(identity)
        return True


class Queue:
    """Messages in the order of their identities; one waits for those before it, up to LONGEST_WAIT.

    The order depends on their identities and times of arrival, not on the moments at which `next` is called: it is the
    same when the log is read again.
    """

    def __init__(self, ordered: bool):
        self._ordered, self._expected = ordered, -1
        self._arrived = deque[tuple[float, Entry]]()  # with the time of arrival [s], by a clock that is never set back
        self._waiting = list[tuple[int, int, float, Entry]]()
        self._clock = self._latest = 0.0  # [s] of the last arrival, by that clock and by this machine's
        self._count = 0

    def __len__(self) -> int:
        return len(self._arrived) + len(self._waiting)

    def add(self, entry: Entry) -> None:
        """Add a message that arrived."""
        self._clock += max(0.0, entry.received - self._latest)  # it stands still where this machine's is set back
        self._latest = entry.received
        self._arrived.append((self._clock, entry))

    def next(self, now: float) -> Entry | None:
        """The next message if it is its turn at the Unix time ``now`` [s], and remove it."""
        if now < self.due or not self._waiting:  # also moves what has arrived
            return None
        identity, _, _, entry = heapq.heappop(self._waiting)
        self._expected = max(self._expected, identity + 1)
        return entry

    @property
    def due(self) -> float:
        """Unix time from which the next message may be used [s]; infinite without one."""
        while self._arrived and self._first_due() > self._arrived[0][0]:
            arrival, entry = self._arrived.popleft()
            self._count += 1
            identity = entry.identity if self._ordered else self._count
            heapq.heappush(self._waiting, (identity, self._count, arrival, entry))
        return self._first_due() - self._clock + self._latest

    def _first_due(self) -> float:
        """`due` of the messages that wait."""
        if not self._waiting:
            return np.inf
        first = self._waiting[0][0]
        begins = self._expected < 0 and first <= 1  # apps count from 0 or from 1
        if not self._ordered or begins or first <= self._expected or len(self._waiting) > MOST_WAITING:
            return -np.inf
        return min(arrival for _, _, arrival, _ in self._waiting) + LONGEST_WAIT


class LiveWalk:
    """The estimate of one session. make: creates a navigator, with keyword arguments beside its own.

    After a restart of the process, its messages wait to be used again. Raises InputError if the log is damaged; OSError
    if the disk fails.
    """

    def __init__(self, folder: Path, session: Session, make: Callable[..., Navigator]):
        self.folder, self.session, self._make = folder, session, make
        self.intake = Intake(session.protocol, session.platform)
        self._queue = Queue(session.protocol == SENSOR_LOGGER)
        self._read_until, self._used, self._opened = len(MESSAGES), 0, time.time()
        self._last_received, self._clock_error = -np.inf, 0.0  # [s]
        self._refused, self._damaged, self._unfinished = 0, 0, 0
        self._navigator: Navigator | None = None  # from the first event on
        self._finalised = list[Trajectory]()
        self.look()

    def look(self) -> None:
        """Find the messages that arrived since the last look."""
        for entry in read_entries(self.folder / LOG, self._read_until):
            self._read_until = entry.end
            self._damaged += entry.skipped
            self._queue.add(entry)
        self._unfinished = max(0, (self.folder / LOG).stat().st_size - len(END) - self._read_until)

    @property
    def due(self) -> float:
        """Unix time from which there is a message to use [s]; infinite if none waits."""
        return self._queue.due

    @property
    def waiting(self) -> int:
        """Number of messages that were not used yet."""
        return len(self._queue)

    @property
    def catching_up(self) -> bool:
        """True while messages wait that arrived before this process opened the walk."""
        return bool(self._queue) and self._last_received < self._opened

    def work(self, now: float) -> bool:
        """Use the next message if it is its turn at the Unix time ``now`` [s]; False if none is."""
        entry = self._queue.next(now)
        if entry is None:
            return False
        self._used += 1
        self._last_received = entry.received
        try:
            events = self.intake.events(read_body(self.folder / LOG, entry), entry.received)
        except InputError:  # the door refuses these; one that it let pass by an older version
            self._refused += 1
            return True
        self._push(events)
        sensed, at = np.isfinite(self.intake.latest), self.intake.origin + self.intake.latest
        if events or not sensed:  # positions that are long ahead give no event
            # Positions alone may be queued: late is no error
            self._clock_error = at - entry.received if sensed else max(self.intake.ahead, 0.0)
        return True

    def _push(self, events: Sequence[Event]) -> None:
        for event in events:
            if self._navigator is None:
                platform = "" if self.intake.signs.guessed else "android"  # whose signs the events have
                self._navigator = self._make(epoch=self.intake.origin, platform=platform)
            try:
                self._navigator.push(event)
            except OSError:
                raise
            except Exception:  # no data may end a walk
                self._refused += 1

    def pose(self) -> dict[str, Any]:
        """The event ``pose``."""
        identity: dict[str, Any] = {"id": self.session.id, "name": self.session.name, "protocol": self.session.protocol}
        identity["message"] = self._used
        navigator = self._make() if self._navigator is None else self._navigator
        event = pose_json(identity, navigator.pose, navigator.status, navigator.frame, self._epoch)
        intake = self.intake
        event["issues"] += [f"{name}: {count(n, 'sample')} could not be used" for name, n in intake.unusable.items()]
        event["issues"] += self._issues()
        event["notes"] = list(intake.signs.notes)
        event["missing"] = [*intake.advice, *event["missing"]]
        return event | {"steps": navigator.steps, "ignored": dict(intake.ignored), "advice": list(intake.advice)}

    def _issues(self) -> Iterator[str]:
        # ten minutes between the phone's clock and this machine's are an issue
        if abs(self._clock_error) > 600.0:
            side = "ahead of" if self._clock_error > 0 else "behind"
            yield f"the phone's clock is {abs(self._clock_error) / 3600:.1f} h {side} this machine's"
        if self._refused:
            yield f"{count(self._refused, 'message')} could not be used"
        if damaged := self._damaged + self._unfinished:
            yield f"{count(damaged, 'byte')} of {LOG} are damaged: the messages in them are lost"

    @property
    def _epoch(self) -> float:
        return 0.0 if np.isnan(self.intake.origin) else self.intake.origin

    def path(self, whole: bool = False) -> dict[str, Any] | None:
        """The event ``path``; None before there is one. whole: from the first row."""
        navigator = self._navigator
        if navigator is None:
            return None
        sent = 0 if whole else sum(map(len, self._finalised))
        new = navigator.finalized()
        self._finalised += [new] * (len(new) > 0)
        if len(self._finalised) > MOST_PARTS:  # a part has a kilobyte beside its rows
            self._finalised = [_joined(self._finalised)]
        return self._path_event(navigator, sent, _joined(self._finalised) if whole else new, navigator.trajectory)

    def _path_event(
        self, navigator: Navigator, sent: int, finalised: Trajectory, current: Trajectory
    ) -> dict[str, Any]:
        """The event ``path``. sent: number of finalised points in earlier events."""
        parts = {"finalised": finalised, "current": current}
        columns = {name: path_columns(part, navigator.frame, self._epoch) for name, part in parts.items()}
        return {"id": self.session.id, "from": sent, **columns}

    def finish(self) -> tuple[dict[str, Any], dict[str, Any] | None]:
        """Use all messages, end the walk and return its last pose and its whole path; then it takes no more."""
        while self.work(np.inf):
            pass
        pose = self.pose() | {"state": "finished"}
        navigator = self._navigator
        if navigator is None:
            return pose, None
        self._push(self.intake.flush())
        path = _joined([*self._finalised, navigator.finish().trajectory])
        return pose, self._path_event(navigator, 0, path, _joined([]))


def _joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Concatenate trajectories that follow one another, without their covariance."""
    return Trajectory(
        np.concatenate([np.empty(0), *(part.time for part in parts)]),
        np.concatenate([np.empty((0, 2)), *(part.position for part in parts)]),
        np.concatenate([np.empty(0), *(part.heading for part in parts)]),
        tuple(label for part in parts for label in part.floor),
    )


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


COLUMNS = {**USED_COLUMNS, "bluetooth": ("id", "rssi")}  # name in a message: columns of its table


def write_recording(folder: Path) -> Path:
    """Write the recording of a session into its folder, from its log; returns the file.

    Raises InputError if the log is damaged or has no samples; OSError of the disk.
    """
    session = read_session(folder)
    of_sensors = session.protocol == SENSOR_LOGGER and _has_sensors(folder)
    target = folder / RECORDINGS[0 if of_sensors else 1]
    new = target.with_name(f"new-{target.name}")
    new.unlink(missing_ok=True)
    new.touch(mode=0o600)
    write = _write_export if of_sensors else _write_track
    write(new, folder, session)
    new.replace(target)
    return target


def _messages(folder: Path, ordered: bool) -> Iterator[bytes]:
    """The messages of a log, by their identity or as they came; the phone's before those of receivers."""
    entries = list(read_entries(folder / LOG))
    for entry in sorted(entries, key=lambda entry: (entry.identity < 0, entry.identity)) if ordered else entries:
        yield read_body(folder / LOG, entry)


def _has_sensors(folder: Path) -> bool:
    """True if messages of Sensor Logger have more than positions: a walk needs an accelerometer."""
    payloads = (sensor_messages.samples_of(body) for body in _messages(folder, ordered=False))
    return any("accelerometer" in sample.name.lower() for payload in payloads for sample in payload)


def _write_export(file: Path, folder: Path, session: Session) -> None:
    """Write tables as the app does, in its units and signs, as the numbers came."""
    signs, start = sensor_messages.Signs(), 0
    with TemporaryDirectory(dir=folder) as scratch, ExitStack() as files:
        tables = dict[str, TextIO]()
        for body in _messages(folder, ordered=True):
            payload = sensor_messages.samples_of(body)
            if not signs.acceleration:  # as the live walk decided
                columns, _ = sensor_messages.tables_of(payload)
                android = sensor_messages.from_android(payload)
                sensor_messages.signals_of(columns, signs, session.platform, android)
            for sample in sorted(payload, key=lambda sample: sample.time):
                name, time = sample.name.lower(), int(sample.time)
                if name not in COLUMNS:
                    continue
                start = start or time
                if name not in tables:  # as the app names it: AccelerometerUncalibrated.csv
                    title = f"{name.capitalize().replace('uncalibrated', 'Uncalibrated')}.csv"
                    tables[name] = files.enter_context((Path(scratch) / title).open("w", encoding="utf-8"))
                    tables[name].write(f"time,seconds_elapsed,{','.join(COLUMNS[name])}\n")
                cells = ",".join(_cell(getattr(sample.values, column)) for column in COLUMNS[name])
                tables[name].write(f"{time},{(time - start) * sensor_messages.NANOSECOND:.6f},{cells}\n")
        if not tables:
            raise InputError(folder, "", "no samples", "a session with samples")
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for table in tables.values():
                table.flush()
                archive.write(table.name, Path(table.name).name)
            if signs.acceleration:
                platform = "ios" if signs.acceleration < 0 else "android"
                archive.writestr("Metadata.csv", f"platform,recording epoch time\n{platform},{start // 10**6}\n")


def _cell(value: Any) -> str:
    """A value as a cell of a CSV; empty for what is neither text nor number."""
    return cell(value) if isinstance(value, str) else repr(value) if isinstance(value, int | float) else ""


def _write_track(file: Path, folder: Path, session: Session) -> None:
    """Write the positions as GPX, with their accuracies."""
    fixes = [sensor_messages.positions_of(session.protocol, body) for body in _messages(folder, ordered=False)]
    rows = np.concatenate([np.empty((0, 4)), *(np.column_stack([f.time, f.position, f.sigma]) for f in fixes if f)])
    if not len(rows):
        raise InputError(folder, "", "no samples", "a session with samples")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    points = gpx.Points(rows[:, 1:3], rows[:, 0], RADIUS_68 * rows[:, 3])
    file.write_bytes(gpx.document([gpx.Track(session.name, (points,))]))


def finish(folder: Path, store: Path | None, plan: Path | None) -> str:
    """Write the recording of a session, and add it to a lifelog, whose day is reconstructed; returns an issue, or "".

    Runs in a process of its own.
    """
    from pdr_graph.apps.lifelog.build import build
    from pdr_graph.apps.lifelog.ingest import DEFAULT_PERSON, add
    from pdr_graph.apps.lifelog.store import RecordingOptions

    try:
        file, user = write_recording(folder), read_session(folder).user
        if store is not None:
            person = DEFAULT_PERSON if user == OWNER else user
            added = add(store, [file], RecordingOptions(plan=plan), person=person, copy=True)
            if added.refused:
                raise InputError(store, "", added.refused[0], "a recording that the lifelog takes")
            build(store)
    except (InputError, OSError) as error:
        return f"{NOT_RECORDED}: {error}"
    return ""  # a damaged log is an issue of the walk
