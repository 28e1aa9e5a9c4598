"""The estimating processes, from the side of the serving one: each walker has its process, by its id.

A process that ends is started again, and one that answers nothing for long is killed first. The walker that it was
working on is named in shared memory; one that ended several processes is left alone, so that the others go on.
"""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
import select
import signal
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.serve.live_walk import LiveWalk, read_session
from pdr_graph.apps.serve.publishing import PATH_INTERVAL
from pdr_graph.errors import InputError, one_line
from pdr_graph.options import Options
from pdr_graph.walk import settings_changed

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

    def __init__(self, count: int, root: Path, options: Options, receive: Receive, started: Callable[[int], None]):
        self._count, self._arguments = count, (str(root), options)
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


LATEST_POSE = 1.0  # [s] after which a pose is published even while messages wait
MOST_ATTEMPTS = 3  # after which a walker is left alone until the next start
SLOWEST_WAIT = 3600.0  # [s]
STOP, PING = "stop", "ping"  # actions: ends the process; is answered
FIRST_UPDATE = "ready"  # the first update


@dataclass
class Task:
    """A walker with what is due: times on the monotonic clock [s]; posed: False while its pose is not published;
    finishing: its walk ends with the messages that wait.
    """

    walker: LiveWalk
    posed: bool = True
    last_pose: float = -np.inf
    last_path: float = -np.inf
    path_is_due: bool = True
    finishing: bool = False


class Estimating:
    """All walkers of this process.

    root: folder of the sessions; send: gives an update to the serving process; working: shared buffer whose ``value``
    is the id of the walker at which this process works, for the case that it ends there.
    """

    def __init__(self, root: Path, options: Options, send: Callable[[str, dict[str, Any]], None], working: Any):
        self._root, self._send, self._working = root, send, working
        self._executor = ThreadPoolExecutor(1)
        self._make = partial(navigator_of(options), executor=self._executor)
        self._tasks, self._failed = dict[str, Task](), dict[str, tuple[int, float]]()

    def handle(self, action: str, id_: str) -> None:
        """Do what the serving process asks: "new" messages, "finish" or "forget" a session."""
        if action == "forget":
            self._tasks.pop(id_, None)
            self._failed.pop(id_, None)
            self._send("forgotten", {"id": id_})
        elif action == "new":
            self._guarded(id_, lambda task: task.walker.look())
            self._send("looked", {"id": id_})
        elif action == "finish":
            self._guarded(id_, self._finish_later)
        elif action == PING:
            self._send(PING, {})

    @property
    def wait(self) -> float:
        """Time until there is something to do [s]."""
        now = time.time()
        due = [task.walker.due - now for task in self._tasks.values()]
        unfinished = [0.0 for task in self._tasks.values() if task.finishing or not task.posed]
        paths = [task.last_path + PATH_INTERVAL - time.monotonic() for task in self._tasks.values() if task.path_is_due]
        retries = [at - time.monotonic() for _, at in self._failed.values()]
        return min(max(0.0, min([*due, *unfinished, *paths, *retries], default=SLOWEST_WAIT)), SLOWEST_WAIT)

    def work(self) -> None:
        """Use one message of each walker whose turn it is, and publish."""
        for id_, (failures, at) in list(self._failed.items()):
            if at <= time.monotonic():
                self._failed[id_] = failures, np.inf
                self._guarded(id_, lambda task: task.walker.look())
        busy = False
        for id_ in list(self._tasks):
            busy |= self._guarded(id_, self._use_message)
        if not busy:
            for id_, task in list(self._tasks.items()):
                if task.path_is_due and time.monotonic() >= task.last_path + PATH_INTERVAL:
                    self._guarded(id_, self._publish_path)

    def close(self) -> None:
        """End the thread."""
        self._executor.shutdown(cancel_futures=True)

    def _guarded(self, id_: str, action: Callable[[Task], Any]) -> bool:
        """Do something with a walker, which is opened if necessary; a failure is published and tried again later."""
        self._working.value = id_.encode()
        try:
            if id_ not in self._tasks:
                folder = self._root / id_
                session = read_session(folder)
                self._tasks[id_] = Task(LiveWalk(folder, session, self._make), posed=False)
            done = bool(action(self._tasks[id_]))
        except Exception as error:  # of one walker: the others go on
            failures = self._failed.get(id_, (0, 0.0))[0] + 1
            again = time.monotonic() + 5.0 if failures < MOST_ATTEMPTS else np.inf  # [s] of the next attempt
            self._tasks.pop(id_, None)
            self._failed[id_] = failures, again
            text = str(error) if isinstance(error, InputError | OSError) else f"{type(error).__name__}: {error}"
            self._send("failed", {"id": id_, "text": one_line(text), "again": bool(np.isfinite(again))})
            return False
        finally:
            self._working.value = b""
        return done

    def _use_message(self, task: Task) -> bool:
        walker = task.walker
        used = walker.work(np.inf if task.finishing else time.time())
        if used:
            self._failed.pop(walker.session.id, None)
            task.posed, task.path_is_due = False, True
        elif task.finishing:
            pose, path = walker.finish()
            del self._tasks[walker.session.id]
            self._send("pose", pose)
            if path is not None:
                self._send("path", path)
            self._send("finished", {"id": walker.session.id})
            return True
        if walker.catching_up and walker.due <= time.time():
            return used  # its pose is one of long ago
        now = time.monotonic()
        if not task.posed and (walker.due > time.time() or now > task.last_pose + LATEST_POSE):
            self._send("pose", walker.pose())
            task.posed, task.last_pose = True, now
        # after 10 s a path is published even while messages wait
        if task.path_is_due and now > task.last_path + 10.0:
            self._publish_path(task)
        return used

    def _publish_path(self, task: Task) -> None:
        path = task.walker.path(whole=task.last_path == -np.inf)
        if path is not None:
            self._send("path", path)
        task.path_is_due, task.last_path = False, time.monotonic()

    @staticmethod
    def _finish_later(task: Task) -> None:
        """End a walk with the messages that wait; after a restart these are all of it."""
        task.walker.look()
        task.finishing = True


def run(connection: Connection, root: str, options: Options, working: Any) -> None:
    """Estimate until the connection closes. working: as of `Estimating`."""

    def send(kind: str, update: dict[str, Any]) -> None:
        connection.send_bytes(msgspec.msgpack.encode((kind, update)))

    estimating = Estimating(Path(root), options, send, working)
    send(FIRST_UPDATE, {})
    try:
        while True:
            while connection.poll(estimating.wait):
                action, id_ = msgspec.msgpack.decode(connection.recv_bytes())
                if action == STOP:
                    return
                estimating.handle(action, id_)
            estimating.work()
    except (EOFError, OSError):  # the serving process ended
        return
    finally:
        estimating.close()


def run_process(connection: Connection, root: str, options: Options, working: Any) -> None:
    """`run` in a process of its own, which Ctrl-C ends through its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # imported modules stay
    with settings_changed(options.settings):
        run(connection, root, options, working)
