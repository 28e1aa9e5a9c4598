"""Messages of Sensor Logger by MQTT: the server subscribes to a broker that phones publish to.

The messages are those of HTTP push. The app publishes with quality of service 0: what is lost between phone and broker
is a gap of the walk. aiomqtt is in the extra ``serve-mqtt``.
"""

from __future__ import annotations

import asyncio
import os
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote, urlsplit

from pdr_graph.errors import InputError, install, one_line

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


def bounded_queue() -> type[asyncio.Queue[Any]]:
    """A class of queues that are full with WAITING_BYTES of payload: a single message may have 256 MB."""

    class Bounded(asyncio.Queue[Any]):
        size = 0  # [bytes]

        def put_nowait(self, item: Any) -> None:
            if self.size + _size(item) > WAITING_BYTES:
                raise asyncio.QueueFull
            super().put_nowait(item)
            self.size += _size(item)

        def get_nowait(self) -> Any:
            item = super().get_nowait()
            self.size -= _size(item)
            return item

    return Bounded


def _size(message: Any) -> int:
    return len(message.payload) if isinstance(message.payload, bytes | bytearray) else 0


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
                queue_type=bounded_queue(),
                timeout=10.0,  # timeout [s] for the broker to answer
            ) as client:
                await client.subscribe(broker.topic)
                say(f"mqtt: subscribed to {broker.address}")
                wait = FIRST_RECONNECT
                async for message in client.messages:
                    if isinstance(message.payload, bytes | bytearray):
                        receive(bytes(message.payload))
        except (aiomqtt.MqttError, OSError, ValueError) as error:
            say(f"mqtt: {broker.address}: {one_line(str(error))}; again in {wait:.0f} s")
        await asyncio.sleep(wait)
        wait = min(2 * wait, LAST_RECONNECT)
