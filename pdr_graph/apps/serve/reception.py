"""The sessions of all phones, on the side of the serving process: who may write to which, their logs, their end.

A message is in the log of its session before `Reception.receive` returns, which acknowledges it. Everything here runs
on the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import re
import shutil
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException

from pdr_graph.apps.lifelog.cache import write
from pdr_graph.apps.serve import sensor_messages
from pdr_graph.apps.serve.access import Allowance
from pdr_graph.apps.serve.estimators import Estimators
from pdr_graph.apps.serve.live_walk import (
    LOG,
    OF_RECEIVERS,
    PUBLISHED,
    RECORDINGS,
    SESSION,
    MessageLog,
    Session,
    read_session,
    write_session,
)
from pdr_graph.apps.serve.publishing import Hub, nowhere
from pdr_graph.apps.serve.sensor_messages import PLATFORMS, SENSOR_LOGGER
from pdr_graph.errors import InputError, one_line
from pdr_graph.io.sensor_logger import NANOSECOND
from pdr_graph.online.event_checks import AHEAD
from pdr_graph.storage import decode_json, encode_json

END_AGAIN = 60.0  # [s] after which a walk is ended again whose end the disk did not take
LATEST = 1 << 62  # [ns] Unix time that a sample may state
PLAIN_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True)
class Limits:
    """Limits of what a phone may send. Chosen by hand: a phone with five sensors at 100 Hz sends 50 kB/s.

    body: of a message [bytes]; samples: of a message; rate, user_rate: of a session and of a user on average [bytes/s],
    over ``burst`` seconds; sessions: that are not finished, of a user; idle: time without a message after which a
    session is finished [s], by protocol; silent: from which on a session may be ended for a new one [s]; shown: number
    of finished sessions on the page; open_logs: files that are kept open.
    """

    body: int = 8 << 20
    samples: int = 200_000
    rate: float = 1e6
    user_rate: float = 1e7
    burst: float = 30.0
    sessions: int = 200
    idle: float = 600.0
    idle_positions: float = 3 * 3600.0
    silent: float = 60.0
    shown: int = 50
    open_logs: int = 200


@dataclass
class State:
    """A session in memory. allowance: bytes that it may send; announced: its process has yet to look into its log;
    ending: it is being finished; behind: times from the last sample to the arrival of the last messages
    [s], the least of which is how far the phone's clock is behind this machine's, but for the fastest delivery.
    """

    session: Session
    allowance: Allowance
    last_received: float
    announced: bool = False
    ending: bool = False
    again: bool = False
    advice: tuple[str, ...] = ()
    shown_advice: set[str] = field(default_factory=set)
    timer: asyncio.TimerHandle | None = None
    behind: deque[float] = field(default_factory=lambda: deque(maxlen=60))


Finishing = Callable[[Path], Awaitable[str]]


class Reception:
    """All sessions below a folder. finishing: makes the recording of a finished one in its folder, and returns an issue
    or ""; say: called with a line about files that are left out.
    """

    def __init__(
        self,
        root: Path,
        hub: Hub,
        limits: Limits | None = None,
        finishing: Finishing | None = None,
        say: Callable[[str], None] = print,
    ):
        self.root, self.hub, self.limits = root, hub, limits or Limits()
        self._finishing, self._say = finishing, say
        self._states = dict[str, State]()
        self._allowances = dict[str, Allowance]()  # of users [bytes]
        self._logs = OrderedDict[str, MessageLog]()
        self._background = set[asyncio.Task[Any]]()
        self.estimators: Estimators | None = None

    # ── at the start ────────────────────────────────────────────────────────────────────────────────────────────────

    def load(self) -> None:
        """Read the sessions of earlier starts. Damaged ones are left alone, with a line for each."""
        self.root.mkdir(parents=True, exist_ok=True, mode=0o700)
        finished = list[tuple[float, Session, Path]]()
        for log in self.root.glob(f"*/{LOG}"):
            if not (file := log.with_name(SESSION)).exists():
                self._say(f"session left out: {file}: found no such file beside its messages, {log}")
        for file in self.root.glob(f"*/{SESSION}"):
            try:
                session = read_session(file.parent)
                log = file.parent / LOG
                last = log.stat().st_mtime if log.exists() else session.began
            except (OSError, InputError) as error:
                self._say(f"session left out: {one_line(str(error))}")
                continue
            self._states[session.id] = State(session, Allowance(self.limits.rate, self.limits.burst), last)
            if session.finished:
                finished.append((last, session, file.parent))
            else:
                self.hub.pose(session.user, blank_pose(session))
        for _, session, folder in sorted(finished, key=lambda row: row[0])[-self.limits.shown :]:
            try:
                published = decode_json((folder / PUBLISHED).read_text(encoding="utf-8"), dict)
                self.hub.pose(session.user, published["pose"])
                self.hub.path({"id": session.id, "from": 0, **published["path"]})
            except (OSError, ValueError, LookupError, TypeError) as error:
                issue = f"{PUBLISHED}, its last pose and path: {one_line(str(error))}"
                self.hub.pose(session.user, blank_pose(session) | {"state": "finished", "issues": [issue]})
        for _, session, _ in sorted(finished, key=lambda row: row[0]):
            if not (session.recorded and self.recording(session.id)):  # the server ended before
                self._in_background(self._record(self._states[session.id]))

    def started(self, number: int) -> None:
        """Tell an estimating process that has started of its unfinished sessions."""
        for state in self._states.values():
            if not state.session.finished and self._estimators.number_of(state.session.id) == number:
                self._announce(state, again=True)
                self._set_timer(state)

    # ── messages ────────────────────────────────────────────────────────────────────────────────────────────────────

    def receive(
        self, protocol: str, user: str, body: bytes, platform: str = "", name: str = "", device: str = ""
    ) -> str:
        """Log a message; returns a text to show to the user of the phone, once, or "".

        protocol: SENSOR_LOGGER or that of an app for positions; platform: "ios" or "android" if it was stated; name: of
        the device if the message has none; device: its name, whatever a message of positions says. Raises
        HTTPException, and InputError for a malformed message.
        """
        if platform and platform not in PLATFORMS:
            raise HTTPException(400, f"found platform {one_line(platform)[:40]!r}, expected ios or android")
        if len(body) > self.limits.body:
            raise HTTPException(413, f"found more than {self.limits.body >> 20} MB, expected smaller messages")
        if protocol == SENSOR_LOGGER:
            if sensor_messages.is_test(body):
                return ""
            message = sensor_messages.parse(body)
            if (samples := len(message.payload)) > self.limits.samples:
                raise HTTPException(413, f"found {samples} samples in a message, expected up to {self.limits.samples}")
            key, identity, phone = message.sessionId, message.messageId, message.deviceId
            sampled = [sample.time for sample in message.payload]
            label = one_line(name or f"phone {message.deviceId[:8]}".strip())[:64]
        else:
            stated, fixes = sensor_messages.parse_positions(protocol, body)
            if not len(fixes):
                return ""  # a message without a position, as apps send them
            key = label = one_line(device or stated or name or "phone")[:64]
            phone, sampled = "", []
            identity = int.from_bytes(hashlib.sha256(body).digest()[:7], "big")
        now = time.time()
        try:
            state = self._state(protocol, user, key, label, platform, phone)
            self._charge(state, len(body))
            if self._log(state.session.id).add(identity, now, body):
                state.last_received, state.ending = now, False
                if sampled:
                    state.behind.append(now - min(max(sampled), LATEST) * NANOSECOND)
                self._announce(state)
        except OSError as error:
            text = f"the disk of the server: {error.strerror or error}"
            raise HTTPException(507, text, {"Retry-After": "30"}) from None
        except InputError as error:  # the log is damaged beyond its messages
            raise HTTPException(500, f"the disk of the server: {error}") from None
        self._set_timer(state)
        fresh = [line for line in state.advice if line not in state.shown_advice]
        state.shown_advice.update(fresh)
        return "; ".join(fresh)

    def hear(self, is_of: Callable[[Session], bool], receiver: str, rssi: float) -> None:
        """Log that a fixed receiver hears the phone of a walk under way, as the phone's own sample of a beacon.

        Without such a walk, or with those of two phones, nothing is logged. It does not keep the walk from its end.
        rssi [dBm].
        """
        now, walks = time.time(), dict[str, State]()
        for state in sorted(self._states.values(), key=lambda state: state.last_received):
            under_way = state.behind and not (state.session.finished or state.ending)
            current = now - state.last_received < AHEAD  # else the navigator leaves it out
            if under_way and current and is_of(state.session):
                walks[state.session.phone] = state
        if len(walks) != 1:
            return
        [state] = walks.values()
        values = {"id": receiver, "rssi": rssi}
        sample = {"name": "bluetooth", "time": round((now - min(state.behind)) / NANOSECOND), "values": values}
        message = {"messageId": 0, "sessionId": state.session.key, "payload": [sample]}
        with contextlib.suppress(OSError, InputError):  # what is wrong with the disk, the phone is told
            if self._log(state.session.id).add(OF_RECEIVERS + round(1e6 * now), now, encode_json(message).encode()):
                self._announce(state)

    def _state(self, protocol: str, user: str, key: str, label: str, platform: str, phone: str) -> State:
        """The session of a message, which its first one creates; a finished one is resumed. Raises HTTPException.

        Positions name no session: a new one of their device begins after a long silence. A second phone with the name
        of a session has one of its own, since the messages of both are numbered from the same number.
        """
        id_ = id_of(key)
        if (named := self._states.get(id_)) is not None and named.session.phone not in ("", phone):
            id_ = id_of(f"{key} {phone}")
        if protocol != SENSOR_LOGGER:
            names = (protocol, user, key)
            earlier = [s for s in self._states.values() if (s.session.protocol, s.session.user, s.session.key) == names]
            last = max(earlier, key=lambda state: state.last_received, default=None)
            device = hashlib.sha256("\0".join(names).encode()).hexdigest()[:12]
            id_ = f"{protocol}~{device}~{time.time():.0f}"  # no id that a message of Sensor Logger can name
            if last is not None and not last.session.finished:
                id_ = last.session.id
        state = self._states.get(id_)
        if state is None:
            self._make_room(user)
            session = Session(id_, key, label, user, protocol, platform, time.time(), phone=phone)
            (self.root / id_).mkdir(exist_ok=True, mode=0o700)
            state = State(session, Allowance(self.limits.rate, self.limits.burst), session.began)
            self._store(state, session)
            self._states[id_] = state
            self.hub.pose(user, blank_pose(session))
        if state.session.user != user:
            raise HTTPException(403, "found a session of another user, expected one of the user of this token")
        if state.session.finished:
            self._store(state, replace(state.session, finished=False))
        return state

    def _make_room(self, user: str) -> None:
        """End the session that has been silent longest if a user has the most; HTTPException 429 if none is silent."""
        unfinished = [
            s for s in self._states.values() if s.session.user == user and not (s.session.finished or s.ending)
        ]
        if len(unfinished) < self.limits.sessions:
            return
        quietest = min(unfinished, key=lambda state: state.last_received)
        if time.time() - quietest.last_received < self.limits.silent:
            text = f"found {len(unfinished)} unfinished sessions of this user, expected fewer"
            raise HTTPException(429, text, {"Retry-After": f"{self.limits.silent:.0f}"})
        self.finish(quietest.session.id)

    def _store(self, state: State, session: Session) -> None:
        """Write what a session is; a power cut leaves the former file or this one."""
        write_session(self.root / session.id, session)
        state.session = session

    def _charge(self, state: State, size: int) -> None:
        """Raise HTTPException if a session, or its user, sends more than its rate."""
        limits, user = self.limits, state.session.user
        of_user = self._allowances.setdefault(user, Allowance(limits.user_rate, limits.burst))
        for allowance, rate, of in ((state.allowance, limits.rate, "session"), (of_user, limits.user_rate, "user")):
            if wait := allowance.use(size):
                text = f"found more than {rate / 1e6:.1f} MB/s of a {of}, expected a phone's sensors"
                raise HTTPException(429, text, {"Retry-After": f"{wait + 1:.0f}"})

    def _log(self, id_: str) -> MessageLog:
        if id_ not in self._logs:
            self._logs[id_] = MessageLog(self.root / id_ / LOG)
            while len(self._logs) > self.limits.open_logs:
                self._close(next(iter(self._logs)))
        self._logs.move_to_end(id_)
        return self._logs[id_]

    def _announce(self, state: State, again: bool = False) -> None:
        """Tell the estimating process that there are messages, unless it has yet to look for earlier ones."""
        if state.announced and not again:
            state.again = True
            return
        state.announced, state.again = True, False
        self._estimators.tell("new", state.session.id)

    @property
    def _estimators(self) -> Estimators:
        assert self.estimators is not None
        return self.estimators

    # ── updates of the estimating processes ─────────────────────────────────────────────────────────────────────────

    def update(self, kind: str, update: dict[str, Any]) -> None:
        """Take an update of an estimating process."""
        state = self._states.get(update.get("id", ""))
        if state is None:
            if kind == "forgotten":  # what the process wrote while the files were deleted
                shutil.rmtree(self.root / update["id"], ignore_errors=True)
            return
        if kind == "looked":
            state.announced = False
            if state.again:
                self._announce(state)
        elif kind == "pose":
            state.advice = tuple(update.pop("advice", ()))
            self.hub.pose(state.session.user, update)
        elif kind == "path":
            self.hub.path(update)
        elif kind == "finished":
            self._in_background(self._finished(state))
        elif kind == "failed":
            published = self.hub.walkers.get(state.session.id)
            pose = published.pose if published else blank_pose(state.session)
            issue = f"the estimate failed: {update['text']}"
            self.hub.pose(state.session.user, pose | {"issues": [issue]})

    def sessions(self) -> list[Session]:
        """All sessions, also finished ones."""
        return [state.session for state in self._states.values()]

    # ── the end of a session ────────────────────────────────────────────────────────────────────────────────────────

    def _set_timer(self, state: State) -> None:
        """Finish a session when it has been silent for long."""
        if state.timer is None:
            delay = max(0.0, self._end(state) - time.time())
            state.timer = asyncio.get_running_loop().call_later(delay, self._idle, state)

    def _end(self, state: State) -> float:
        """Unix time at which a session ends unless a message comes [s]."""
        sensors = state.session.protocol == SENSOR_LOGGER
        return state.last_received + (self.limits.idle if sensors else self.limits.idle_positions)

    def _idle(self, state: State) -> None:
        state.timer = None
        if state.session.finished or state.session.id not in self._states:
            return
        if time.time() < self._end(state):
            self._set_timer(state)
        else:
            self.finish(state.session.id)

    def finish(self, id_: str) -> None:
        """End a session: its recording is made, and it is part of the lifelog. A later message resumes it."""
        if (state := self._states.get(id_)) is not None:
            state.ending = True
        self._estimators.tell("finish", id_)

    async def _finished(self, state: State) -> None:
        """Store what is published of a finished session, and make its recording."""
        if state.announced:
            return  # a message came meanwhile
        walker = self.hub.walkers.get(state.session.id)
        try:
            if walker is not None:
                path = {"finalised": walker.path()["finalised"], "current": walker.current}
                published = encode_json({"pose": walker.pose, "path": path}).encode()
                write(self.root / state.session.id / PUBLISHED, published, durable=True)
            self._store(state, replace(state.session, finished=True, recorded=False))
        except OSError as error:
            issue = f"the disk of the server: {error.strerror or error}; the end is tried again"
            if walker is not None:
                self.hub.pose(state.session.user, walker.pose | {"issues": [issue]})
            asyncio.get_running_loop().call_later(END_AGAIN, self._end_again, state)
            return
        self._close(state.session.id)
        ended = [
            each for each in self._states.values() if each.session.finished and each.session.id in self.hub.walkers
        ]
        for each in sorted(ended, key=lambda each: each.last_received)[: -self.limits.shown]:
            self.hub.retire(each.session.id)
        await self._record(state)

    def _end_again(self, state: State) -> None:
        if state.ending and state.session.id in self._states:  # no message since
            self.finish(state.session.id)

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    async def _record(self, state: State) -> None:
        """Make the recording of a finished session; what prevents it is an issue, and the next start tries it again."""
        if self._finishing is None:
            return
        id_ = state.session.id
        issue, walker = await self._finishing(self.root / id_), self.hub.walkers.get(id_)
        if not state.session.finished or id_ not in self._states:
            return  # resumed or deleted meanwhile
        if not issue:
            self._store(state, replace(state.session, recorded=True))
        elif walker is not None:
            self.hub.pose(state.session.user, walker.pose | {"issues": [*walker.pose["issues"], issue]})

    def forget(self, id_: str) -> None:
        """Delete a session with all its files."""
        state = self._states.pop(id_, None)
        if state is None:
            return
        if state.timer is not None:
            state.timer.cancel()
        self._close(id_)
        self._estimators.tell("forget", id_)
        shutil.rmtree(self.root / id_, ignore_errors=True)
        self.hub.forget(id_)

    def recording(self, id_: str) -> Path | None:
        """The file of a session's recording; None before it is finished."""
        files = (self.root / id_ / name for name in RECORDINGS)
        return next((file for file in files if file.exists()), None)

    def close(self) -> None:
        """Close all files."""
        for id_ in list(self._logs):
            self._close(id_)

    def _close(self, id_: str) -> None:
        if id_ in self._logs:
            self._logs.pop(id_).close()


def id_of(key: str) -> str:
    """The id, in addresses and of the folder, of the session that Sensor Logger names ``key``."""
    return key if PLAIN_ID.fullmatch(key) else hashlib.sha256(key.encode()).hexdigest()[:32]


def blank_pose(session: Session) -> dict[str, Any]:
    """The event ``pose`` of a session without an estimate yet."""
    pose: dict[str, Any] = {"id": session.id, "name": session.name, "protocol": session.protocol, "message": 0}
    pose |= {"state": "waiting", "missing": [], "issues": [], "health": {}, "ignored": {}, "steps": 0}
    return pose | nowhere()
