"""What the server fetches by itself: phones with phyphox, messages of a broker, recordings of a study."""

from __future__ import annotations

import asyncio
import contextlib
import os
import ssl
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from urllib.parse import unquote, urlsplit

from starlette.exceptions import HTTPException

from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.live_walk import LOG
from pdr_graph.apps.serve.phyphox_polling import PLATFORM, PhyphoxPhone, Stored, follow, stored_of
from pdr_graph.apps.serve.reception import Reception, id_of
from pdr_graph.apps.serve.sensor_messages import SENSOR_LOGGER
from pdr_graph.apps.serve.study import StudyReports
from pdr_graph.errors import InputError, install, one_line
from pdr_graph.online.journal import read_body, read_entries

REFUSED_FOR_NOW = (429, 503, 507)  # status of a refusal that passes: too fast, not ready, disk full
REFUSAL_PAUSE = 5.0  # [s] until a message that was refused for a while is given again

Say = Callable[[str], None]


@dataclass(frozen=True)
class Sources:
    """phyphox: addresses of phones; broker: of MQTT, None without; study: reports for studies, None without."""

    phyphox: tuple[str, ...] = ()
    broker: Broker | None = None
    study: StudyReports | None = None


@asynccontextmanager
async def running(sources: Sources, reception: Reception, say: Say) -> AsyncIterator[None]:
    """Fetch from all sources while the context lasts. All walkers are the owner's."""
    work: list[Coroutine[Any, Any, None]] = [
        follow(PhyphoxPhone(url, partial(stored, reception)), partial(receive_patiently, reception, say), say)
        for url in sources.phyphox
    ]
    if sources.broker is not None:
        work.append(subscribe(sources.broker, partial(receive_once, reception), say))
    if sources.study is not None:
        work.append(sources.study.run())
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


def receive_once(reception: Reception, body: bytes) -> None:
    """Store a message of a broker; one that is refused is lost, as by MQTT it may be."""
    with contextlib.suppress(HTTPException, InputError):
        reception.receive(SENSOR_LOGGER, OWNER, body)


TOPIC = "sensor-logger"  # the app's default
PORTS = {"mqtt": 1883, "mqtts": 8883, "ws": 8000, "wss": 8884}  # by scheme
PASSWORD = "PDR_GRAPH_MQTT_PASSWORD"  # environment variable: an address is seen by all users of a machine
# Messages that wait for this process, and their bytes; further ones are lost, as QoS 0 may
WAITING_MESSAGES, WAITING_BYTES = 500, 32 << 20
FIRST_RECONNECT, LAST_RECONNECT = 1.0, 60.0  # [s] until a lost connection is tried again, doubled each time


@dataclass(frozen=True)
class Broker:
    """Where messages come from. address: without the password, for people."""

    host: str
    port: int
    topic: str
    tls: bool
    websocket: bool
    path: str
    username: str | None = None
    password: str | None = field(default=None, repr=False)

    @property
    def address(self) -> str:
        """The broker's address for people."""
        return f"{self.host}:{self.port}, topic {self.topic}"


def broker_of(url: str, topic: str = TOPIC) -> Broker:
    """The broker at an address ``mqtt://USER@HOST:PORT`` (or mqtts, ws, wss). Raises InputError."""
    expected = "mqtt://HOST, mqtts://USER@HOST:PORT, ws://HOST/mqtt or wss://…"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise InputError("--mqtt", "", repr(url), expected) from None
    if parts.scheme not in PORTS or not parts.hostname or parts.query or parts.fragment:
        raise InputError("--mqtt", "", repr(url), expected)
    websocket = parts.scheme.startswith("ws")
    if not websocket and parts.path not in ("", "/"):
        raise InputError("--mqtt", "", f"the path {parts.path!r}", "none: the topic is --mqtt-topic")
    password = unquote(parts.password) if parts.password else os.environ.get(PASSWORD)
    return Broker(
        host=parts.hostname,
        port=port or PORTS[parts.scheme],
        topic=topic,
        tls=parts.scheme in ("mqtts", "wss"),
        websocket=websocket,
        path=parts.path or "/mqtt",
        username=unquote(parts.username) if parts.username else None,
        password=password,
    )


class BoundedQueue(asyncio.Queue[Any]):
    """A queue that is full with WAITING_BYTES of payload: a single message may have 256 MB."""

    size = 0  # [bytes]

    def put_nowait(self, item: Any) -> None:
        """Append a message. Raises asyncio.QueueFull."""
        if self.size + len(item.payload) > WAITING_BYTES:
            raise asyncio.QueueFull
        super().put_nowait(item)
        self.size += len(item.payload)

    def get_nowait(self) -> Any:
        """Remove and return the next message."""
        item = super().get_nowait()
        self.size -= len(item.payload)
        return item


async def subscribe(broker: Broker, receive: Callable[[bytes], None], say: Callable[[str], None]) -> None:
    """Give each message of a broker to ``receive``, for ever; a lost connection is tried again.

    say: called with one line when the connection is there, or lost. Raises InputError without aiomqtt.
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
                max_queued_incoming_messages=WAITING_MESSAGES,
                queue_type=BoundedQueue,
                timeout=10.0,  # timeout [s] for the broker to answer
            ) as client:
                await client.subscribe(broker.topic)
                say(f"mqtt: subscribed to {broker.address}")
                wait = FIRST_RECONNECT
                async for message in client.messages:
                    receive(bytes(message.payload))
        except (aiomqtt.MqttError, OSError, ValueError) as error:
            say(f"mqtt: {broker.address}: {one_line(str(error))}; again in {wait:.0f} s")
        await asyncio.sleep(wait)
        wait = min(2 * wait, LAST_RECONNECT)
