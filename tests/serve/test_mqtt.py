"""Sensor Logger and OwnTracks by MQTT, against a broker of MQTT 3.1.1 with quality of service 0 and exact topics, over
TCP, and against Mosquitto.
"""

import asyncio
import contextlib
import json
import sys
from types import SimpleNamespace

import pytest
from streamed_walks import PATIENCE, bodies, outdoors, soon

from pdr_graph.apps.serve import pulling
from pdr_graph.apps.serve.pulling import TOPIC, Sources, broker_of, subscribe
from pdr_graph.apps.serve.serving import Settings, build
from pdr_graph.errors import InputError

aiomqtt = pytest.importorskip("aiomqtt")
pytestmark = [pytest.mark.timeout(30), pytest.mark.anyio]


CONNECT, CONNACK, PUBLISH, SUBSCRIBE, SUBACK = 1, 2, 3, 8, 9
ACCEPTED, BAD_CREDENTIALS = 0, 4


def packet(kind, body, flags=0):
    size, length = len(body), bytearray()
    while True:
        size, digit = divmod(size, 128)
        length.append(digit | (128 if size else 0))
        if not size:
            return bytes([kind << 4 | flags]) + bytes(length) + body


async def received(reader):
    """Kind and body of the next packet."""
    head, size, shift = (await reader.readexactly(1))[0], 0, 0
    while True:
        digit = (await reader.readexactly(1))[0]
        size |= (digit & 127) << shift
        shift += 7
        if not digit & 128:
            return head >> 4, await reader.readexactly(size)


def text(body, at):
    """A text at an offset of a body, and the offset behind it."""
    end = at + 2 + int.from_bytes(body[at : at + 2], "big")
    return body[at + 2 : end].decode(), end


class Broker:
    """password: that clients need, None without; subscribers: writers by topic."""

    def __init__(self):
        self.password, self.subscribers, self.writers = None, {}, set()

    async def serve(self, reader, writer):
        self.writers.add(writer)
        try:
            while True:
                kind, body = await received(reader)
                if kind == CONNECT:
                    accepted = self.password is None or body.endswith(self.password.encode())  # its last field
                    writer.write(packet(CONNACK, bytes([0, ACCEPTED if accepted else BAD_CREDENTIALS])))
                elif kind == SUBSCRIBE:
                    topic, _ = text(body, 2)
                    self.subscribers.setdefault(topic, set()).add(writer)
                    writer.write(packet(SUBACK, body[:2] + b"\0"))
                elif kind == PUBLISH:
                    topic, _ = text(body, 0)
                    for other in self.subscribers.get(topic, ()):
                        other.write(packet(PUBLISH, body))
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self.writers.discard(writer)
            for others in self.subscribers.values():
                others.discard(writer)
            writer.close()

    def drop_all(self):
        """Lose all connections."""
        for writer in list(self.writers):
            writer.transport.abort()


@contextlib.asynccontextmanager
async def running(broker):
    """Serve on a free port of this machine, which it yields."""
    server = await asyncio.start_server(broker.serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        broker.drop_all()


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Lost connections are made again at once."""
    monkeypatch.setattr(pulling, "FIRST_RECONNECT", 0.02)


@pytest.fixture
async def broker():
    found = Broker()
    async with running(found) as found.port:
        yield found


@contextlib.asynccontextmanager
async def listening(url):
    """A subscription; yields the list of the messages and that of what was said, with one line at least."""
    messages, said = [], []
    task = asyncio.create_task(subscribe(broker_of(url), lambda _, body: messages.append(body), said.append))
    try:
        await soon(lambda: said)
        yield messages, said
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def publish(broker, *payloads):
    """Publish as the app does."""
    async with aiomqtt.Client("127.0.0.1", broker.port, timeout=PATIENCE) as phone:
        for payload in payloads:
            await phone.publish(TOPIC, payload)


async def test_messages_arrive_and_a_lost_connection_is_made_again(broker):
    async with listening(f"mqtt://127.0.0.1:{broker.port}") as (messages, said):
        assert f"127.0.0.1:{broker.port}" in said[0]
        large = b'{"messageId": 2}' + b" " * 300_000
        await publish(broker, b'{"messageId": 1}', large)
        await soon(lambda: messages == [b'{"messageId": 1}', large])
        broker.drop_all()
        await soon(lambda: len(said) == 3)
        assert "again in" in said[1]
        await publish(broker, b"{}")
        await soon(lambda: len(messages) == 3)


async def test_a_broker_that_is_not_there_is_tried_again():
    async with listening("mqtt://127.0.0.1:9") as (_, said):
        await soon(lambda: len(said) >= 2)


async def test_a_password_is_given_and_not_told(broker):
    broker.password = "s3cret"
    for password, accepted in (("wrong", False), ("s3cret", True)):
        async with listening(f"mqtt://me:{password}@127.0.0.1:{broker.port}") as (_, said):
            assert ("subscribed" in said[0], "s3cret" in said[0]) == (accepted, False)
    assert "s3cret" not in repr(broker_of("mqtt://me:s3cret@host"))


async def test_messages_of_a_broker_are_walkers_and_others_are_ignored(tmp_path, broker):
    sources = Sources(broker=broker_of(f"mqtt://127.0.0.1:{broker.port}"))
    app = build(Settings(tmp_path, workers=0, sources=sources))
    walkers = app.state.server.hub.walkers
    async with app.router.lifespan_context(app):
        await soon(lambda: broker.subscribers.get(TOPIC))
        await publish(broker, b"no JSON", bodies(outdoors())[0])
        await soon(lambda: "walk-one" in walkers and walkers["walk-one"].pose["message"] == 1)


async def test_what_is_not_used_is_told_once_and_what_is_retained_is_old(tmp_path, broker, capsys):
    sources = Sources(broker=broker_of(f"mqtt://127.0.0.1:{broker.port}"))
    app = build(Settings(tmp_path, workers=0, sources=sources))
    async with app.router.lifespan_context(app):
        await soon(lambda: broker.subscribers.get(TOPIC))
        await publish(broker, *[b'{"messageId": %d}' % n for n in range(30)], *[b"[]"] * 5, bodies(outdoors())[0])
        await soon(lambda: "walk-one" in app.state.server.hub.walkers)
    said = [line for line in capsys.readouterr().err.splitlines() if "not used" in line]
    assert len(said) == 2, said
    assert all("expected" in line for line in said)


def test_a_flood_is_one_line():
    said = []
    queue = pulling.BoundedQueue(2, said.append)
    for _ in range(1000):
        queue.put_nowait(SimpleNamespace(payload=b"x"))
    assert queue.qsize() == 2
    assert len(said) == 1
    queue.get_nowait()
    queue.put_nowait(SimpleNamespace(payload=b"x" * pulling.WAITING_BYTES))
    assert queue.qsize() == 1, "too long with the one that waits"


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_a_retained_message_is_not_used(port):
    """The walk it belongs to may have been deleted."""
    async with aiomqtt.Client("127.0.0.1", port) as phone:
        await phone.publish(TOPIC, b"old", retain=True)
        async with listening(f"mqtt://127.0.0.1:{port}") as (messages, _):
            await phone.publish(TOPIC, b"new")
            await soon(lambda: messages)
            assert messages == [b"new"]


@pytest.mark.timeout(60)
async def test_phones_with_owntracks_are_walkers_named_by_their_topics(tmp_path, port, capsys):
    """As the app publishes: each location retained, a last will; two phones of one name; one encrypts."""
    place = {"_type": "location", "lat": 48.1, "lon": 11.5, "acc": 8, "tid": "ne", "tst": 1_700_000_000}
    topics = "owntracks/{}/phone".format
    sources = Sources(broker=broker_of(f"mqtt://127.0.0.1:{port}", [TOPIC, "owntracks/+/+"]))
    app = build(Settings(tmp_path, workers=0, sources=sources))

    async def published(client, user, **more):
        await client.publish(topics(user), json.dumps(place | more), qos=1, retain=True)

    async with aiomqtt.Client("127.0.0.1", port) as phones:
        await published(phones, "gone")
        async with app.router.lifespan_context(app):
            walkers = app.state.server.hub.walkers
            said = ""
            while "subscribed" not in said:
                await asyncio.sleep(0.05)
                said += capsys.readouterr().err
            await phones.publish(topics("ann"), json.dumps({"_type": "lwt", "tst": 1}), retain=True)
            for _ in range(2):
                await phones.publish(topics("eve"), json.dumps({"_type": "encrypted", "data": "x"}), retain=True)
            for n in range(3):
                await published(phones, "ann", tst=place["tst"] + n)
                await published(phones, "ben", lat=52.5, tst=place["tst"] + n)
            await soon(lambda: sum(each.pose["message"] for each in walkers.values()) == 6)
    at = {each.pose["name"]: round(each.pose["lat"], 3) for each in walkers.values()}
    assert at == {"ann phone": 48.1, "ben phone": 52.5}
    [line] = [line for line in capsys.readouterr().err.splitlines() if "not used" in line]
    assert "OwnTracks with encryption" in line


def test_an_address_names_broker_and_user_and_a_password_may_come_from_the_environment(monkeypatch):
    broker = broker_of("wss://me:a%40b@broker.example/ws", ["walks"])
    assert (broker.host, broker.port, broker.tls, broker.websocket) == ("broker.example", 8884, True, True)
    assert (broker.path, broker.username, broker.password, broker.topics) == ("/ws", "me", "a@b", ("walks",))
    assert broker_of("mqtt://h").port == 1883
    assert broker_of("mqtts://h").tls
    monkeypatch.setenv(pulling.PASSWORD, "from outside")
    assert broker_of("mqtt://me@host").password == "from outside"


@pytest.mark.parametrize(
    "url", ["", "host", "http://host", "mqtt://", "mqtt://host/topic", "mqtt://host:x", "ws://h?a"]
)
def test_other_addresses_are_refused(url):
    with pytest.raises(InputError, match="--mqtt"):
        broker_of(url)


async def test_without_aiomqtt_the_message_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    with pytest.raises(InputError, match="serve-mqtt"):
        await subscribe(broker_of("mqtt://h"), print, print)
