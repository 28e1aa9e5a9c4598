"""Load and faults of `pdr-graph serve`, on loopback, with simulated phones: the figures of docs/serving.md.

    python scripts/serve_load.py load 10 20 30 [--workers 1] [--seconds 60]
    python scripts/serve_load.py kills 50
    python scripts/serve_load.py hostile
    python scripts/serve_load.py split

load: N phones at 100 Hz in messages of 1 s; time from the POST to its acknowledgement and to the pose on the stream of
events. kills: SIGKILL of all processes at random moments. hostile: what a bad client gets, and what it does to others.
split: two servers behind a proxy that hashes the token.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gzip
import http.client
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
import zlib
from pathlib import Path

import numpy as np

from pdr_graph.io import loading
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.lab.simulation.streaming import batches, message

SERVE = "from pdr_graph.apps.cli import main; main()"
SESSION = "SESSIONSESSION"
PATIENCE = 60.0  # [s]
START = 20.0  # [s] over which the phones begin: the first seconds of a walk cost most


class Serving:
    """A server in its own processes, on a free port."""

    def __init__(self, folder: Path, *options: str):
        self._arguments = [sys.executable, "-c", SERVE, "serve", "--port", "0", "--out", str(folder), *options]
        self.start()

    def start(self) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            self._arguments, stdout=pipe, stderr=subprocess.DEVNULL, text=True, start_new_session=True, env=environment
        )
        first = self.process.stdout.readline()
        self.url = first.split()[-1].split("?")[0].rstrip("/") if first else ""
        assert self.url, "the server did not start"
        self.port = int(self.url.rsplit(":", 1)[1])

    def kill(self) -> None:
        """SIGKILL to all its processes at once."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(20)

    def memory(self) -> tuple[float, float]:
        """Resident memory of the serving and of all its other processes [MB]."""
        sizes = {int(pid): size for pid, size in _group(self.process.pid)}
        own = sizes.pop(self.process.pid, 0.0)
        return own, sum(sizes.values())

    def cpu(self) -> float:
        """Processor time of all its processes [s]."""
        return sum(_cpu(pid) for pid, _ in _group(self.process.pid))


def _group(leader: int):
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
                if int(fields[2]) == leader:
                    pages = int((folder / "statm").read_text().split()[1])
                    yield int(folder.name), pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            except (OSError, IndexError):
                continue


def _cpu(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def bodies(seconds: int) -> list[bytes]:
    """Messages of a walk outdoors with GNSS, each of 1 s; the session's name is SESSION."""
    scenario = Scenario.load(Path("outdoors"))
    with tempfile.TemporaryDirectory() as folder:
        write(simulate(scenario), Path(folder))
        walk = loading.load(Path(folder))
    return [message(SESSION, n, payload) for n, payload in enumerate(batches(walk)[:seconds])]


async def post(reader, writer, path: str, body: bytes) -> int:
    """POST on a connection that stays open; returns the status."""
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n"
    writer.write(head.encode() + body)
    await writer.drain()
    answer = (await reader.readuntil(b"\r\n\r\n")).decode()
    length = next((int(line.split(":")[1]) for line in answer.lower().split("\r\n") if line.startswith("content-l")), 0)
    await reader.readexactly(length)
    return int(answer.split()[1])


class Measured:
    """When messages were posted, acknowledged and in a pose, by walker and number. [s]"""

    def __init__(self):
        self.posted, self.acknowledged, self.posed, self.refused = {}, {}, {}, []

    def pose(self, id_: str, count: int, now: float) -> None:
        number = count - 1
        while number >= 0 and (id_, number) not in self.posed:
            self.posed[id_, number] = now
            number -= 1

    def delays(self, ends: dict) -> np.ndarray:
        return np.array([ends.get(key, np.inf) - begin for key, begin in self.posted.items()])


async def listen(port: int, measured: Measured) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 24)
    writer.write(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    name = b""
    async for line in reader:
        if line.startswith(b"event: "):
            name = line[7:].strip()
        elif line.startswith(b"data: ") and name == b"pose":
            now = time.monotonic()
            pose = json.loads(line[6:])
            measured.pose(pose["id"], pose["message"], now)


async def phone(port: int, number: int, walk: list[bytes], begin: float, measured: Measured) -> None:
    id_ = f"phone{number:04d}"
    await asyncio.sleep(max(0.0, begin - 0.1 - time.monotonic()))  # else the idle connection is closed
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    for n, body in enumerate(walk):
        body = body.replace(SESSION.encode(), id_.encode())
        await asyncio.sleep(max(0.0, begin + n - time.monotonic()))
        measured.posted[id_, n] = time.monotonic()
        status = await post(reader, writer, "/sensorlogger", body)
        measured.acknowledged[id_, n] = time.monotonic()
        if status not in (200, 499):
            measured.refused.append(status)
    writer.close()


async def run_load(serving: Serving, count: int, walk: list[bytes]) -> Measured:
    measured = Measured()
    listening = asyncio.create_task(listen(serving.port, measured))
    await asyncio.sleep(0.2)
    begin = time.monotonic() + 0.5
    await asyncio.gather(*(phone(serving.port, n, walk, begin + START * n / count, measured) for n in range(count)))
    end = time.monotonic() + PATIENCE / 4
    while len(measured.posed) < len(measured.posted) and time.monotonic() < end:
        await asyncio.sleep(0.1)
    listening.cancel()
    return measured


def load(arguments: argparse.Namespace) -> None:
    walk = bodies(arguments.seconds)
    size = sum(map(len, walk)) / len(walk) / 1e3
    print(f"messages of 1 s, {size:.0f} kB; {arguments.seconds} s; {arguments.workers} estimating process(es)")
    print("| phones | acknowledged p50 / p99 | pose p50 / p99 | cores used | memory of a walker | serving process |")
    print("|---|---|---|---|---|---|")
    for count in arguments.phones:
        with tempfile.TemporaryDirectory() as folder:
            serving = Serving(Path(folder), "--workers", str(arguments.workers))
            try:
                time.sleep(3.0)  # the estimating processes import
                before, worked, began = serving.memory(), serving.cpu(), time.monotonic()
                measured = asyncio.run(run_load(serving, count, walk))
                cores = (serving.cpu() - worked) / (time.monotonic() - began)
                after = serving.memory()
            finally:
                serving.kill()
        acknowledged, posed = (
            np.percentile(1e3 * measured.delays(ends), [50, 99]) for ends in (measured.acknowledged, measured.posed)
        )
        each = sum(after) - sum(before)
        print(
            f"| {count} | {acknowledged[0]:.0f} / {acknowledged[1]:.0f} ms | {posed[0]:.0f} / {posed[1]:.0f} ms "
            f"| {cores:.2f} | {each / count:.1f} MB | {after[0]:.0f} MB |",
            flush=True,
        )
        if measured.refused:
            print(f"refused: {sorted(set(measured.refused))}, {len(measured.refused)} times")


def request(url: str, method: str = "GET", body: bytes | None = None) -> bytes:
    with urllib.request.urlopen(urllib.request.Request(url, body, method=method), timeout=PATIENCE) as answer:
        return answer.read()


def settled(url: str, id_: str, count: int) -> dict:
    """The pose of a walker after a number of messages."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        pose = next((pose for pose in json.loads(request(f"{url}/walkers")) if pose["id"] == id_), None)
        if pose and pose["message"] >= count:
            return pose
        time.sleep(0.1)
    raise AssertionError(f"{id_}: no pose of {count} messages")


def kills(arguments: argparse.Namespace) -> None:
    """Kill all processes at random moments while a phone posts; the last pose is that of a server without kills."""
    walk = [body.replace(SESSION.encode(), b"walk0001") for body in bodies(arguments.seconds)]
    rng, killed = random.Random(arguments.seed), 0
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        serving = Serving(Path(one))
        for body in walk:
            request(f"{serving.url}/sensorlogger", "POST", body)
        expected = settled(serving.url, "walk0001", len(walk))
        serving.stop()
        serving, number = Serving(Path(other)), 0
        while killed < arguments.count:
            share = len(walk) * (killed + 1) // arguments.count  # the last message by the last kill
            timer = threading.Timer(rng.uniform(0.0, 1.5), serving.kill)
            timer.start()
            while timer.is_alive():
                if number < share and _status(f"{serving.url}/sensorlogger", walk[number]) in (200, 499):
                    number += 1
                elif number >= share:
                    time.sleep(0.01)
            timer.join()
            killed += 1
            serving.start()
            _check_log(Path(other), number)
        while number < len(walk):
            number += _status(f"{serving.url}/sensorlogger", walk[number]) in (200, 499)
        pose = settled(serving.url, "walk0001", len(walk))
        serving.stop()
        _check_log(Path(other), len(walk))
    same = all(pose[name] == expected[name] for name in ("x", "y", "sigma", "heading", "steps", "modes", "state"))
    outcome = "the same" if same else "ANOTHER"
    print(f"{killed} kills, {len(walk)} messages acknowledged, none lost; the last pose is {outcome}")
    if not same:
        print(expected, pose, sep="\n")
        sys.exit(1)


def hostile(arguments: argparse.Namespace) -> None:
    """One good phone, and one bad client after the other: what each gets, and what the phone notices."""
    walk = bodies(200)
    with tempfile.TemporaryDirectory() as folder:
        serving = Serving(Path(folder), "--token", "o" * 20, "--user", "ann")
        tokens = json.loads((Path(folder) / "tokens.json").read_text())
        try:
            time.sleep(3.0)
            asyncio.run(_attacked(serving, walk, tokens))
        finally:
            serving.kill()


async def _attacked(serving: Serving, walk: list[bytes], tokens: dict[str, str]) -> None:
    path, other = f"/sensorlogger?token={tokens['owner']}", f"/sensorlogger?token={tokens['ann']}"
    million = json.dumps({"messageId": 0, "sessionId": "many", "payload": []})[:-2]
    million += ",".join(['{"name":"x","time":1}'] * 10**6) + "]}"
    sample = json.dumps({"messageId": 0, "sessionId": "hours", "payload": []}).encode()
    attacks = {
        "a wrong token": lambda: _once(serving.port, "/sensorlogger?token=wrong", walk[0]),
        "the session of another user": lambda: _once(serving.port, other, walk[0].replace(SESSION.encode(), b"good")),
        "10⁶ samples in a message (22 MB)": lambda: _once(serving.port, path, million.encode()),
        "10⁶ samples, gzip": lambda: _once(serving.port, path, gzip.compress(million.encode(), 1), "gzip"),
        "a body of 100 MB": lambda: _once(serving.port, path, b" " * (100 << 20)),
        "half a message": lambda: _once(serving.port, path, walk[0][: len(walk[0]) // 2]),
        "NaN": lambda: _once(serving.port, path, walk[0].replace(b'"x": 0', b'"x": NaN', 1)),
        "a clock 5 h back within a walk": lambda: _clock(serving.port, path, walk),
        "a flood: as fast as it is taken, 10 s": lambda: _flood(serving.port, path, walk[0]),
        "200 connections that send half a head": lambda: _silent(serving.port),
        "an empty message": lambda: _once(serving.port, path, sample),
    }
    print("| attack | status | acknowledgement of a good phone, p50 / p99 | memory of all processes, MB |")
    print("|---|---|---|---|")
    begin = 0
    for name, attack in attacks.items():
        good = asyncio.create_task(_good(serving.port, path, walk[begin : begin + 10]))
        await asyncio.sleep(0.2)
        before = sum(serving.memory())
        answer = await attack()
        delays, begin = await good, begin + 10
        p50, p99 = np.percentile(1e3 * np.array(delays), [50, 99])
        print(
            f"| {name} | {answer} | {p50:.0f} / {p99:.0f} ms | {before:.0f} → {sum(serving.memory()):.0f} |", flush=True
        )


async def _good(port: int, path: str, walk: list[bytes]) -> list[float]:
    """The seconds until each message of a phone that sends five a second is acknowledged."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    delays = []
    for body in walk:
        began = time.monotonic()
        status = await post(reader, writer, path, body.replace(SESSION.encode(), b"good"))
        assert status in (200, 499), status
        delays.append(time.monotonic() - began)
        await asyncio.sleep(0.2)
    writer.close()
    return delays


async def _once(port: int, path: str, body: bytes, encoding: str = "identity") -> str:
    """The status and the text of the answer to one request."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Encoding: {encoding}\r\n"
    head += f"Content-Length: {len(body)}\r\n\r\n"
    with contextlib.suppress(ConnectionError):
        writer.write(head.encode() + body)
        await writer.drain()
    answer = await asyncio.wait_for(reader.read(4096), PATIENCE)
    writer.close()
    text = answer.decode(errors="replace")
    return f"{text.split()[1]}: {text.rsplit(chr(13), 1)[-1].strip()[:90]}" if text else "closed"


async def _clock(port: int, path: str, walk: list[bytes]) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    statuses = set()
    for n, body in enumerate(walk[:60]):
        body = body.replace(SESSION.encode(), b"clock")
        if n >= 30:
            content = json.loads(body)
            for sample in content["payload"]:
                sample["time"] -= 5 * 3600 * 10**9
            body = json.dumps(content).encode()
        statuses.add(await post(reader, writer, path, body))
    writer.close()
    return str(sorted(statuses))


async def _flood(port: int, path: str, body: bytes) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    statuses, end, n = {}, time.monotonic() + 10, 0
    while time.monotonic() < end:
        n += 1
        content = body.replace(SESSION.encode(), b"flood").replace(b'"messageId": 0', b'"messageId": %d' % n)
        status = await post(reader, writer, path, content)
        statuses[status] = statuses.get(status, 0) + 1
    writer.close()
    return ", ".join(f"{count} × {status}" for status, count in statuses.items())


async def _silent(port: int) -> str:
    streams = [await asyncio.open_connection("127.0.0.1", port) for _ in range(200)]
    for _, writer in streams:
        writer.write(b"POST /sensorlogger HTTP/1.1\r\nHost: localhost\r\n")
    ends = await asyncio.gather(*(asyncio.wait_for(reader.read(), PATIENCE) for reader, _ in streams))
    return f"{sum(end == b'' for end in ends)} closed after 20 s"


def split(arguments: argparse.Namespace) -> None:
    """Two servers behind a proxy that hashes the token: the phones of a user are all on one of them."""
    walk, users = bodies(30), [f"user{n}" for n in range(6)]
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        options = [option for user in users for option in ("--user", user)]
        servings = [Serving(Path(one), "--token", "o" * 20, *options)]
        (Path(other) / "tokens.json").write_bytes((Path(one) / "tokens.json").read_bytes())
        (Path(other) / "tokens.json").chmod(0o600)
        servings.append(Serving(Path(other)))
        tokens = json.loads((Path(one) / "tokens.json").read_text())
        try:
            asyncio.run(_split([each.port for each in servings], walk, [tokens[user] for user in users]))
            end, found = time.monotonic() + PATIENCE, []
            while time.monotonic() < end and not _complete(found, len(walk)):
                time.sleep(0.5)
                found = [json.loads(request(f"{each.url}/walkers?token={tokens['owner']}")) for each in servings]
        finally:
            for each in servings:
                each.kill()
    ids = [{pose["id"] for pose in poses} for poses in found]
    assert not ids[0] & ids[1]
    assert len(ids[0] | ids[1]) == len(users)
    assert _complete(found, len(walk))
    print(
        f"{len(users)} users behind a proxy that hashes the token: {len(ids[0])} and {len(ids[1])} walks, none on both"
    )


def _complete(found: list[list[dict]], count: int) -> bool:
    """True if the pose of each walker is that of all messages."""
    return bool(found) and all(pose["message"] == count for poses in found for pose in poses)


async def _split(ports: list[int], walk: list[bytes], tokens: list[str]) -> None:
    async def forward(reader, writer):
        head = await reader.readuntil(b"\r\n")
        token = head.split(b"token=")[1].split()[0]
        there, back = await asyncio.open_connection("127.0.0.1", ports[zlib.crc32(token) % len(ports)])
        back.write(head)
        await asyncio.gather(_pipe(reader, back), _pipe(there, writer))

    proxy = await asyncio.start_server(forward, "127.0.0.1", 0)
    port = proxy.sockets[0].getsockname()[1]

    async def posting(token: str) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        for body in walk:
            name = f"walk{zlib.crc32(token.encode())}".encode()
            status = await post(reader, writer, f"/sensorlogger?token={token}", body.replace(SESSION.encode(), name))
            assert status in (200, 499), status
        writer.close()

    await asyncio.gather(*map(posting, tokens))
    proxy.close()


async def _pipe(reader, writer) -> None:
    with contextlib.suppress(ConnectionError):
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()
        writer.write_eof()


def _status(url: str, body: bytes) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, body), timeout=PATIENCE) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code
    except (OSError, http.client.HTTPException):  # killed
        return 0


def _check_log(folder: Path, acknowledged: int) -> None:
    from pdr_graph.online.journal import read_body, read_entries

    log = folder / "sessions" / "walk0001" / "messages.log"
    entries = list(read_entries(log)) if log.exists() else []
    for entry in entries:
        read_body(log, entry)
    missing = set(range(acknowledged)) - {entry.identity for entry in entries}
    assert not missing, f"acknowledged and not in the log: {sorted(missing)}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    verb = verbs.add_parser("load")
    verb.add_argument("phones", type=int, nargs="+")
    verb.add_argument("--workers", type=int, default=1)
    verb.add_argument("--seconds", type=int, default=60)
    verb.set_defaults(run=load)
    verb = verbs.add_parser("hostile")
    verb.set_defaults(run=hostile)
    verb = verbs.add_parser("split")
    verb.set_defaults(run=split)
    verb = verbs.add_parser("kills")
    verb.add_argument("count", type=int)
    verb.add_argument("--seconds", type=int, default=150, help="of the walk")
    verb.add_argument("--seed", type=int, default=1)
    verb.set_defaults(run=kills)
    chosen = parser.parse_args()
    chosen.run(chosen)
