"""Load of `pdr-graph serve` by simulated phones on loopback: the figures of docs/serving.md and docs/reliability.md.

    python scripts/serve_load.py PHONES [PHONES ...] [--workers 2] [--seconds 60] [--option=--map --option=FILE]
    python scripts/serve_load.py PHONES --hours HOURS [--row 3600]     as fast as one core takes them

Each phone posts a message of Sensor Logger every second: accelerometer, gyroscope and magnetometer at 100 Hz and GNSS
at 1 Hz; every fourth phone has no GNSS. The delay of a pose is the time from the POST to the event `pose` that has its
message. The load generator prepares all messages before; its processor time is stated beside that of the server.

With --hours a phone sends a message each second of its time: a position, and in the first minute of each row, of so
many seconds, the sensors too. At its end one message of each phone is timed while nothing else waits.
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

    def __init__(self, folder, *options, cores=None):
        def pin():
            os.sched_setaffinity(0, cores or os.sched_getaffinity(0))

        command = [sys.executable, "-c", SERVE, "serve", "--port", "0", "--out", str(folder), *options]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
            preexec_fn=pin,
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


async def poses(port):
    """The poses of the stream of events."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 24)
    writer.write(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    name = b""
    async for line in reader:
        if line.startswith(b"event: "):
            name = line[7:].strip()
        elif line.startswith(b"data: ") and name == b"pose":
            yield json.loads(line[6:])


async def listen(port, delays):
    """Note each pose of the stream of events."""
    async for pose in poses(port):
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


WALK, AHEAD = 60, 30  # messages of a walk, and those of a phone that may wait
COLUMNS = ["hours", "messages", "CPU of a message, serving / estimating [ms]", "idle: acknowledged p50 / max [ms]"]
COLUMNS += ["idle: pose p50 / max [ms]", "serving / estimating [MB]", "files [MB]"]


class Day:
    """The messages of a phone, one for each second; ``used``: how many of them are part of its pose."""

    def __init__(self, name, walk, begin, row):
        self.name, self.begin, self.sent, self.used, self._walk, self.row = name, begin, 0, 0, walk, row
        self._last = next(sample for part in reversed(walk) for sample in part if sample["name"] == "location")
        self._place, self._random = np.zeros(2), np.random.default_rng(zlib.crc32(name.encode()))

    def next(self):
        """The next message: of the walk with which a row begins, else a position a few metres from its end."""
        second = self.sent % self.row
        if second < len(self._walk):
            shift = (self.begin + self.sent - second) * 10**9 - self._walk[0][0]["time"]
            payload = [{**sample, "time": sample["time"] + shift} for sample in self._walk[second]]
        else:
            self._place = 0.99 * self._place + self._random.normal(0, 3e-6, 2)  # [deg]
            values = dict(self._last["values"])
            values["latitude"] += self._place[0]
            values["longitude"] += self._place[1]
            payload = [{**self._last, "time": (self.begin + self.sent) * 10**9, "values": values}]
        self.sent += 1
        return message(self.name, self.sent - 1, payload)


async def watched(port, days):
    """Note how many messages are part of each pose."""
    async for pose in poses(port):
        days[pose["id"]].used = pose["message"]


async def row_of(port, day):
    """Post the messages of a row but its last, AHEAD of those that are used at most."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    for _ in range(day.row - 1):
        while day.sent - day.used > AHEAD:
            await asyncio.sleep(0.01)
        status = await post(reader, writer, "/sensorlogger", day.next())
        assert status in (200, 499), status
    writer.close()


async def timed(port, day):
    """Post a message; time until it is acknowledged and until it is part of the pose [ms]."""
    while day.used < day.sent:
        await asyncio.sleep(0.01)
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    begin = time.monotonic()
    await post(reader, writer, "/sensorlogger", day.next())
    acknowledged = time.monotonic()
    while day.used < day.sent:
        await asyncio.sleep(0.001)
    writer.close()
    return 1e3 * (acknowledged - begin), 1e3 * (time.monotonic() - begin)


async def rows_of(server, days, count, folder):
    """Print so many rows."""
    watching = asyncio.create_task(watched(server.port, {day.name: day for day in days}))
    for _ in range(count):
        before = server.usage()[0]
        await asyncio.gather(*(row_of(server.port, day) for day in days))
        used, memory = server.usage() - np.outer([1, 0], before)
        each = 1e3 * used / (len(days) * (days[0].row - 1))
        idle = np.array([await timed(server.port, day) for day in days])
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
        cells = [f"{days[0].sent / 3600:.2g}", sum(day.sent for day in days), f"{each[0]:.1f} / {each[1]:.1f}"]
        cells += [f"{np.median(column):.0f} / {column.max():.0f}" for column in idle.T]
        print(f"| {' | '.join(map(str, cells))} | {memory[0]:.0f} / {memory[1]:.0f} | {size:.1f} |", flush=True)
    watching.cancel()


def last(count, hours, row, options):
    """Print the rows of so many phones, of which each has some seconds."""
    with tempfile.TemporaryDirectory() as folder:
        write(simulate(replace(Scenario.load(Path("outdoors")), seed=SEEDS[0])), Path(folder))
        walk = batches(load(Path(folder)))[:WALK]
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder), "--workers", "1", *options, cores={max(os.sched_getaffinity(0))})
        begin = int(time.time() - 3600 * (hours + 1))
        try:
            days = [Day(f"phone{n}", walk, begin, row) for n in range(count)]
            asyncio.run(rows_of(server, days, round(3600 * hours / row), Path(folder)))
        finally:
            server.kill()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("phones", nargs="+", type=int)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--row", type=int, default=3600)
    parser.add_argument("--option", action="append", default=[], help="of pdr-graph serve")
    chosen = parser.parse_args()
    if chosen.hours:
        for count in chosen.phones:
            last(count, chosen.hours, chosen.row, chosen.option)
    else:
        measure(chosen.phones, chosen.workers, chosen.seconds, chosen.option)
