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
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from io import TextIOWrapper
from itertools import chain
from threading import Lock, get_ident
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from threadpoolctl import threadpool_limits

from pdr_graph.errors import InputError, install

if TYPE_CHECKING:
    from distributed import Client


_deadlines: dict[int, float] = {}  # of each thread of this process that works on an item, as of `monotonic`
_lock = Lock()


def limited(results: Iterator[Item], limit: float) -> Iterator[Item]:
    """Yield from an iterator; this process ends if an item takes longer than ``limit`` [s]."""
    while True:
        with _deadline_in(limit):
            try:
                item = next(results)
            except StopIteration:
                return
        yield item


@contextmanager
def _deadline_in(limit: float) -> Iterator[None]:
    """End this process if the context takes longer than ``limit`` [s], also if it hangs in compiled code."""
    thread = get_ident()
    with _lock:
        _deadlines[thread] = monotonic() + limit
        _set_timer()
    try:
        yield
    finally:
        with _lock:
            del _deadlines[thread]
            _set_timer()


def _set_timer() -> None:
    """Let faulthandler, whose timer is a thread in C, end this process at the earliest deadline."""
    if _deadlines:
        left = max(min(_deadlines.values()) - monotonic(), 1e-3)
        faulthandler.dump_traceback_later(left, exit=True, file=_nowhere())
    else:
        faulthandler.cancel_dump_traceback_later()


@cache
def _nowhere() -> TextIOWrapper:
    """A file for the stack of the thread that hangs: the build names the item instead."""
    return open(os.devnull, "w")


class FleetLostError(Exception):
    """The workers of a build can do nothing more; the message says why."""


class StallWatch:
    """Raises FleetLostError when workers have written no result for longer than ``limit`` [s].

    written: number of results in files now.
    """

    PERIOD = 1.0  # [s] between looks at the files

    def __init__(self, limit: float, written: Callable[[], int]):
        self._limit, self._written = limit, written
        self._count, self._looked, self._changed = -1, 0.0, monotonic()

    def look(self) -> None:
        """Look at the files, once a PERIOD. Raises FleetLostError."""
        now = monotonic()
        if now - self._looked < self.PERIOD:
            return
        count, self._looked = self._written(), now
        if count != self._count:
            self._count, self._changed = count, now
        elif now - self._changed > self._limit:
            raise FleetLostError(f"no recording and no day was finished for {self._limit / 60:.0f} min")


ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Tasks = Sequence[tuple[Any, ...]]
Work = Callable[[tuple[Any, ...]], Iterator[Any]]
Look = Callable[[], None]  # called while waiting; raises FleetLostError


def knowing_kinds(work: Work) -> Work:
    """The work, for a process that has yet to learn the kinds of measurements that this one has registered."""
    factors: Any = sys.modules.get("pdr_graph.estimation.factors.registry")  # not loaded: nothing was registered
    kinds = factors.kinds_of_others() if factors else []
    return partial(_with_kinds, kinds, work) if kinds else work


def _with_kinds(kinds: Sequence[tuple[type, tuple[Any, ...]]], work: Work, task: tuple[Any, ...]) -> Iterator[Any]:
    """Register kinds of measurements, and do the work."""
    from pdr_graph.estimation.factors.registry import register

    for data_type, of_type in kinds:
        register(data_type, *of_type)
    return work(task)


def collected(work: Work, number: int, task: tuple[Any, ...], time_limit: float) -> tuple[int, list[Any]]:
    """The results of a task in a worker process, which ends if one takes longer than ``time_limit`` [s]; its number."""
    os.environ |= ONE_THREAD  # for libraries that are not loaded yet
    threadpool_limits(limits=1)  # for libraries that are loaded
    return number, list(limited(work(task), time_limit))


def finished(futures: Sequence[Any], look: Look) -> Iterator[Any]:
    """Yield each future when it is done."""
    left = list(futures)
    while left:
        done, running = list[Any](), list[Any]()
        for future in left:
            (done if future.done() else running).append(future)
        yield from done
        left = running
        if left and not done:
            look()
            sleep(0.05)  # poll period [s] between looks at the tasks; chosen by hand


# Chosen by hand
CONNECT_TIMEOUT = 15.0  # [s] for a scheduler to answer
ASK_PERIOD = 3.0  # [s] between questions which workers there are
RESTART_TIME = 60.0  # [s] without any worker after which the cluster is lost; a worker under load restarts in 20 s


class Cluster:
    """The workers of a Dask scheduler."""

    def __init__(self, client: Client, address: str):
        self._client, self._address = client, address
        self._asked = self._with_workers = monotonic()

    def threads(self) -> int:
        """Number of tasks that run at the same time. Raises InputError without workers."""
        threads = self._threads()
        if not threads:
            raise InputError(
                "--scheduler", self._address, "no workers", "at least one: start dask worker on each machine"
            )
        return threads

    def execute(self, time_limit: float, work: Work, tasks: Tasks, look: Look) -> Iterator[tuple[int, Iterator[Any]]]:
        """Yield number and results of each task, except tasks that crash several processes. Raises FleetLostError."""
        from distributed import KilledWorker
        from distributed.client import ClosedClientError, FutureCancelledError

        def look_here() -> None:
            look()
            self._expect_workers()

        self._asked = self._with_workers = monotonic()
        try:
            submit = self._client.submit
            futures = [submit(collected, work, n, task, time_limit, pure=False) for n, task in enumerate(tasks)]
            for future in finished(futures, look_here):
                try:
                    number, results = _result(future, look_here)
                except KilledWorker:
                    continue
                finally:
                    future.release()  # otherwise it is repeated if its worker ends
                yield number, iter(results)
        except (ClosedClientError, FutureCancelledError):
            raise FleetLostError(f"the scheduler {self._address} does not answer any more") from None

    def _expect_workers(self) -> None:
        """Raise FleetLostError if there was no worker for RESTART_TIME: those that crashed may be restarting."""
        if monotonic() - self._asked < ASK_PERIOD:
            return
        if self._threads():
            self._with_workers = monotonic()
        self._asked = monotonic()
        if self._asked - self._with_workers > RESTART_TIME:
            raise FleetLostError(f"the scheduler {self._address} has no worker any more")

    def _threads(self) -> int:
        """Number of threads of all workers; 0 if the scheduler does not answer in time."""
        try:
            threads: Any = self._client.nthreads(callback_timeout=CONNECT_TIMEOUT)
        except (OSError, AttributeError):  # no connection, or none any more
            return 0
        return sum(threads.values())


def _result(future: Any, look: Look) -> tuple[int, list[Any]]:
    """The result of a task that is done, which Dask computes again if the worker that holds it has died."""
    while True:
        try:
            return future.result(timeout=ASK_PERIOD)
        except TimeoutError:
            if future.status == "error":  # of a worker's disk
                raise
            look()


@contextmanager
def connected(scheduler: str) -> Iterator[Cluster]:
    """The cluster of a Dask scheduler. Raises InputError if Dask is missing or nothing answers."""
    try:
        from distributed import Client
        from distributed.comm.core import connect
    except ImportError:
        raise InputError("--scheduler", "", "no Dask", install("fleet")) from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # no tracebacks: the error is one line here

    async def greet() -> None:
        comm = await asyncio.wait_for(connect(scheduler, timeout=CONNECT_TIMEOUT), CONNECT_TIMEOUT + 1)
        await comm.close()

    try:
        with ThreadPoolExecutor(1) as thread:  # this thread may have an event loop
            thread.submit(asyncio.run, greet()).result()
    except (OSError, ValueError) as error:
        found = str(error) or "no answer"
        raise InputError("--scheduler", scheduler, found, "a Dask scheduler, as tcp://host:8786") from None
    with Client(
        scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False
    ) as client:  # hangs if nothing answers, hence the check above
        yield Cluster(client, scheduler)


# Chosen by hand
MAX_TASK_SIZE = 20  # person-days or recordings: a task takes seconds, its transfer milliseconds
TASKS_PER_WORKER = 4  # at least, so that all workers finish at about the same time
ITEM_LIMIT = 900.0  # [s] of a recording or day in a worker process; on a busy machine the longest take a minute
STALL_FACTOR = 5  # ITEM_LIMITs without any result after which a fleet is lost; Dask tries an item that hangs four times
Item = TypeVar("Item")
Execute = Callable[[Work, Tasks, Look], Iterator[tuple[int, Iterator[Any]]]]  # number and results of each task


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

    workers: number of tasks that run at the same time. execute: yields number and results of each task that crashed no
    process; raises FleetLostError. time_limit: of an item in a worker process [s]. lost: why the workers can do nothing
    more, "" while they can.
    """

    workers: int
    execute: Execute
    time_limit: float = ITEM_LIMIT
    lost: str = ""

    def run(self, work: Work, tasks: Tasks, written: Callable[[], int] = lambda: 0) -> Iterator[Any]:
        """Yield the results of some work on each task, in any order.

        Yields a `CrashedItem` for an item that crashed its process or exceeded the time limit, and a `LostItem` for
        each item that is left when the fleet is lost. The result of an item must not depend on the other items of its
        task. written: number of results in files, which grows as long as the workers do something.
        """
        left = dict(enumerate(tasks))
        try:
            if self.lost:
                raise FleetLostError(self.lost)
            for number, results in self._execute(work, tasks, written):
                yield from results
                del left[number]
            left = {number: (item,) for number, item in enumerate(chain.from_iterable(left.values()))}
            for number, task in list(left.items()):  # each alone, to find the item that crashed the process
                for _, results in self._execute(work, [task], written):
                    yield from results
                    break
                else:
                    yield CrashedItem(task[0])
                del left[number]
        except FleetLostError as loss:
            self.lost = str(loss)
            yield from map(LostItem, chain.from_iterable(left.values()))

    def _execute(self, work: Work, tasks: Tasks, written: Callable[[], int]) -> Iterator[tuple[int, Iterator[Any]]]:
        """Execute tasks while the workers write results."""
        return self.execute(work, tasks, StallWatch(STALL_FACTOR * self.time_limit, written).look)


@contextmanager
def fleet(workers: int = 1, scheduler: str = "", time_limit: float = ITEM_LIMIT) -> Iterator[Fleet]:
    """The workers of a build: this process, several processes of this machine, or a cluster (``tcp://host:8786``).

    time_limit: of a recording or day in a worker process [s]; this process has none. Raises InputError if the cluster
    cannot be used.
    """
    if scheduler and workers != 1:
        raise InputError("--scheduler", "", f"--workers {workers} too", "only one of the two options")
    if scheduler:
        with connected(scheduler) as cluster:
            yield Fleet(cluster.threads(), partial(cluster.execute, time_limit), time_limit)
    elif workers > 1:
        try:
            yield Fleet(workers, partial(_in_processes, workers, time_limit), time_limit)
        finally:
            _end_processes()
    else:
        with threadpool_limits(limits=1), _environment(ONE_THREAD):
            yield Fleet(1, _here, time_limit)


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


def _here(work: Work, tasks: Tasks, look: Look) -> Iterator[tuple[int, Iterator[Any]]]:
    """Run tasks in this process, in order."""
    return ((number, work(task)) for number, task in enumerate(tasks))


def _in_processes(
    workers: int, time_limit: float, work: Work, tasks: Tasks, look: Look
) -> Iterator[tuple[int, Iterator[Any]]]:
    """Run tasks with joblib's processes; if one crashes, its pool ends and the tasks left have no results."""
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import BrokenProcessPool

    pool: Any = get_reusable_executor(workers, timeout=300, env=ONE_THREAD)
    futures: list[Any] = []
    with suppress(BrokenProcessPool):  # a process may crash before all tasks are submitted
        futures.extend(pool.submit(collected, work, n, task, time_limit) for n, task in enumerate(tasks))
    for future in finished(futures, look):
        try:
            number, results = future.result()
        except BrokenProcessPool:
            continue
        yield number, iter(results)


def _end_processes() -> None:
    """End joblib's workers now, also those that hang."""
    from joblib.externals.loky import get_reusable_executor

    pool: Any = get_reusable_executor(reuse=True)  # pyright: ignore[reportArgumentType]
    for process in list(pool._processes):  # its own kill_workers ends in a traceback if tasks are left
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    pool.shutdown(wait=True)


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within a context."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ |= variables
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
