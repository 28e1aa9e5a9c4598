"""What the server fetches by itself: phones with phyphox, messages of a broker, recordings of a study.

A phone with phyphox is the server of its data: its remote access is polled once a second.
Source: "Remote-interface communication" of phyphox-docs: ``/config`` names the buffers of each sensor, ``/get`` returns
the values of a buffer at which a reference buffer exceeds a threshold, ``/time`` maps experiment time to system time.
The phone drops kept-alive connections, so that each request has a connection of its own. ``/get`` has eight digits, and
null for a value that is not finite.

Data are cleared by the user without a new session: the times begin again, and so does the list of ``/time``. A run is
therefore one session *and* one first start; another run is another walk.

What is new becomes messages as Sensor Logger sends them, so that phones of both apps have one way from there on.
"""

from __future__ import annotations

import asyncio
import os
import re
import ssl
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote, urlsplit

import msgspec
import numpy as np
from starlette.exceptions import HTTPException

from pdr_graph.apps.serve import sensor_messages
from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.live_walk import LOG
from pdr_graph.apps.serve.reception import Reception, id_of
from pdr_graph.apps.serve.sensor_messages import OWNTRACKS, SENSOR_LOGGER
from pdr_graph.apps.serve.study import StudyReports
from pdr_graph.errors import InputError, install, one_line
from pdr_graph.io.phyphox import ExperimentClock
from pdr_graph.online.journal import read_body, read_entries
from pdr_graph.types import Array
from pdr_graph.web_request import TooLongError, request

if TYPE_CHECKING:
    from pdr_graph.apps.serve.home_assistant import Alert, MotionSensors
    from pdr_graph.apps.serve.receivers import Receivers

POLL_INTERVAL = 1.0  # [s] between two polls
POLL_TIMEOUT, LONGEST_ANSWER = 5.0, 60.0  # [s] for the phone to answer or go on; for a whole answer
HISTORY = 600.0  # [s] of an experiment under way that the first poll asks for
FIRST_RETRY, LAST_RETRY = 2.0, 30.0  # [s] after a fault of the phone, doubled each time
PHYPHOX_OUTPUTS = {  # of phyphox: ours, and its outputs
    "accelerometer": ("accelerometer", "xyz"),
    "linear_acceleration": ("linear_acceleration", "xyz"),
    "gyroscope": ("gyroscope", "xyz"),
    "magnetic_field": ("magnetometer", "xyz"),
    "pressure": ("barometer", "x"),
}
LOCATION = ("lat", "lon", "accuracy")
Say = Callable[[str], None]  # prints one line
MESSAGE_NAMES = {  # ours: Sensor Logger's, which has gravity in the uncalibrated accelerometer alone
    "accelerometer": ("accelerometeruncalibrated", "xyz"),
    "linear_acceleration": ("accelerometer", "xyz"),
    "gyroscope": ("gyroscope", "xyz"),
    "magnetometer": ("magnetometer", "xyz"),
    "barometer": ("barometer", ("pressure",)),
    "location": ("location", ("latitude", "longitude", "horizontalAccuracy")),
}
PLATFORM = "android"  # phyphox has the signs of Android on iPhones too
# Errors of reading an answer that is not phyphox's
UNREADABLE_ANSWER = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError)


class PhoneError(OSError):
    """The phone did not answer, or not as phyphox does; a line of text."""


@dataclass(frozen=True)
class Stored:
    """What is stored of a run: its number of messages, and the last time [s] of each sensor in the last one."""

    messages: int
    last: dict[str, float]


@dataclass(frozen=True)
class Input:
    """A sensor of the experiment: its name here, the buffer of its times and those of its values."""

    sensor: str
    time: str
    values: tuple[str, ...]


@dataclass(frozen=True)
class Poll:
    """New data of a run.

    run: identity of the walk, empty while there is none; name: of the phone; measuring: False while paused; tables:
    per sensor ``(n, 1 + k)`` Unix times [s] and values, of ``location`` latitude, longitude [deg] and accuracy (68 %
    radius) [m]; ignored: inputs of the experiment that are not used.
    """

    run: str
    name: str
    measuring: bool
    tables: dict[str, Array]
    ignored: tuple[str, ...] = ()


def inputs_of(config: Mapping[str, Any]) -> tuple[list[Input], list[str]]:
    """The usable sensors in an answer of ``/config``, and the names of the others."""
    used, ignored = list[Input](), list[str]()
    for each in config.get("inputs", ()):
        outputs = {key: name for output in each.get("outputs", ()) for key, name in output.items()}
        ours, axes = PHYPHOX_OUTPUTS.get(each.get("source"), ("", ""))
        if each.get("source") == "location":
            ours, axes = "location", [key for key in LOCATION if key in outputs or key != "accuracy"]
        if ours and "t" in outputs and all(axis in outputs for axis in axes):
            used.append(Input(ours, outputs["t"], tuple(outputs[axis] for axis in axes)))
        else:
            ignored.append(str(each.get("source")))
    return used, ignored


def query(inputs: Sequence[Input], since: Mapping[str, float]) -> str:
    """The query of ``/get`` for values after the times ``since`` [s] of each time buffer."""
    asked: dict[str, str] = {}
    for each in inputs:
        threshold = f"{since[each.time]:.7f}"
        asked[each.time] = threshold
        asked |= {name: f"{threshold}|{each.time}" for name in each.values}
    return "&".join(f"{quote(name)}={quote(value)}" for name, value in asked.items())


def rows_of(buffers: Mapping[str, Any], each: Input) -> Array:
    """The rows of one input in the buffers of an answer: experiment time and values, ``(n, 1 + k)``, NaN for null.

    Buffers may differ by the samples that arrived while the phone wrote them: those rows come again with the next poll.
    """
    columns = [_numbers(buffers, name) for name in (each.time, *each.values)]
    return np.column_stack([column[: min(map(len, columns))] for column in columns])


def _numbers(buffers: Mapping[str, Any], name: str) -> Array:
    return np.array((buffers.get(name) or {}).get("buffer", ()), dtype=float)  # null becomes NaN


def clock_of(events: Sequence[Mapping[str, Any]]) -> ExperimentClock:
    """The clock by an answer of ``/time``; the experiment time itself without any start."""
    starts = [(e["experimentTime"], e["systemTime"]) for e in events if e.get("event") == "START"]
    if not starts:
        return ExperimentClock(np.zeros(1), np.zeros(1), unix=False)
    experiment, system = np.array(starts, dtype=float).T
    return ExperimentClock(experiment, system - experiment, unix=True)


class PhyphoxPhone:
    """A phone with remote access.

    url: as phyphox shows it. stored: returns what is stored of a run, None of a new one.
    """

    def __init__(
        self, url: str, stored: Callable[[str], Stored | None] = lambda run: None, timeout: float = POLL_TIMEOUT
    ) -> None:
        """Check and complete the address. Raises InputError if it is none."""
        expected = "an address as phyphox shows it: http://192.168.0.12:8080"
        try:
            parts = urlsplit(url if "://" in url else f"http://{url}")
            host, _ = parts.hostname, parts.port
        except ValueError:
            raise InputError("--phyphox", "", "no address", expected) from None
        if parts.scheme not in ("http", "https") or not host:
            raise InputError("--phyphox", "", repr(url), expected)
        if "@" in parts.netloc:  # it would be in each line about the phone
            raise InputError("--phyphox", "", "an address with a name or a password", expected)
        self.url, self._stored, self._timeout = f"{parts.scheme}://{parts.netloc}", stored, timeout
        self._name, self._session, self._run, self._ignored = "phyphox", "", "", tuple[str, ...]()
        self._inputs, self._since = list[Input](), dict[str, float]()
        self.messages = 0  # of the run so far

    async def poll(self) -> Poll:
        """Return what is new since the last poll. Raises PhoneError."""
        nothing = Poll("", self._name, False, {})
        try:
            events = await self._json("/time")
            begun = next((event["systemTime"] for event in events if event.get("event") == "START"), None)
            clock = clock_of(events)
            if begun is None:  # not started, or cleared
                self._run = ""
                return nothing
            if self._run != _run(self._session, begun):
                await self._begin(begun, clock)
            answer = await self._json(f"/get?{query(self._inputs, self._since)}")
            rows = {each: rows_of(answer["buffer"], each) for each in self._inputs}
            old = any((table[:, 0] < self._since[each.time]).any() for each, table in rows.items())
            if answer["status"]["session"] != self._session or old:
                self._run = ""  # another experiment, or cleared since /time was asked: the next poll finds out
                return nothing
            for each, table in rows.items():
                self._since[each.time] = max([self._since[each.time], *table[np.isfinite(table[:, 0]), 0]])
            tables = {each.sensor: _table(each, table, clock) for each, table in rows.items()}
            return Poll(self._run, self._name, bool(answer["status"]["measuring"]), tables, self._ignored)
        except UNREADABLE_ANSWER as error:
            raise PhoneError(f"{self.url}: found {one_line(repr(error))}, expected an answer of phyphox") from None

    async def _begin(self, begun: float, clock: ExperimentClock) -> None:
        """Begin a run: find its sensors, and from when on its data are wanted."""
        meta = await self._json("/meta", missing={})
        self._name = " ".join(str(meta[key]) for key in ("deviceBrand", "deviceModel") if meta.get(key)) or "phyphox"
        self._inputs, ignored = inputs_of(await self._json("/config"))
        self._ignored = tuple(ignored)
        last = "&".join(quote(each.time) for each in self._inputs)  # of each buffer the last value
        answer = await self._json(f"/get?{last}")
        self._session = str(answer["status"]["session"])
        self._run = _run(self._session, begun)
        ends = [_numbers(answer["buffer"], each.time)[-1:] for each in self._inputs]
        since = max([-1.0, *(float(end[0]) - HISTORY for end in ends if np.isfinite(end).any())])
        self._since = {each.time: since for each in self._inputs}
        stored = self._stored(self._run)
        self.messages = 0 if stored is None else stored.messages
        if stored is not None and stored.last:
            latest = max(stored.last.values())
            for each in self._inputs:
                unix = stored.last.get(each.sensor, latest)
                part = int(np.searchsorted(clock.begins + clock.offset, unix, side="right")) - 1
                self._since[each.time] = unix - float(clock.offset[max(part, 0)])

    async def _json(self, path: str, missing: Any = None) -> Any:
        """The JSON at a path; ``missing`` where there is none. Raises PhoneError."""
        try:
            # at most 64 MB: ten minutes of three sensors at 400 Hz are 40 MB. The phone is in the same network
            answer = await request(self.url + path, self._timeout, LONGEST_ANSWER, 2**26, proxies=False)
        except TooLongError as error:
            raise PhoneError(f"{self.url}: found {error}, expected less") from None
        except OSError as error:
            raise PhoneError(
                f"{self.url}: no answer ({one_line(str(error))}); is remote access on, in the same Wi-Fi?"
            ) from None
        if missing is not None and answer.status == 404:
            return missing
        if path == "/time" and answer.status == 404:
            raise PhoneError(f"{self.url}: found no /time, expected phyphox 1.1.8 or later")
        if answer.status != 200:
            raise PhoneError(f"{self.url}{path[:20]}: status {answer.status}")
        return msgspec.json.decode(answer.body)


def _run(session: str, begun: float) -> str:
    return f"phyphox-{session}-{1000 * begun:.0f}"


def _table(each: Input, rows: Array, clock: ExperimentClock) -> Array:
    """Rows with finite values at Unix times; of a location with a column for the accuracy."""
    if each.sensor == "location" and len(each.values) == 2:
        rows = np.column_stack([rows, np.full(len(rows), np.nan)])
    needed = rows[:, :3] if each.sensor == "location" else rows
    rows = rows[np.isfinite(needed).all(axis=1)]
    rows = np.column_stack([clock(rows[:, 0]), rows[:, 1:]])
    return rows[np.abs(rows[:, 0]) < 9e9]  # [s] Unix time until which nanoseconds fit into 64 bits


def messages_of(poll: Poll, number: int) -> Iterator[bytes]:
    """Yield the new data as messages of Sensor Logger, the first with the number ``number``."""
    times = np.concatenate([table[:, 0] for table in poll.tables.values()] or [np.empty(0)])
    if not len(times):
        return
    # 20 s a message: 2 MB at 400 Hz and three sensors
    part_of = {sensor: np.floor((table[:, 0] - times.min()) / 20.0) for sensor, table in poll.tables.items()}
    order = {sensor: np.argsort(part, kind="stable") for sensor, part in part_of.items()}
    parts = np.unique(np.concatenate(list(part_of.values())))
    ends = {sensor: np.searchsorted(part[order[sensor]], parts, side="right") for sensor, part in part_of.items()}
    for n in range(len(parts)):
        payload = list[dict[str, Any]]()
        for sensor, table in poll.tables.items():
            name, keys = MESSAGE_NAMES[sensor]
            rows = table[order[sensor][ends[sensor][n - 1] if n else 0 : ends[sensor][n]]]
            stamps = np.round(rows[:, 0] * 1e9).astype(np.int64).tolist()
            for stamp, values in zip(stamps, rows[:, 1:].tolist(), strict=True):
                payload.append({"name": name, "time": stamp, "values": dict(zip(keys, values, strict=True))})
        message = {"messageId": number, "sessionId": poll.run, "deviceId": "phyphox", "payload": payload}
        yield msgspec.json.encode(message)  # NaN becomes null
        number += 1


SENSOR_NAMES = {name: sensor for sensor, (name, _) in MESSAGE_NAMES.items()}


def stored_of(messages: int, last_message: bytes) -> Stored:
    """What is stored of a run by the number of its messages and the last one."""
    last = dict[str, float]()
    for sample in msgspec.json.decode(last_message)["payload"]:
        sensor = SENSOR_NAMES[sample["name"]]
        last[sensor] = max(last.get(sensor, -np.inf), sample["time"] * 1e-9)
    return Stored(messages, last)


async def follow(phone: PhyphoxPhone, receive: Callable[[bytes, str], Awaitable[None]], say: Say) -> None:
    """Give all data of a phone to ``receive``, for ever: a message and the phone's name. say: called with one line."""
    wait, answered = FIRST_RETRY, None
    while True:
        try:
            poll = await phone.poll()
            if answered is not True:
                say(f"phyphox: {phone.url} answers, {'measuring' if poll.measuring else 'not measuring: tap ▶'}")
            wait, answered = FIRST_RETRY, True
            for message in messages_of(poll, phone.messages):
                await receive(message, poll.name)
                phone.messages += 1
            await asyncio.sleep(POLL_INTERVAL)
        except PhoneError as error:
            if answered is not False:
                say(f"phyphox: {error}")
            answered = False
            await asyncio.sleep(wait)
            wait = min(2 * wait, LAST_RETRY)


REFUSED_FOR_NOW = (429, 503, 507)  # status of a refusal that passes: too fast, not ready, disk full
REFUSAL_PAUSE = 5.0  # [s] until a message that was refused for a while is given again


@dataclass(frozen=True)
class Sources:
    """What the server connects to by itself.

    phyphox: addresses of phones; broker: of MQTT, None without; study: reports for studies, None without; home: the
    broker of Home Assistant, None without; receivers: that hear phones, None without; alerts: addresses that are asked;
    motion: sensors in rooms.
    """

    phyphox: tuple[str, ...] = ()
    broker: Broker | None = None
    study: StudyReports | None = None
    home: Broker | None = None
    receivers: Receivers | None = None
    alerts: tuple[Alert, ...] = ()
    motion: MotionSensors | None = None


@asynccontextmanager
async def running(
    sources: Sources, reception: Reception, say: Say, more: Sequence[Coroutine[Any, Any, None]] = ()
) -> AsyncIterator[None]:
    """Fetch from all sources while the context lasts, and do more. All walkers of sources are the owner's."""
    work: list[Coroutine[Any, Any, None]] = [
        follow(PhyphoxPhone(url, partial(stored, reception)), partial(receive_patiently, reception, say), say)
        for url in sources.phyphox
    ]
    if sources.broker is not None:
        work.append(subscribe(sources.broker, receiving_once(reception, say), say))
    if sources.study is not None:
        work.append(sources.study.run())
    work += more
    tasks = [asyncio.create_task(_reported(each, say)) for each in work]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _reported(work: Coroutine[Any, Any, None], say: Say) -> None:
    """Do some work; the error that ends it is told, and the server goes on."""
    try:
        await work
    except Exception as error:
        say(f"{type(error).__name__}: {error}")


def stored(reception: Reception, run: str) -> Stored | None:
    """What is stored of a run of phyphox; None of a new one."""
    log = reception.root / id_of(run) / LOG
    entries = list(read_entries(log)) if log.exists() else []
    if not entries:
        return None
    last = max(entries, key=lambda entry: entry.identity)
    return stored_of(last.identity + 1, read_body(log, last))


async def receive_patiently(reception: Reception, say: Say, body: bytes, name: str) -> None:
    """Store a message of a phone that keeps what it was not asked for: while there is no room, wait."""
    while True:
        try:
            reception.receive(SENSOR_LOGGER, OWNER, body, PLATFORM, name)
            return
        except InputError as refused:
            return say(f"{name}: {refused}")
        except HTTPException as refused:
            if refused.status_code not in REFUSED_FOR_NOW:
                return say(f"{name}: {refused.detail}")
        await asyncio.sleep(REFUSAL_PAUSE)


def receiving_once(reception: Reception, say: Say) -> Callable[[str, bytes], None]:
    """Store a message of a broker, of Sensor Logger or OwnTracks; the latter's phone is named by its topic.

    One that is refused is lost, as by MQTT it may be, and each reason is told once.
    """
    reasons = set[str]()

    def receive(topic: str, body: bytes) -> None:
        try:
            if not (kind := sensor_messages.owntracks_type(body)):
                reception.receive(SENSOR_LOGGER, OWNER, body)
            elif kind == "encrypted":
                raise InputError("message", "", "OwnTracks with encryption", "none: the broker may use TLS")
            else:
                reception.receive(OWNTRACKS, OWNER, body, device=" ".join(topic.split("/")[-2:]))  # user, device
        except (HTTPException, InputError) as refused:
            text = str(refused.detail if isinstance(refused, HTTPException) else refused)
            kind = re.sub(r"\d+", "", text)
            if kind not in reasons and len(reasons) < MOST_REASONS:
                reasons.add(kind)
                say(f"mqtt: a message was not used: {text}")

    return receive


TOPIC = "sensor-logger"  # the app's default
PORTS = {"mqtt": 1883, "mqtts": 8883, "ws": 8000, "wss": 8884}  # by scheme
PASSWORD = "PDR_GRAPH_MQTT_PASSWORD"  # environment variable: an address is seen by all users of a machine
# Messages that wait for this process, and their bytes; further ones are lost, as QoS 0 may
WAITING_MESSAGES, WAITING_BYTES = 500, 32 << 20
MOST_REASONS = 20  # why messages were not used, that are told
LOST_INTERVAL = 60.0  # [s] between two lines about lost messages
FIRST_RECONNECT, LAST_RECONNECT = 1.0, 60.0  # [s] until a lost connection is tried again, doubled each time


@dataclass(frozen=True)
class Broker:
    """Where messages come from. topics: that are subscribed to, if any; address: without the password, for people."""

    host: str
    port: int
    topics: tuple[str, ...]
    tls: bool
    websocket: bool
    path: str
    username: str | None = None
    password: str | None = field(default=None, repr=False)

    @property
    def address(self) -> str:
        """The broker's address for people."""
        return ", ".join([f"{self.host}:{self.port}", *(f"topic {topic}" for topic in self.topics)])


def broker_of(url: str, topics: Sequence[str] = (TOPIC,), option: str = "--mqtt") -> Broker:
    """The broker at an address ``mqtt://USER@HOST:PORT`` (or mqtts, ws, wss). Raises InputError, of an option."""
    expected = "mqtt://HOST, mqtts://USER@HOST:PORT, ws://HOST/mqtt or wss://…"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise InputError(option, "", repr(url), expected) from None
    if parts.scheme not in PORTS or not parts.hostname or parts.query or parts.fragment:
        raise InputError(option, "", repr(url), expected)
    websocket = parts.scheme.startswith("ws")
    if not websocket and parts.path not in ("", "/"):
        raise InputError(option, "", f"the path {parts.path!r}", "none: a topic is --mqtt-topic")
    password = unquote(parts.password) if parts.password else os.environ.get(PASSWORD)
    return Broker(
        host=parts.hostname,
        port=port or PORTS[parts.scheme],
        topics=tuple(topics),
        tls=parts.scheme in ("mqtts", "wss"),
        websocket=websocket,
        path=parts.path or "/mqtt",
        username=unquote(parts.username) if parts.username else None,
        password=password,
    )


class BoundedQueue(asyncio.Queue[Any]):
    """A queue that is full with WAITING_BYTES of payload: a single message may have 256 MB. What is lost is told."""

    def __init__(self, maxsize: int = 0, say: Say = print):
        super().__init__(maxsize)
        self._say, self._lost, self._said_at = say, 0, -LOST_INTERVAL
        self.size = 0  # [bytes]

    def put_nowait(self, item: Any) -> None:
        """Append a message, or lose it."""
        if self.full() or self.size + len(item.payload) > WAITING_BYTES:
            self._lost += 1
            if (now := time.monotonic()) - self._said_at >= LOST_INTERVAL:
                self._say(f"mqtt: more messages than can be used, lost so far: {self._lost}")
                self._said_at = now
            return
        super().put_nowait(item)
        self.size += len(item.payload)

    def get_nowait(self) -> Any:
        """Remove and return the next message."""
        item = super().get_nowait()
        self.size -= len(item.payload)
        return item


async def subscribe(broker: Broker, receive: Callable[[str, bytes], None], say: Say) -> None:
    """Give topic and content of each message of a broker to ``receive``, for ever; a lost connection is tried again.

    say: called with one line when the connection is there, or lost. Raises InputError without aiomqtt.
    """

    async def listen(client: Any) -> None:
        await client.subscribe([(topic, 0) for topic in broker.topics])  # 0: quality of service
        say(f"mqtt: subscribed to {broker.address}")
        async for message in client.messages:
            if not message.retain:  # a retained one may be of a walk that was deleted
                receive(str(message.topic), bytes(message.payload))

    await connected(broker, listen, say)


async def connected(
    broker: Broker, work: Callable[[Any], Awaitable[None]], say: Say, last_will: tuple[str, str] | None = None
) -> None:
    """Do some work with a client of a broker, for ever; a lost connection is tried again.

    last_will: topic and retained message that the broker publishes if it loses this client. Raises InputError without
    aiomqtt.
    """
    try:
        import aiomqtt
    except ImportError:
        raise InputError("--mqtt", "", "no aiomqtt", install("serve-mqtt")) from None
    wait = FIRST_RECONNECT
    while True:
        try:
            async with aiomqtt.Client(
                broker.host,
                broker.port,
                username=broker.username,
                password=broker.password,
                tls_context=ssl.create_default_context() if broker.tls else None,
                transport="websockets" if broker.websocket else "tcp",
                websocket_path=broker.path if broker.websocket else None,
                will=aiomqtt.Will(*last_will, retain=True) if last_will else None,
                max_queued_incoming_messages=WAITING_MESSAGES,
                queue_type=partial(BoundedQueue, say=say),  # type: ignore[arg-type]
                timeout=10.0,  # [s] for the broker to answer
            ) as client:
                wait = FIRST_RECONNECT
                await work(client)
                return
        except (aiomqtt.MqttError, OSError, ValueError) as error:
            say(f"mqtt: {broker.address}: {one_line(str(error))}; again in {wait:.0f} s")
        await asyncio.sleep(wait)
        wait = min(2 * wait, LAST_RECONNECT)
