"""Workers of a build: this process, several processes (joblib), or a cluster (Dask).

Results are bitwise identical for all of them: a task depends on its files only and uses one BLAS thread.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from threadpoolctl import threadpool_limits

from pdr_graph.errors import InputError

if TYPE_CHECKING:
    from distributed import Client


# Chosen by hand
MAX_TASK_SIZE = 20  # person-days or recordings: a task takes seconds, its transfer milliseconds
TASKS_PER_WORKER = 4  # at least, so that all workers finish at about the same time
CONNECT_TIMEOUT = 15  # [s] for a scheduler to answer
PATIENCE = 30.0  # [s] after which a task without a result is asked whether a worker is left
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Item = TypeVar("Item")
Tasks = Sequence[tuple[Any, ...]]
Work = Callable[[tuple[Any, ...]], Iterator[Any]]
Results = Iterator[tuple[int, list[Any]]]  # number and results of each task


@dataclass(frozen=True)
class CrashedItem(Generic[Item]):
    """An item whose worker process crashed."""

    item: Item
    reason = "its worker process was killed or crashed"


@dataclass(frozen=True)
class Fleet:
    """The workers of a build. workers: number of tasks that run at the same time.

    run: yields the results of some work on each task, in any order, and a `CrashedItem` for an item that crashed its
    process. The result of an item must not depend on the other items of its task.
    """

    workers: int
    run: Callable[[Work, Tasks], Iterator[Any]]


@contextmanager
def fleet(workers: int = 1, scheduler: str = "") -> Iterator[Fleet]:
    """The workers of a build: this process, several processes of this machine, or a cluster (``tcp://host:8786``).

    Raises InputError if the cluster cannot be used.
    """
    if scheduler and workers != 1:
        raise InputError("--scheduler", "", f"--workers {workers} too", "only one of the two options")
    if scheduler:
        with _connected(scheduler) as client:
            threads: Any = client.nthreads()
            if not threads:
                raise InputError(
                    "--scheduler", scheduler, "no workers", "at least one: start dask worker on each machine"
                )
            yield Fleet(sum(threads.values()), partial(_run_elsewhere, partial(_on_cluster, client, scheduler)))
    elif workers > 1:
        try:
            yield Fleet(workers, partial(_run_elsewhere, partial(_in_processes, workers)))
        finally:
            _end_processes()
    else:
        yield Fleet(1, _run_here)


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


def _run_here(work: Work, tasks: Tasks) -> Iterator[Any]:
    """Run tasks in this process, in order."""
    with threadpool_limits(limits=1), _environment(ONE_THREAD):
        for task in tasks:
            yield from work(task)


def _run_elsewhere(results_of: Callable[[Work, Tasks], Results], work: Work, tasks: Tasks) -> Iterator[Any]:
    """Run tasks in other processes, as `Fleet.run`. results_of: yields the results of tasks that crashed no process."""
    left = dict(enumerate(tasks))
    for number, results in results_of(work, tasks):
        del left[number]
        yield from results
    for item in chain.from_iterable(left.values()):  # each alone, to find the item that crashed the process
        for _, results in results_of(work, [(item,)]):
            yield from results
            break
        else:
            yield CrashedItem(item)


def _in_processes(workers: int, work: Work, tasks: Tasks) -> Results:
    """Run tasks with joblib; ends early if a process crashes, since its pool ends too."""
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    with parallel_config("loky", inner_max_num_threads=1):
        # at least two: joblib runs a single one in this process
        pool: Any = Parallel(max(workers, 2), return_as="generator_unordered", pre_dispatch="all", batch_size=1)  # pyright: ignore[reportArgumentType]
    try:
        yield from pool(delayed(_collected)(work, number, task) for number, task in enumerate(tasks))
    except TerminatedWorkerError:
        return


def _end_processes() -> None:
    """Stop joblib's idle workers now."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor(reuse=True).shutdown(wait=True)  # pyright: ignore[reportArgumentType]


def _on_cluster(client: Client, scheduler: str, work: Work, tasks: Tasks) -> Results:
    """Run tasks with Dask; a task that crashes several processes has no result."""
    from distributed import KilledWorker, as_completed
    from distributed.client import FutureCancelledError

    futures = [client.submit(_collected, work, number, task, pure=False) for number, task in enumerate(tasks)]
    for future in as_completed(futures, loop=client.loop):
        try:
            yield _result(client, scheduler, future)
        except KilledWorker:
            continue
        except FutureCancelledError:
            raise InputError("--scheduler", scheduler, "no answer any more", "a running scheduler") from None
        finally:
            future.release()  # otherwise it is repeated if its worker ends


def _result(client: Client, scheduler: str, future: Any) -> Any:
    """The result of a task, which Dask computes again if the worker that holds it has died.

    Raises InputError if no worker is left to do so.
    """
    while True:
        try:
            return future.result(timeout=PATIENCE)
        except TimeoutError:
            if not client.scheduler_info()["workers"]:
                raise InputError("--scheduler", scheduler, "no worker any more", "a running worker") from None


def _collected(work: Work, number: int, task: tuple[Any, ...]) -> tuple[int, list[Any]]:
    """The results of a task in a worker process, with its number."""
    os.environ |= ONE_THREAD  # for libraries that are not loaded yet
    threadpool_limits(limits=1)  # for libraries that are loaded
    return number, list(work(task))


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    """A client of a Dask scheduler. Raises InputError if Dask is missing or nothing answers."""
    try:
        from distributed import Client
        from distributed.comm.core import connect
    except ImportError:
        raise InputError("--scheduler", "", "no Dask", "the extra fleet: pip install 'pdr_graph[fleet]'") from None
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
        yield client


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
