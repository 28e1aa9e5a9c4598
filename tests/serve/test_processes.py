"""The server in its own processes: kill -9, streams of events, clients that are slow or silent, the command line."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
import simulated
from commands import run

from pdr_graph.lab.simulation.streaming import batches, message
from pdr_graph.online.journal import read_entries

PATIENCE = 30.0  # [s]
SERVE = "from pdr_graph.apps.cli import main; main()"
TOKEN = "a-token-for-tests-01234"


class Serving:
    """A server on a free port. before: Python code that runs first."""

    def __init__(self, folder, *options, before=""):
        self.output = folder.with_name(f"{folder.name}.txt")
        self.command = [sys.executable, "-c", before + SERVE, "serve", "--port", "0", "--out", str(folder), *options]
        self.start()

    def start(self):
        with self.output.open("w") as output:
            streams = {"stdout": output, "stderr": subprocess.STDOUT}
            self.process = subprocess.Popen(self.command, **streams, start_new_session=True)
        end = time.monotonic() + PATIENCE
        while "Push URL" not in (text := self.printed()):
            assert self.process.poll() is None, text
            assert time.monotonic() < end
            time.sleep(0.05)
        self.url = text.splitlines()[0].split()[-1].split("?")[0].rstrip("/")
        self.port = int(self.url.rsplit(":", 1)[1])

    def printed(self):
        """All that the server printed."""
        return self.output.read_text(encoding="utf-8")

    def kill(self):
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(PATIENCE)

    def kill_if_alive(self):
        if self.process.poll() is None:
            self.kill()

    def stop(self):
        self.process.terminate()
        self.process.wait(PATIENCE)
        return self.printed()

    def post(self, body, path="/sensorlogger"):
        try:
            with urllib.request.urlopen(f"{self.url}{path}", body, timeout=PATIENCE) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            return error.code

    def get(self, path, **headers):
        request = urllib.request.Request(self.url + path, headers=headers)
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return json.load(answer)

    def published(self, id_, count):
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            pose = next((pose for pose in self.get("/walkers") if pose["id"] == id_), {"message": -1})
            if pose["message"] >= count:
                return pose
            time.sleep(0.05)
        raise AssertionError(f"{id_}: {pose}")

    def connected(self):
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE)
        connection.settimeout(PATIENCE)
        return connection


@pytest.fixture
def serving(tmp_path):
    running = Serving(tmp_path)
    yield running
    if running.process.poll() is None:
        running.kill()


@pytest.fixture(scope="module")
def bodies():
    """A walk of half a minute with fixes."""
    walk = simulated.with_receiver(simulated.walk_along(np.array([[0.0, 0.0], [25.0, 0.0]]), seed=2), every=250)
    return [message("walk-one", n, payload) for n, payload in enumerate(batches(walk))]


def test_the_walk_goes_on_after_kill_9(serving, bodies, tmp_path, tmp_path_factory):
    """Of all processes, twice."""
    other = Serving(tmp_path_factory.mktemp("undisturbed"))
    for body in bodies:
        assert other.post(body) in (200, 499)
    expected = other.published("walk-one", len(bodies))
    other.kill()
    for begin in range(0, len(bodies), 6):
        for body in bodies[begin : begin + 6]:
            assert serving.post(body) in (200, 499)
        if begin < 12:
            serving.kill()
            entries = read_entries(tmp_path / "sessions" / "walk-one" / "messages.log")
            assert {entry.identity for entry in entries} == set(range(begin + 6))
            serving.start()
    pose = serving.published("walk-one", len(bodies))
    names = ("x", "y", "sigma", "heading", "steps", "modes", "state", "issues")
    assert [pose[name] for name in names] == [expected[name] for name in names]


def test_an_estimating_process_that_dies_is_replaced(serving, bodies):
    for body in bodies[:10]:
        serving.post(body)
    serving.published("walk-one", 10)
    for pid in _children(serving.process.pid):
        os.kill(pid, signal.SIGKILL)
    for body in bodies[10:]:
        assert serving.post(body) in (200, 499)
    assert serving.published("walk-one", len(bodies))["state"] in ("running", "initialising heading")


def _children(pid):
    """The processes that estimate."""
    found = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True, check=True)
    return [int(line.split()[0]) for line in found.stdout.splitlines() if "spawn_main" in line]


def test_poses_and_paths_are_streamed(serving, bodies):
    with serving.connected() as connection:
        connection.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        for body in bodies:
            serving.post(body)
        received, end = b"", time.monotonic() + PATIENCE
        while b"event: path" not in received or received.count(b"event: pose") < 2:
            assert time.monotonic() < end
            received += connection.recv(65536)
    assert b"text/event-stream" in received
    lines = received.split(b"\n")
    data = next(lines[n + 1] for n, line in enumerate(lines) if line == b"event: pose")
    assert json.loads(data.removeprefix(b"data: "))["id"] == "walk-one"


def test_slow_silent_and_flooding_clients_harm_nobody(serving, bodies):
    """A head that never ends, a body that never ends, a reader that does not read; meanwhile a phone is served."""
    clients = [serving.connected() for _ in range(30)]
    for n, client in enumerate(clients):
        if n % 3 == 0:
            client.sendall(b"POST /sensorlogger HTTP/1.1\r\nHost: localhost\r\n")
        elif n % 3 == 1:
            client.sendall(b"POST /sensorlogger HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000\r\n\r\n{")
        else:
            client.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    began = time.monotonic()
    for body in bodies:
        assert serving.post(body) in (200, 499)
    assert time.monotonic() - began < PATIENCE
    serving.published("walk-one", len(bodies))
    for client in clients:
        client.close()


def test_a_hundred_megabytes_cost_no_memory(serving):
    before = _memory(serving.process.pid)
    with serving.connected() as connection:
        connection.sendall(b"POST /sensorlogger HTTP/1.1\r\nHost: localhost\r\nContent-Length: 104857600\r\n\r\n")
        try:
            for _ in range(100):
                connection.sendall(b" " * (1 << 20))
        except OSError:
            pass  # the server has closed
    assert _memory(serving.process.pid) < before + 40


def _memory(pid):
    """Resident memory [MB]."""
    with open(f"/proc/{pid}/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_another_host_has_a_token_and_prints_it(tmp_path, bodies):
    running = Serving(tmp_path, "--host", "0.0.0.0", "--user", "ann")
    try:
        tokens = json.loads((tmp_path / "tokens.json").read_text())
        assert (tmp_path / "tokens.json").stat().st_mode & 0o777 == 0o600
        port = running.port
        running.url = f"http://127.0.0.1:{port}"
        assert running.post(bodies[0]) == 401
        assert running.post(bodies[0], f"/sensorlogger?token={tokens['ann']}") == 200
        assert running.post(bodies[1], f"/sensorlogger?token={tokens['owner']}") == 403
        assert [pose["id"] for pose in running.get(f"/walkers?token={tokens['owner']}")] == ["walk-one"]
    finally:
        out = running.stop()
    assert f"/sensorlogger?token={tokens['owner']}" in out
    assert f"/sensorlogger?token={tokens['ann']}" in out


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--map", "none.geojson"], "none.geojson"),
        (["--token", "short"], "--token"),
        (["--lag", "x"], "--lag"),
        (["--host", "203.0.113.1"], "--host"),
        (["--tiles", "nonsense"], "--tiles"),
        (["--user", ""], "--user"),
    ],
)
def test_bad_options_end_with_one_line(tmp_path, options, text):
    code, _, errors = run("serve", "--out", tmp_path / "out", "--port", "0", *options)
    assert (code, len(errors)) == (2, 1)
    assert text in errors[0]


def test_without_the_extra_the_command_names_it(tmp_path):
    hidden = "import sys; sys.modules['uvicorn'] = None; " + SERVE
    alone = [sys.executable, "-c", hidden, "serve", "--out", str(tmp_path)]
    ended = subprocess.run(alone, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "pip install '.[serve]'" in ended.stderr


def test_other_commands_do_not_import_the_server():
    code = (
        "import sys, pdr_graph.apps.cli, pdr_graph.walk; print({'starlette', 'uvicorn', 'segno'} & sys.modules.keys())"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert ended.stdout.strip() == "set()"
