"""The server in its own processes: kill -9, streams, hostile clients, the command line; it ends within seconds."""

import json
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
import urllib.request
from contextlib import ExitStack, contextmanager, suppress

import pytest
from commands import run
from hostile_server import ATTACKS, attacking
from running_server import SERVE, RunningServer, certificate
from streamed_walks import PATIENCE, bodies, outdoors, until

from pdr_graph.online.journal import read_entries

BODIES = bodies(outdoors(25.0))
TAKEN = (200, 499)  # the second with a text for the user of the phone
STOPPED = 20.0  # [s] on a machine under load; alone it takes two
BY_SIGNAL = {signal.SIGTERM: (0, -signal.SIGTERM), signal.SIGINT: (0, 130, -signal.SIGINT)}  # exit codes
HEAD = b" HTTP/1.1\r\nHost: localhost\r\n"
EVENTS, ENDLESS_HEAD = b"GET /events" + HEAD + b"\r\n", b"POST /sensorlogger" + HEAD
ENDLESS_BODY = ENDLESS_HEAD + b"Content-Length: 1000000\r\n\r\n{"
SOCKET = b"GET /socket" + HEAD + b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
SOCKET += b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
SILENT_NAMES = """import socket, time
def silent(host, *_, **__):
    print("asked for a name", flush=True)
    time.sleep(600)
socket.getaddrinfo = silent
"""


@pytest.fixture
def start(tmp_path):
    """Start servers, which end with the test."""
    with ExitStack() as ending:

        def started(*options, name="out", before=""):
            server = RunningServer(tmp_path / name, *options, before=before)
            ending.callback(server.kill)
            return server

        yield started


def connect(stack, server, *requests):
    """Clients that send no more than their requests."""
    for request in requests:
        stack.enter_context(server.connected()).sendall(request)


@pytest.mark.thorough
def test_the_walk_goes_on_after_kill_9(start, tmp_path):
    """Of all processes, twice."""
    server, undisturbed = start(), start(name="undisturbed")
    assert undisturbed.post(*BODIES) in TAKEN
    expected = undisturbed.published(len(BODIES))
    for begin in range(0, len(BODIES), 6):
        assert server.post(*BODIES[begin : begin + 6]) in TAKEN
        if begin < 12:
            server.kill()
            entries = read_entries(tmp_path / "out" / "sessions" / "walk-one" / "messages.log")
            assert {entry.identity for entry in entries} == set(range(begin + 6))
            server.start()
    pose = server.published(len(BODIES))
    names = ("x", "y", "sigma", "heading", "steps", "modes", "state", "issues")
    assert [pose[name] for name in names] == [expected[name] for name in names]


@pytest.mark.thorough
def test_a_number_that_is_set_holds_in_the_estimating_process(start):
    """Strides that are 0.2 m longer lead elsewhere."""
    poses = []
    for name, options in (("usual", ()), ("longer", ("--set", "STRIDES.k0=0.7"))):
        server = start(*options, name=name)
        assert server.post(*BODIES[:8]) in TAKEN
        poses.append(server.published(8))
    assert poses[0]["x"] != poses[1]["x"]


def test_poses_and_paths_are_streamed_until_the_server_is_stopped(start):
    server = start()
    with server.connected() as connection, ExitStack() as stack:
        connection.sendall(EVENTS)
        server.post(*BODIES)
        connect(stack, server, SOCKET, ENDLESS_BODY, EVENTS[:-4])
        received, end = b"", time.monotonic() + PATIENCE
        while b"event: path" not in received or received.count(b"event: pose") < 2:
            assert time.monotonic() < end
            received += connection.recv(65536)
        stop(server, signal.SIGTERM)
    assert b"text/event-stream" in received
    data = received.split(b"event: pose\n")[1].split(b"\n")[0]
    assert json.loads(data.removeprefix(b"data: "))["id"] == "walk-one"


def stop(server, ending=signal.SIGINT):
    """Send a signal to a server, which must end."""
    server.process.send_signal(ending)
    assert server.process.wait(STOPPED) in BY_SIGNAL[ending]
    assert "Traceback" not in server.printed()


@pytest.mark.thorough
def test_slow_silent_and_flooding_clients_harm_nobody(start):
    """A head that never ends, a body that never ends, a reader that does not read; meanwhile a phone is served."""
    server = start()
    with ExitStack() as stack:
        connect(stack, server, *[ENDLESS_HEAD, ENDLESS_BODY, EVENTS] * 10)
        began = time.monotonic()
        assert server.post(*BODIES) in TAKEN
        assert time.monotonic() - began < PATIENCE
        server.published(len(BODIES))


BRIEF = "from pdr_graph.apps.serve import serving; serving.HEAD_TIME = serving.BODY_TIME = 1.0\n"
UNKNOWN = b"GET /walkers" + HEAD + b"Authorization: Bearer no\r\n\r\n"
DRIPS = {
    "a first head": b"GET /",
    "a second head": UNKNOWN + b"GET /",
    "a body that nobody reads": b"POST /walkers" + HEAD + b"Content-Length: 100000\r\n\r\n{",
}


@pytest.fixture(scope="module")
def impatient(tmp_path_factory):
    """A server that waits a second for a head or a body."""
    server = RunningServer(tmp_path_factory.mktemp("impatient") / "out", "--token", OWNERS, before=BRIEF)
    yield server
    server.kill()


@pytest.mark.parametrize("drip", DRIPS)
def test_a_connection_that_drips_ends(impatient, drip):
    with impatient.connected() as connection:
        connection.sendall(DRIPS[drip])
        connection.settimeout(0.2)
        began = time.monotonic()
        with suppress(OSError):  # it was closed
            while time.monotonic() < began + PATIENCE:
                connection.sendall(b"x")
                with suppress(TimeoutError):
                    if not connection.recv(65536):
                        break
                time.sleep(0.1)
        assert time.monotonic() < began + PATIENCE


def test_whoever_holds_all_connections_does_not_keep_the_owner_out(start):
    server = start(
        "--token", OWNERS, before="from pdr_graph.apps.serve import serving; serving.MOST_CONNECTIONS = 30\n"
    )
    with ExitStack() as stack:
        connect(stack, server, *[UNKNOWN + b"GET /"] * 60)
        time.sleep(0.5)
        status, _ = server.ask(f"/walkers?token={OWNERS}")
        assert status == 200


def test_streams_that_a_user_leaves_unread_do_not_keep_the_owner_waiting(start, tmp_path):
    """150 of them, of the 100 that a server has; the oldest of the user's end, and the owner's go on."""
    server = start("--token", OWNERS, "--user", "ann")
    ann = json.loads((tmp_path / "out" / "tokens.json").read_text(encoding="utf-8"))["ann"]
    server.ask(f"/sensorlogger?token={OWNERS}", BODIES[0])
    with ExitStack() as stack:
        connections = [stack.enter_context(server.connected()) for _ in range(152)]
        owner, *anns, latest = connections
        owner.sendall(streamed(OWNERS))
        received(owner, b"retry: 2000")
        for connection in anns:
            connection.sendall(streamed(ann))
        began = time.monotonic()
        latest.sendall(streamed(OWNERS))
        received(latest, b"event: pose")
        assert time.monotonic() - began < 5.0
        assert received(anns[0], b"0\r\n\r\n")  # ended as it should
        received(anns[-1], b"retry: 2000")
        received(owner, b"event: pose")


OWNERS = "a-token-of-my-own-choice"


def streamed(token):
    return b"GET /events?token=%s" % token.encode() + HEAD + b"\r\n"


def received(connection, awaited):
    """What a connection receives up to what is awaited."""
    data, end = b"", time.monotonic() + PATIENCE
    while awaited not in data:
        assert time.monotonic() < end, data
        part = connection.recv(65536)
        assert part, data
        data += part
    return data


@pytest.mark.thorough
def test_a_hundred_megabytes_cost_no_memory(start):
    server = start()
    before = memory(server.process.pid)
    with server.connected() as connection, suppress(OSError):  # the server has closed
        connection.sendall(ENDLESS_HEAD + b"Content-Length: 104857600\r\n\r\n")
        for _ in range(100):
            connection.sendall(b" " * (1 << 20))
    assert memory(server.process.pid) < before + 40


def memory(pid):
    """Resident memory [MB]."""
    with open(f"/proc/{pid}/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


# Ending


@contextmanager
def streaming(start):
    """Clients hold an event stream and a WebSocket open, or send a body for ever."""
    server = start()
    with ExitStack() as stack:
        connect(stack, server, EVENTS, SOCKET, ENDLESS_BODY, EVENTS[:-4])
        time.sleep(0.5)
        yield server


@contextmanager
def frozen(start):
    """Its estimating process is stopped."""
    server = start()
    pids = server.estimators()
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    yield server
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@contextmanager
def dripping(start):
    """A phone sends a byte of its answer now and then."""
    with attacking(lambda path: ATTACKS["a byte of the body each 0.2 s"]) as (host, paths):
        server = start("--phyphox", host)
        until(lambda: paths)
        yield server


@contextmanager
def silent_broker(start):
    with socket.create_server(("127.0.0.1", 0)) as broker:
        server = start("--mqtt", f"mqtt://127.0.0.1:{broker.getsockname()[1]}")
        broker.settimeout(STOPPED)
        with broker.accept()[0]:
            yield server


@contextmanager
def silent_names(start):
    """A look-up runs in a thread that cannot be interrupted, and for which Python waits five minutes."""
    server = start("--phyphox", "http://phone.example:8080", before=SILENT_NAMES)
    until(lambda: "asked for a name" in server.printed())
    yield server


@pytest.mark.thorough
@pytest.mark.parametrize("harm", [streaming, frozen, dripping, silent_broker, silent_names])
def test_a_server_stops_whatever_its_clients_processes_and_sources_do(start, harm):
    with harm(start) as server:
        stop(server)


# The command line


def test_another_host_has_a_token_and_prints_it(start, tmp_path):
    server = start("--host", "0.0.0.0", "--user", "ann")
    file = tmp_path / "out" / "tokens.json"
    tokens = json.loads(file.read_text())
    assert file.stat().st_mode & 0o777 == 0o600
    assert server.post(BODIES[0]) == 401
    addresses = {name: f"/sensorlogger?token={token}" for name, token in tokens.items()}
    assert server.post(BODIES[0], path=addresses["ann"]) == 200
    assert server.post(BODIES[1], path=addresses["owner"]) == 403
    assert '"walk-one"' in server.ask(f"/walkers?token={tokens['owner']}")[1]
    assert all(address in server.printed() for address in addresses.values())


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--map", "none.geojson"),
        ("--token", "short"),
        ("--lag", "x"),
        ("--set", "WALKER.strides=1"),
        ("--host", "203.0.113.1"),
        ("--tiles", "nonsense"),
        ("--user", ""),
    ],
)
def test_bad_options_end_with_one_line(tmp_path, option, value):
    code, _, errors = run("serve", "--out", tmp_path / "out", "--port", "0", option, value)
    assert (code, len(errors)) == (2, 1)
    assert (value if option == "--map" else option) in errors[0]


def test_without_the_extra_the_command_names_it(tmp_path):
    hidden = "import sys; sys.modules['uvicorn'] = None; " + SERVE
    alone = [sys.executable, "-c", hidden, "serve", "--out", str(tmp_path)]
    ended = subprocess.run(alone, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "pip install '.[serve]'" in ended.stderr


@pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl")
def test_a_certificate_makes_it_https(start, tmp_path):
    """As docs/app.md makes one: for the phone's browser, which gives sensors by HTTPS alone."""
    file = tmp_path / "serve.pem"
    subprocess.run(certificate(file), check=True, capture_output=True)
    server = start("--certificate", str(file))
    assert f"app, for the phone's browser: {server.url}/app" in server.printed()
    trusting = ssl.create_default_context(cafile=file)
    with urllib.request.urlopen(f"{server.url}/app", context=trusting, timeout=PATIENCE) as answer:
        assert b"DeviceMotionEvent" in answer.read()
    body = urllib.request.Request(f"{server.url}/sensorlogger", BODIES[0])
    with urllib.request.urlopen(body, context=trusting, timeout=PATIENCE) as answer:
        assert answer.status in TAKEN


def test_what_is_no_certificate_is_one_line(tmp_path):
    for name, content in (("none.pem", None), ("other.pem", "x")):
        file = tmp_path / name
        if content:
            file.write_text(content, encoding="utf-8")
        ending = run("serve", "--certificate", file, "--out", tmp_path / "out")
        assert ending.code == 2
        [line] = ending.errors
        assert "expected a PEM file with a certificate and its private key" in line
