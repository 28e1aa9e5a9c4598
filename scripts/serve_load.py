"""Load of `pdr-graph serve` by simulated phones on loopback: the figures of docs/serving.md.

    python scripts/serve_load.py PHONES [PHONES ...] [--workers 2] [--seconds 60] [--option=--map --option=FILE]

Each phone posts a message of Sensor Logger every second: accelerometer, gyroscope and magnetometer at 100 Hz and GNSS
at 1 Hz; every fourth phone has no GNSS. The delay of a pose is the time from the POST to the event `pose` that has its
message. The load generator prepares all messages before; its processor time is stated beside that of the server.
"""

import argparse
import asyncio
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.lab.simulation.streaming import batches, message

SERVE = "from pdr_graph.apps.cli import main; main()"
SESSION = "SESSIONSESSION"  # replaced by the name of the phone's session, of the same length
SEEDS, WITHOUT_GNSS = (1, 2, 3), 4  # simulated walks; every so many phones have no GNSS
START = 20.0  # [s] over which the phones begin
SETTLED = 10.0  # [s] after the last phone has begun, from which the processor time is measured
WARMING = 30  # messages of a walker before all others
PATIENCE = 30.0  # [s] for the last poses
HEADER = ["phones", "acknowledged p50 / p99 [ms]", "pose p50 / p99 [s]", "CPU of a second of walk [ms]"]
HEADER += ["serving / estimating, cores", "load generator / other programs, cores", "walker [MB]"]


class Server:
    """`pdr-graph serve` in its processes, on a free port."""

    def __init__(self, folder, *options):
        command = [sys.executable, "-c", SERVE, "serve", "--port", "0", "--out", str(folder), *options]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True
        )
        first = self.process.stdout.readline()
        if not first:
            raise SystemExit("the server did not start")
        self.port = int(re.search(r":(\d+)/", first)[1])

    def kill(self):
        """End all its processes."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def usage(self):
        """Processor time [s] and memory [MB], each of the serving process and of all others, ``(2, 2)``."""
        total = np.zeros((2, 2))
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError, IndexError):
                fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
                if int(fields[2]) == self.process.pid:
                    seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
                    pages = int((folder / "statm").read_text().split()[1])
                    row = int(folder.name != str(self.process.pid))
                    total[:, row] += seconds, pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        return total


def busy_time():
    """Processor time of all processes of the machine [s]."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    return sum(int(fields[n]) for n in (0, 1, 2, 5, 6)) / os.sysconf("SC_CLK_TCK")


def walks(seconds):
    """The messages of each simulated walk, with GNSS and without."""
    found = []
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            write(simulate(replace(Scenario.load(Path("outdoors")), seed=seed)), Path(folder))
            parts = batches(load(Path(folder)))[:seconds]
        bare = [[sample for sample in part if sample["name"] != "location"] for part in parts]
        found.append([[message(SESSION, n, payload) for n, payload in enumerate(walk)] for walk in (parts, bare)])
    return found


def phones_of(messages, count):
    """The name of each phone, and its messages."""
    for n in range(count):
        walk = messages[n % len(messages)][int(n % WITHOUT_GNSS == WITHOUT_GNSS - 1)]
        name = f"phone{n:0{len(SESSION) - 5}d}"
        yield name, [body.replace(SESSION.encode(), name.encode()) for body in walk]


class Delays:
    """When messages were posted, acknowledged and part of a pose, by phone and number [s]."""

    def __init__(self):
        self.posted, self.acknowledged, self.posed, self.refused = {}, {}, {}, []

    def pose(self, name, count):
        """Note a pose of so many messages."""
        now, number = time.monotonic(), count - 1
        while (name, number) in self.posted and (name, number) not in self.posed:
            self.posed[name, number] = now
            number -= 1

    def until(self, ends):
        """The delay of each message [s]."""
        return np.array([ends.get(key, np.inf) - begin for key, begin in self.posted.items()])


async def listen(port, delays):
    """Note each pose of the stream of events."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 24)
    writer.write(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    name = b""
    async for line in reader:
        if line.startswith(b"event: "):
            name = line[7:].strip()
        elif line.startswith(b"data: ") and name == b"pose":
            pose = json.loads(line[6:])
            delays.pose(pose["id"], pose["message"])


async def post(reader, writer, path, body):
    """POST on a connection that stays open; returns the status."""
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n"
    writer.write(head.encode() + body)
    answer = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
    length = next((int(line.split(":")[1]) for line in answer.split("\r\n") if line.startswith("content-l")), 0)
    await reader.readexactly(length)
    return int(answer.split()[1])


async def phone(port, name, bodies, begin, delays):
    """Post the messages of a phone, one a second from ``begin`` on [s]."""
    await asyncio.sleep(max(0.0, begin - 0.1 - time.monotonic()))  # an idle connection would be closed
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    for n, body in enumerate(bodies):
        await asyncio.sleep(max(0.0, begin + n - time.monotonic()))
        delays.posted[name, n] = time.monotonic()
        status = await post(reader, writer, "/sensorlogger", body)
        delays.acknowledged[name, n] = time.monotonic()
        if status not in (200, 499):
            delays.refused.append(status)
    writer.close()


async def loaded(server, phones, seconds):
    """Run the phones; delays, and while all phones walk: cores of the server, its processor time of a message [ms],
    cores of this process and of others.
    """
    delays = Delays()
    listening = asyncio.create_task(listen(server.port, delays))
    begin = time.monotonic() + 0.5
    posting = [
        asyncio.create_task(phone(server.port, name, bodies, begin + START * n / len(phones), delays))
        for n, (name, bodies) in enumerate(phones)
    ]
    await asyncio.sleep(START + SETTLED)
    before, since = (server.usage(), time.process_time(), busy_time(), len(delays.posed)), time.monotonic()
    await asyncio.sleep(max(seconds - START - SETTLED, 1.0))
    after, span = (server.usage(), time.process_time(), busy_time(), len(delays.posed)), time.monotonic() - since
    usage, own, busy, used = ((b - a) / span for a, b in zip(before, after, strict=True))
    await asyncio.gather(*posting)
    end = time.monotonic() + PATIENCE
    while len(delays.posed) < len(delays.posted) and time.monotonic() < end:
        await asyncio.sleep(0.1)
    listening.cancel()
    return delays, usage[0], 1e3 * usage[0].sum() / used, own, busy - own - usage[0].sum()


async def warmed_up(server, bodies, workers):
    """Let each estimating process follow a walker, so that its modules are loaded."""
    number, waiting = 0, set(range(workers))
    while waiting:
        name = f"warm{number:0{len(SESSION) - 4}d}"
        number, process = number + 1, zlib.crc32(name.encode()) % workers
        if process in waiting:
            delays = Delays()
            listening = asyncio.create_task(listen(server.port, delays))
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            for n, body in enumerate(bodies[:WARMING]):
                delays.posted[name, n] = time.monotonic()
                await post(reader, writer, "/sensorlogger", body.replace(SESSION.encode(), name.encode()))
            while (name, WARMING - 1) not in delays.posed:
                await asyncio.sleep(0.1)
            writer.close()
            listening.cancel()
            waiting.discard(process)


def measure(counts, workers, seconds, options):
    """Print a row for each number of phones."""
    messages = walks(seconds)
    print(f"messages of 1 s, {np.mean([len(body) for body in messages[0][0]]) / 1e3:.0f} kB; {seconds} s of each phone")
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}")
    for count in counts:
        phones = list(phones_of(messages, count))
        with tempfile.TemporaryDirectory() as folder:
            server = Server(Path(folder), "--workers", str(workers), *options)
            try:
                asyncio.run(warmed_up(server, messages[0][0], workers))
                before = server.usage()[1]
                delays, cores, each, own, others = asyncio.run(loaded(server, phones, seconds))
                memory = (server.usage()[1] - before).sum() / count
            finally:
                server.kill()
        ends = (1e3, delays.acknowledged), (1.0, delays.posed)
        acknowledged, posed = (np.percentile(scale * delays.until(of), [50, 99]) for scale, of in ends)
        cells = [count, f"{acknowledged[0]:.0f} / {acknowledged[1]:.0f}", f"{posed[0]:.2f} / {posed[1]:.2f}"]
        cells += [
            f"{each:.1f}",
            f"{cores[0]:.2f} / {cores[1]:.2f}",
            f"{own:.2f} / {others:.2f}",
            f"{memory:.1f}",
        ]
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
        if delays.refused:
            print(f"refused: {len(delays.refused)} messages, status {sorted(set(delays.refused))}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("phones", nargs="+", type=int)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--option", action="append", default=[], help="of pdr-graph serve")
    chosen = parser.parse_args()
    measure(chosen.phones, chosen.workers, chosen.seconds, chosen.option)
