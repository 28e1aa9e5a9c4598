"""Workers of a build: this process, several processes, or a cluster (Dask).

Results are bitwise identical for all of them: a task depends on its files only and uses one BLAS thread. Whatever
happens to workers, a build ends: an item that crashes or hangs costs itself, a fleet that is lost the items left. Any
worker of a cluster may go at any time, as may its scheduler.
"""

from __future__ import annotations

import asyncio
import faulthandler
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from threading import Lock, Thread, get_ident
from time import monotonic, sleep
from typing import Any, Generic, TypeVar
from unittest.mock import patch

from threadpoolctl import threadpool_limits

from pdr_graph.errors import InputError, install

# Chosen by hand
MAX_TASK_SIZE = 20  # person-days or recordings: a task takes seconds, its transfer milliseconds
TASKS_PER_WORKER = 4  # at least, so that all workers finish at about the same time
ITEM_LIMIT = 900.0  # [s] of a recording or day in a worker process; on a busy machine the longest take a minute
STALL_FACTOR = 5  # ITEM_LIMITs without any result after which a fleet is lost; Dask tries an item that hangs four times
LOOK_PERIOD = 1.0  # [s] between looks at the workers and at the files of their results
CONNECT_TIMEOUT = 15.0  # [s] for a scheduler to answer, and for its first worker
RESTART_TIME = 60.0  # [s] without any worker after which the cluster is lost; a worker under load restarts in 20 s
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Item = TypeVar("Item")
Tasks = Sequence[tuple[Any, ...]]
Work = Callable[[tuple[Any, ...]], Iterator[Any]]

_deadlines: dict[int, float] = {}  # of each thread of this process that works on an item, as of `monotonic`
_lock = Lock()
_nowhere = os.open(os.devnull, os.O_WRONLY)  # for the stack of a thread that hangs: the build names the item instead


def limited(results: Iterator[Item], limit: float) -> Iterator[Item]:
    """Yield from an iterator; this process ends if an item takes longer than ``limit`` [s]."""
    while True:
        _set_deadline(limit)
        try:
            item = next(results)
        except StopIteration:
            return
        finally:
            _set_deadline(None)
        yield item


def _set_deadline(limit: float | None) -> None:
    """End this process `limit` [s] from now, unless this thread sets another deadline before; None for no deadline.

    The timer is a thread of faulthandler in C, which also ends a process that hangs in compiled code. It has the
    earliest deadline of all threads.
    """
    with _lock:
        _deadlines.pop(get_ident(), None)
        if limit is not None:
            _deadlines[get_ident()] = monotonic() + limit
        if _deadlines:
            left = max(min(_deadlines.values()) - monotonic(), 1e-3)
            faulthandler.dump_traceback_later(left, exit=True, file=_nowhere)
        else:
            faulthandler.cancel_dump_traceback_later()


def end_with(parent: int) -> None:
    """End this process soon after its parent, which a kill gives no time to end its workers."""

    def watch() -> None:
        while os.getppid() == parent:
            sleep(LOOK_PERIOD)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def collected(
    kinds: Sequence[tuple[type, tuple[Any, ...]]], work: Work, number: int, task: tuple[Any, ...], time_limit: float
) -> tuple[int, list[Any]]:
    """The number and results of a task in a worker process, which ends if one takes longer than ``time_limit`` [s].

    kinds: of measurements, which the process has yet to register.
    """
    os.environ |= ONE_THREAD  # for libraries that are not loaded yet
    threadpool_limits(limits=1)  # for libraries that are loaded
    if kinds:
        from pdr_graph.estimation.factors.registry import register

        for data_type, of_type in kinds:
            register(data_type, *of_type)
    return number, list(limited(work(task), time_limit))


class FleetLostError(Exception):
    """The workers of a build can do nothing more; the message says why."""


@dataclass(frozen=True)
class CrashedItem(Generic[Item]):
    """An item whose worker process crashed."""

    item: Item
    reason = "its worker process was killed, crashed or took too long"


@dataclass(frozen=True)
class LostItem(Generic[Item]):
    """An item without a result, since the fleet was lost."""

    item: Item


@dataclass
class Fleet:
    """The workers of a build.

    workers: number of tasks that run at the same time; time_limit: of an item in a worker process [s].
    pool: returns the executor of the workers, another one after a crash, None to run all tasks in this process;
    crashes: what futures raise if a process crashed; losses: if the workers are lost; check: raises FleetLostError if
    they are.
    lost: why the workers can do nothing more, "" while they can.
    """

    workers: int = 1
    time_limit: float = ITEM_LIMIT
    pool: Callable[[], Executor] | None = None
    crashes: tuple[type[BaseException], ...] = ()
    losses: tuple[type[BaseException], ...] = ()
    check: Callable[[], None] = lambda: None
    lost: str = ""

    def run(self, work: Work, tasks: Tasks, written: Callable[[], int] = lambda: 0) -> Iterator[Any]:
        """Yield the results of some work on each task, in any order.

        Yields a `CrashedItem` for an item that crashed its process or exceeded the time limit, and a `LostItem` for
        each item that is left when the fleet is lost. The result of an item must not depend on the other items of its
        task. written: number of results in files, which grows as long as the workers do something.
        """
        left, suspects = dict(enumerate(tasks)), dict[int, tuple[Any, ...]]()
        try:
            if self.lost:
                raise FleetLostError(self.lost)
            while left:
                running = set[int]()
                for number, results in self._execute(work, left, written, running):
                    yield from results
                    del left[number]
                suspects |= {number: left.pop(number) for number in running & set(left) or set(left)}
            left, suspects = {n: (item,) for n, item in enumerate(chain.from_iterable(suspects.values()))}, {}
            for number, task in list(left.items()):  # each alone, to find the item that crashed the process
                for _, results in self._execute(work, {number: task}, written, set()):
                    yield from results
                    break
                else:
                    yield CrashedItem(task[0])
                del left[number]
        except FleetLostError as loss:
            self.lost = str(loss)
            yield from map(LostItem, chain.from_iterable((left | suspects).values()))

    def _execute(
        self, work: Work, tasks: Mapping[int, tuple[Any, ...]], written: Callable[[], int], running: set[int]
    ) -> Iterator[tuple[int, Iterator[Any]]]:
        """Yield number and results of each task until a task crashes a process. Raises FleetLostError.

        running: gets the numbers of tasks that have begun, as far as known: one of those without results crashed it.
        """
        if self.pool is None:
            yield from ((number, work(task)) for number, task in list(tasks.items()))
            return
        factors: Any = sys.modules.get("pdr_graph.estimation.factors.registry")  # not loaded: nothing was registered
        kinds = factors.kinds_of_others() if factors else []
        left, count, looked = dict[Any, int](), -1, 0.0
        changed = monotonic()
        try:
            with suppress(*self.crashes):  # a process may crash before all tasks are submitted
                submit = self.pool().submit
                for number, task in tasks.items():
                    left[submit(collected, kinds, work, number, task, self.time_limit)] = number
            while left:
                running.update(number for future, number in left.items() if future.running())
                done = [future for future in left if future.done()]
                for future in done:
                    del left[future]
                for future in done:
                    with suppress(*self.crashes):
                        number, results = future.result()
                        yield number, iter(results)
                if done:
                    continue
                if monotonic() - looked >= LOOK_PERIOD:
                    number, looked = written(), monotonic()
                    if number != count:
                        count, changed = number, looked
                    elif looked - changed > (limit := STALL_FACTOR * self.time_limit):
                        raise FleetLostError(f"no recording and no day was finished for {limit / 60:.0f} min")
                    self.check()
                sleep(0.05)  # poll period [s] between looks at the tasks; chosen by hand
        except self.losses:
            raise FleetLostError("the scheduler does not answer any more") from None


@contextmanager
def fleet(workers: int = 1, scheduler: str = "", time_limit: float = ITEM_LIMIT) -> Iterator[Fleet]:
    """The workers of a build: this process, several processes of this machine, or a cluster (``tcp://host:8786``).

    time_limit: of a recording or day in a worker process [s]; this process has none. Raises InputError if the cluster
    cannot be used.
    """
    if scheduler and workers != 1:
        raise InputError("--scheduler", "", f"--workers {workers} too", "only one of the two options")
    if scheduler:
        with connected(scheduler, time_limit) as cluster:
            yield cluster
    elif workers > 1:
        from joblib.externals.loky import get_reusable_executor
        from joblib.externals.loky.process_executor import BrokenProcessPool

        ends: dict[str, Any] = {"initializer": end_with, "initargs": (os.getpid(),)}
        pool: Any = partial(get_reusable_executor, workers, timeout=300, env=ONE_THREAD, **ends)
        try:
            yield Fleet(workers, time_limit, pool, (BrokenProcessPool,))
        finally:
            # End joblib's workers now, also those that hang; its own kill_workers ends in a traceback if tasks are left
            executor: Any = get_reusable_executor(reuse=True)  # pyright: ignore[reportArgumentType]
            for process in list(executor._processes):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            executor.shutdown(wait=True)
    else:
        with threadpool_limits(limits=1), patch.dict(os.environ, ONE_THREAD):
            yield Fleet()


@contextmanager
def connected(scheduler: str, time_limit: float = ITEM_LIMIT) -> Iterator[Fleet]:
    """The workers of a Dask scheduler. Raises InputError if Dask is missing, nothing answers, or there is no worker."""
    try:
        from distributed import Client, KilledWorker
        from distributed.client import ClosedClientError, FutureCancelledError
        from distributed.comm.core import connect
    except ImportError:
        raise InputError("--scheduler", "", "no Dask", install("fleet")) from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # no tracebacks: the error is one line here

    async def greet() -> None:
        comm = await asyncio.wait_for(connect(scheduler, timeout=CONNECT_TIMEOUT), CONNECT_TIMEOUT + 1)
        await comm.close()

    try:  # before a client, which hangs if nothing answers
        with ThreadPoolExecutor(1) as thread:  # this thread may have an event loop
            thread.submit(asyncio.run, greet()).result()
    except (OSError, ValueError) as error:
        found = str(error) or "no answer"
        raise InputError("--scheduler", scheduler, found, "a Dask scheduler, as tcp://host:8786") from None
    with Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False) as client:
        seen = monotonic()  # last time with a worker

        def threads() -> int:
            """Number of threads of all workers; 0 if the scheduler does not answer in time."""
            try:
                found: Any = client.nthreads(callback_timeout=CONNECT_TIMEOUT)
            except (OSError, AttributeError):  # no connection, or none any more
                return 0
            return sum(found.values())

        def check() -> None:
            """Raise FleetLostError if there was no worker for RESTART_TIME: those that crashed may be restarting."""
            nonlocal seen
            if threads():
                seen = monotonic()
            elif monotonic() - seen > RESTART_TIME:
                raise FleetLostError(f"the scheduler {scheduler} has no worker any more")

        while not (number := threads()) and monotonic() - seen < CONNECT_TIMEOUT:  # they may be starting
            sleep(LOOK_PERIOD)
        if not number:
            raise InputError("--scheduler", scheduler, "no workers", "at least one: start dask worker on each machine")
        losses = CancelledError, ClosedClientError, FutureCancelledError
        executor = client.get_executor(pure=False)
        yield Fleet(number, time_limit, lambda: executor, (KilledWorker,), losses, check)


def cores() -> int:
    """Number of cores that this process may use, by its affinity and its container too."""
    from joblib import cpu_count

    return cpu_count()


def pack(items: Sequence[Item], sizes: Sequence[int], workers: int) -> list[tuple[Item, ...]]:
    """Pack items into tasks of similar size, the largest first, so that all workers finish at about the same time."""
    enough = min(MAX_TASK_SIZE, -(-sum(sizes) // (TASKS_PER_WORKER * workers)))
    tasks: list[tuple[Item, ...]] = []
    room = 0
    for item, size in sorted(zip(items, sizes, strict=True), key=lambda pair: -pair[1]):
        if room > 0:
            tasks[-1] += (item,)
        else:
            tasks.append((item,))
            room = enough
        room -= size
    return tasks
