"""The process that estimates: it reads the logs of its sessions, and sends poses and paths to the one that serves.

It holds Python's lock for seconds at the start of a walk; in a process of its own it delays nobody's acknowledgement.
"""

from __future__ import annotations

import gc
import signal
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
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
from pdr_graph.walk import Options

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
            self._guarded(id_, _finish_later)
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
            for id_ in list(self._tasks):
                self._guarded(id_, self._idle)

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
            # retry [s] after a failure of a walker
            again = time.monotonic() + 5.0 if failures < MOST_ATTEMPTS else np.inf
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
            self._finish(task)
            return True
        if walker.catching_up and walker.due <= time.time():
            return used  # its pose is one of long ago
        now = time.monotonic()
        if not task.posed and (walker.due > time.time() or now > task.last_pose + LATEST_POSE):
            self._send("pose", walker.pose())
            task.posed, task.last_pose = True, now
        # latest path [s] after which a path is published even while messages wait
        if task.path_is_due and now > task.last_path + 10.0:
            self._publish_path(task)
        return used

    def _idle(self, task: Task) -> None:
        if task.path_is_due and time.monotonic() >= task.last_path + PATH_INTERVAL:
            self._publish_path(task)

    def _publish_path(self, task: Task) -> None:
        path = task.walker.path(whole=task.last_path == -np.inf)
        if path is not None:
            self._send("path", path)
        task.path_is_due, task.last_path = False, time.monotonic()

    def _finish(self, task: Task) -> None:
        id_ = task.walker.session.id
        pose, path = task.walker.finish()
        self._tasks.pop(id_, None)
        self._send("pose", pose)
        if path is not None:
            self._send("path", path)
        self._send("finished", {"id": id_})


def _finish_later(task: Task) -> None:
    """End a walk with the messages that wait; after a restart these are all of it."""
    task.walker.look()
    task.finishing = True


def run(connection: Connection, root: str, options: Mapping[str, Any], working: Any) -> None:
    """Estimate until the connection closes. options: fields of `Options`; working: as of `Estimating`."""

    def send(kind: str, update: dict[str, Any]) -> None:
        connection.send_bytes(msgspec.msgpack.encode((kind, update)))

    estimating = Estimating(Path(root), Options(**options), send, working)
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


def run_process(connection: Connection, root: str, options: Mapping[str, Any], working: Any) -> None:
    """`run` in a process of its own, which Ctrl-C ends through its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # imported modules stay
    run(connection, root, options, working)
