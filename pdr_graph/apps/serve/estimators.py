"""The estimating processes, from the side of the serving one: each walker has its process, by its id.

A process that ends is started again, and one that answers nothing for long is killed first. The walker that it was
working on is named in shared memory; one that ended several processes is left alone, so that the others go on.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import select
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from pdr_graph.apps.serve.estimating import FIRST_UPDATE, MOST_ATTEMPTS, PING, STOP, run, run_process

RESTART = 1.0  # [s] until a process that ended is started again, doubled each time up to SLOWEST_RESTART
SLOWEST_RESTART = 60.0
STOPPING = 5.0  # [s] for which the processes may finish their work when the server stops
PING_PERIOD = 10.0  # [s] between two questions whether a process answers
LONGEST_SILENCE = 300.0  # [s] without an answer after which a process hangs; one message takes a minute at worst
Receive = Callable[[str, dict[str, Any]], None]


@dataclass
class Running:
    """A process. working: buffer with the id of the walker at which it works; heard: when it last answered [s]."""

    connection: Any
    runner: Any
    working: Any
    heard: float = field(default_factory=time.monotonic)
    end: str = "was killed or crashed"


class Estimators:
    """N processes, or one thread for N = 0 (tests, notebooks).

    receive: called on the event loop with each update; started: called with the number of a process when it has
    started, which is when it has to hear of its sessions.
    """

    def __init__(
        self, count: int, root: Path, options: Mapping[str, Any], receive: Receive, started: Callable[[int], None]
    ):
        self._count, self._arguments = count, (str(root), dict(options))
        self._receive, self._started = receive, started
        self._running = dict[int, Running]()
        self._ended_by = Counter[str]()  # walkers: number of processes that ended while they worked at it
        self._stopping = False
        self._watching: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Start all; returns before they have read the plan."""
        self._loop = asyncio.get_running_loop()
        for number in range(max(1, self._count)):
            self._start(number, RESTART)
        if self._count:
            self._watching = asyncio.create_task(self._watch())

    def number_of(self, id_: str) -> int:
        """The process of a walker: the same as long as their number is."""
        return zlib.crc32(id_.encode()) % max(1, self._count)

    def tell(self, action: str, id_: str) -> None:
        """Send an action to the process of a walker; while it restarts this is not necessary."""
        if self._ended_by[id_] < MOST_ATTEMPTS or action == "forget":
            self._send(self.number_of(id_), action, id_)

    def _send(self, number: int, action: str, id_: str) -> None:
        """Send an action, unless the process has ended or reads nothing: the next one hears of all sessions."""
        try:
            connection = self._running[number].connection
            if select.select([], [connection], [], 0)[1]:
                connection.send_bytes(msgspec.msgpack.encode((action, id_)))
        except (KeyError, OSError, ValueError):
            return

    async def stop(self) -> None:
        """End all, those that do not end by themselves after STOPPING seconds by force."""
        self._stopping = True
        if self._watching is not None:
            self._watching.cancel()
        for number in self._running:
            self._send(number, STOP, "")
        await end_all([each.runner for each in self._running.values()], STOPPING, force=bool(self._count))
        for each in self._running.values():
            each.connection.close()

    async def _watch(self) -> None:
        """Kill processes that answer nothing."""
        while True:
            await asyncio.sleep(PING_PERIOD)
            for number, each in self._running.items():
                silence = time.monotonic() - each.heard
                if silence > LONGEST_SILENCE and each.runner.is_alive():
                    each.end = f"did not answer for {silence:.0f} s"
                    each.runner.kill()
                else:
                    self._send(number, PING, "")

    def _start(self, number: int, delay: float) -> None:
        if self._stopping:
            return
        own, other = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        working: Any = context.RawArray("c", 128)  # longest id: bytes
        arguments = (other, *self._arguments, working)
        if self._count:
            runner: Any = context.Process(target=run_process, args=arguments, daemon=True)
            runner.start()
            other.close()
        else:
            runner = threading.Thread(target=run, args=arguments, daemon=True)
            runner.start()
        self._running[number] = Running(own, runner, working)
        threading.Thread(target=self._listen, args=(number, self._running[number], delay), daemon=True).start()
        self._started(number)

    def _listen(self, number: int, running: Running, delay: float) -> None:
        """Hand the updates of a process to the event loop, in a thread, and start it again when it ends."""
        while True:
            try:
                kind, update = msgspec.msgpack.decode(running.connection.recv_bytes())
            except (EOFError, OSError, TypeError):  # TypeError: closed while it waited
                break
            running.heard = time.monotonic()
            if kind != FIRST_UPDATE:
                delay = RESTART
            if kind not in (FIRST_UPDATE, PING):
                self._call(self._receive, kind, update)
        if not self._stopping:
            self._call(self._ended, number, running, delay)

    def _ended(self, number: int, running: Running, delay: float) -> None:
        """Note which walker a process worked at when it ended, and start the process again."""
        id_ = running.working.value.decode("ascii", "replace")
        if id_:
            self._ended_by[id_] += 1
            again = self._ended_by[id_] < MOST_ATTEMPTS
            after = "it is tried again" if again else "it is left alone until the next start; its messages are kept"
            self._receive("failed", {"id": id_, "text": f"its process {running.end}; {after}", "again": again})
        self._loop.call_later(delay, self._start, number, min(2 * delay, SLOWEST_RESTART))

    def _call(self, function: Callable[..., Any], *arguments: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:  # the loop has ended
            self._stopping = True


async def end_all(runners: list[Any], patience: float, force: bool) -> None:
    """Wait until processes or threads have ended, at most `patience` [s]; force: kill those that have not then."""
    end = time.monotonic() + patience
    while any(runner.is_alive() for runner in runners) and time.monotonic() < end:
        await asyncio.sleep(0.02)
    for runner in runners if force else ():
        if runner.is_alive():
            runner.kill()
