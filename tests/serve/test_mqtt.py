"""Sensor Logger by MQTT: against a small broker of the tests, and Mosquitto where it is installed."""

import asyncio
import contextlib
import shutil
import socket
import subprocess
import sys
import time

import pytest
from mqtt_broker import Broker, running

from pdr_graph.apps.serve import pulling
from pdr_graph.apps.serve.pulling import TOPIC, broker_of, subscribe
from pdr_graph.errors import InputError

aiomqtt = pytest.importorskip("aiomqtt")
pytestmark = pytest.mark.timeout(30)
PATIENCE = 10.0  # [s] for a message to arrive


@contextlib.asynccontextmanager
async def listening(url, topic=TOPIC):
    """A subscription; yields the list of the messages and that of what was said."""
    messages, said = [], []
    task = asyncio.create_task(subscribe(broker_of(url, topic), messages.append, said.append))
    try:
        yield messages, said
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.01)


async def publish(port, *payloads, **more):
    """Publish as the app does."""
    async with aiomqtt.Client("127.0.0.1", port, timeout=PATIENCE) as phone:
        for payload in payloads:
            await phone.publish(TOPIC, payload, qos=0, **more)


def test_messages_of_a_phone_arrive_in_order():
    async def run():
        async with running(Broker()) as port, listening(f"mqtt://127.0.0.1:{port}") as (messages, said):
            await until(lambda: said)
            await publish(port, b'{"messageId": 1}', b'{"messageId": 2}' + b" " * 300_000)
            await until(lambda: len(messages) == 2)
            assert messages[0] == b'{"messageId": 1}'
            assert len(messages[1]) == 300_016
            assert f"127.0.0.1:{port}" in said[0]

    asyncio.run(run())


def test_a_lost_connection_is_made_again(monkeypatch):
    monkeypatch.setattr(pulling, "FIRST_RECONNECT", 0.05)

    async def run():
        broker = Broker()
        async with running(broker) as port, listening(f"mqtt://127.0.0.1:{port}") as (messages, said):
            await until(lambda: said)
            broker.drop_all()
            await until(lambda: len(said) == 3)
            assert "again in" in said[1]
            await publish(port, b"{}")
            await until(lambda: messages)

    asyncio.run(run())


def test_a_broker_that_is_not_there_is_tried_again(monkeypatch):
    monkeypatch.setattr(pulling, "FIRST_RECONNECT", 0.02)

    async def run():
        async with listening("mqtt://127.0.0.1:9") as (_, said):
            await until(lambda: len(said) >= 2)

    asyncio.run(run())


def test_a_password_is_given_and_not_told(monkeypatch):
    monkeypatch.setattr(pulling, "FIRST_RECONNECT", 0.02)

    async def run():
        broker = Broker(password="s3cret")
        async with running(broker) as port:
            async with listening(f"mqtt://me:wrong@127.0.0.1:{port}") as (_, said):
                await until(lambda: said)
                assert "subscribed" not in said[0]
            async with listening(f"mqtt://me:s3cret@127.0.0.1:{port}") as (_, said):
                await until(lambda: said)
                assert "subscribed" in said[0]
                assert "s3cret" not in said[0]

    asyncio.run(run())
    assert "s3cret" not in repr(broker_of("mqtt://me:s3cret@host"))


def test_a_password_may_come_from_the_environment(monkeypatch):
    monkeypatch.setenv(pulling.PASSWORD, "from outside")
    assert broker_of("mqtt://me@host").password == "from outside"


def test_addresses():
    broker = broker_of("wss://me:a%40b@broker.example/ws", "walks")
    assert (broker.host, broker.port, broker.tls, broker.websocket) == ("broker.example", 8884, True, True)
    assert (broker.path, broker.username, broker.password, broker.topic) == ("/ws", "me", "a@b", "walks")
    assert broker_of("mqtt://h").port == 1883
    assert broker_of("mqtts://h").tls


@pytest.mark.parametrize(
    "url", ["", "host", "http://host", "mqtt://", "mqtt://host/topic", "mqtt://host:x", "ws://h?a"]
)
def test_other_addresses_are_refused(url):
    with pytest.raises(InputError, match="--mqtt"):
        broker_of(url)


def test_without_aiomqtt_the_message_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    with pytest.raises(InputError, match="serve-mqtt"):
        asyncio.run(subscribe(broker_of("mqtt://h"), print, print))


@pytest.mark.skipif(not shutil.which("mosquitto"), reason="no Mosquitto (Debian: apt-get install mosquitto)")
@pytest.mark.parametrize("scheme", ["mqtt", "ws"])
def test_messages_arrive_through_mosquitto(tmp_path, scheme):
    ports = []
    for _ in range(2):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            ports.append(free.getsockname()[1])
    lines = [f"listener {ports[0]} 127.0.0.1", f"listener {ports[1]} 127.0.0.1", "protocol websockets"]
    (tmp_path / "conf").write_text("\n".join([*lines, "allow_anonymous true"]))
    broker = subprocess.Popen(["mosquitto", "-c", str(tmp_path / "conf")], stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + PATIENCE
        while socket.socket().connect_ex(("127.0.0.1", ports[0])) and time.monotonic() < end:
            time.sleep(0.05)

        async def run():
            port = ports[scheme == "ws"]
            async with listening(f"{scheme}://127.0.0.1:{port}") as (messages, said):
                await until(lambda: said)
                await publish(ports[0], b"{}")
                await until(lambda: messages)

        asyncio.run(run())
    finally:
        broker.terminate()
        broker.wait(PATIENCE)
