"""A server that is stopped ends within seconds, whatever its clients, its processes and its sources do then."""

import os
import signal
import socket
import time
from contextlib import ExitStack, suppress

import pytest
from hostile_server import ATTACKS, attacking
from test_processes import Serving, _children

STOPPED = 20.0  # [s] on a machine under load; alone it takes two
DRIP = "a byte of the body each 0.2 s"
SILENT_NAMES = """import socket, time
def silent(host, *_, **__):
    print("asked for a name", flush=True)
    time.sleep(600)
socket.getaddrinfo = silent
"""


BY_SIGNAL = {signal.SIGTERM: (0, -signal.SIGTERM), signal.SIGINT: (0, 130, -signal.SIGINT)}  # exit codes


def stops(running, ending=signal.SIGINT):
    """Send a signal to a server, which must end."""
    running.process.send_signal(ending)
    assert running.process.wait(STOPPED) in BY_SIGNAL[ending]
    assert "Traceback" not in running.printed()


def streaming(stack, running):
    """Clients that hold an event stream and a WebSocket open, and one that sends a body for ever."""
    for request in (
        b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /socket HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        b"POST /sensorlogger HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\n{",
        b"GET /events HTTP/1.1\r\n",
    ):
        stack.enter_context(running.connected()).sendall(request)
    time.sleep(0.5)


def frozen(stack, running):
    """Its estimating process is stopped."""
    for pid in _children(running.process.pid):
        os.kill(pid, signal.SIGSTOP)
        stack.callback(_kill, pid)


def _kill(pid):
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("harm", "ending"), [(streaming, signal.SIGTERM), (streaming, signal.SIGINT), (frozen, signal.SIGINT)]
)
def test_a_server_stops(tmp_path, harm, ending):
    running = Serving(tmp_path / "out")
    with ExitStack() as stack:
        stack.callback(running.kill_if_alive)
        harm(stack, running)
        stops(running, ending)


def test_a_server_stops_while_a_phone_drips(tmp_path):
    with attacking(lambda path: ATTACKS[DRIP]) as (host, paths), ExitStack() as stack:
        running = Serving(tmp_path / "out", "--phyphox", host)
        stack.callback(running.kill_if_alive)
        while not paths:
            time.sleep(0.05)
        stops(running)


def test_a_server_stops_while_a_broker_is_silent(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as broker, ExitStack() as stack:
        running = Serving(tmp_path / "out", "--mqtt", f"mqtt://127.0.0.1:{broker.getsockname()[1]}")
        stack.callback(running.kill_if_alive)
        broker.settimeout(STOPPED)
        with broker.accept()[0]:
            stops(running)


def test_a_server_stops_while_a_name_server_is_silent(tmp_path):
    """A look-up runs in a thread that cannot be interrupted, and for which Python waits five minutes."""
    running = Serving(tmp_path / "out", "--phyphox", "http://phone.example:8080", before=SILENT_NAMES)
    with ExitStack() as stack:
        stack.callback(running.kill_if_alive)
        end = time.monotonic() + STOPPED
        while "asked for a name" not in running.printed():
            assert time.monotonic() < end
            time.sleep(0.05)
        stops(running)
