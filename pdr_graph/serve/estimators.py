"""The estimating processes, from the side of the serving one: each walker has its process, by its id."""

from __future__ import annotations

import asyncio
import multiprocessing
import threading
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from pdr_graph.serve.estimating import STOP, run, run_process

RESTART = 1.0  # [s] until a process that ended is started again, doubled each time up to SLOWEST_RESTART
SLOWEST_RESTART = 60.0
STOPPING = 5.0  # [s] for which a process may finish its work when the server stops
Receive = Callable[[str, dict[str, Any]], None]


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
        self._connections = dict[int, Any]()
        self._runners = dict[int, Any]()
        self._stopping = False

    async def start(self) -> None:
        """Start all; returns before they have read the plan."""
        self._loop = asyncio.get_running_loop()
        for number in range(max(1, self._count)):
            self._start(number, RESTART)

    def number_of(self, id_: str) -> int:
        """The process of a walker: the same as long as their number is."""
        return zlib.crc32(id_.encode()) % max(1, self._count)

    def tell(self, action: str, id_: str) -> None:
        """Send an action to the process of a walker; while it restarts this is not necessary."""
        self._send(self.number_of(id_), action, id_)

    def _send(self, number: int, action: str, id_: str) -> None:
        try:
            self._connections[number].send_bytes(msgspec.msgpack.encode((action, id_)))
        except (KeyError, OSError):
            return  # it has ended, or not begun; the next one hears of all sessions

    async def stop(self) -> None:
        """End all."""
        self._stopping = True
        for number in self._connections:
            self._send(number, STOP, "")
        for runner in self._runners.values():
            await asyncio.to_thread(runner.join, STOPPING)
            if self._count and runner.is_alive():
                runner.kill()
        for connection in self._connections.values():
            connection.close()

    def _start(self, number: int, delay: float) -> None:
        if self._stopping:
            return
        own, other = multiprocessing.Pipe()
        if self._count:
            context = multiprocessing.get_context("spawn")
            runner: Any = context.Process(target=run_process, args=(other, *self._arguments), daemon=True)
            runner.start()
            other.close()
        else:
            runner = threading.Thread(target=run, args=(other, *self._arguments), daemon=True)
            runner.start()
        self._connections[number], self._runners[number] = own, runner
        threading.Thread(target=self._listen, args=(number, own, delay), daemon=True).start()
        self._started(number)

    def _listen(self, number: int, connection: Any, delay: float) -> None:
        """Hand the updates of a process to the event loop, in a thread, and start it again when it ends."""
        while True:
            try:
                kind, update = msgspec.msgpack.decode(connection.recv_bytes())
            except (EOFError, OSError, TypeError):  # TypeError: closed while it waited
                break
            delay = RESTART
            self._call(self._receive, kind, update)
        if not self._stopping:
            later = min(2 * delay, SLOWEST_RESTART)
            self._call(lambda: self._loop.call_later(delay, self._start, number, later))

    def _call(self, function: Callable[..., Any], *arguments: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:  # the loop has ended
            self._stopping = True
