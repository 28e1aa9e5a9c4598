"""Workers of a build: this process, several processes, or a cluster (Dask).

Results are bitwise identical for all of them: a task depends on its files only and uses one BLAS thread. Whatever
happens to workers, a build ends: an item that crashes or hangs costs itself, a fleet that is lost the items left.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any, Generic, TypeVar

from threadpoolctl import threadpool_limits

from pdr_graph.errors import InputError
from pdr_graph.lifelog.remote_tasks import ONE_THREAD, Look, Tasks, Work, collected, finished
from pdr_graph.lifelog.time_limits import FleetLostError, StallWatch

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
        from pdr_graph.lifelog.cluster import connected  # Dask is an extra

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
