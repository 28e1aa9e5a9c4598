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


LARGEST = 20  # person-days or recordings in a task: seconds, to which the milliseconds of handing it over are nothing
TASKS_EACH = 4  # at least, for every worker, so that all are done at about the same time
PATIENCE = 15  # [s] for a scheduler to answer
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Item = TypeVar("Item")
Tasks = Sequence[tuple[Any, ...]]
Work = Callable[[tuple[Any, ...]], Iterator[Any]]
Results = Iterator[tuple[int, list[Any]]]  # number of the task, and what the work yielded of it


@dataclass(frozen=True)
class Lost(Generic[Item]):
    """An item whose worker process crashed."""

    item: Item
    reason = "its worker process was killed or crashed"


@dataclass(frozen=True)
class Fleet:
    """workers: how many tasks are done at a time.

    run: what some work yields of each task, in any order, and `Lost` for an item that ended its process. Each item must
    be worth the same alone and with the others of its task.
    """

    workers: int
    run: Callable[[Work, Tasks], Iterator[Any]]


@contextmanager
def fleet(workers: int = 1, scheduler: str = "") -> Iterator[Fleet]:
    """The process itself, processes of its machine, or the cluster of a scheduler, as ``tcp://host:8786``.

    Raises InputError if there is none.
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
            yield Fleet(sum(threads.values()), partial(_elsewhere, partial(_on_cluster, client, scheduler)))
    elif workers > 1:
        try:
            yield Fleet(workers, partial(_elsewhere, partial(_in_processes, workers)))
        finally:
            _end_processes()
    else:
        yield Fleet(1, _here)


def packed(items: Sequence[Item], sizes: Sequence[int], workers: int) -> list[tuple[Item, ...]]:
    """Pack items into tasks of similar size, the largest first, so that all workers finish at about the same time."""
    enough = min(LARGEST, -(-sum(sizes) // (TASKS_EACH * workers)))
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


def _here(work: Work, tasks: Tasks) -> Iterator[Any]:
    """Run tasks in this process, in order."""
    with threadpool_limits(limits=1), _environment(ONE_THREAD):
        for task in tasks:
            yield from work(task)


def _elsewhere(results_of: Callable[[Work, Tasks], Results], work: Work, tasks: Tasks) -> Iterator[Any]:
    """As `Fleet.run`. results_of: of the tasks whose processes did not end."""
    left = dict(enumerate(tasks))
    for number, results in results_of(work, tasks):
        del left[number]
        yield from results
    for item in chain.from_iterable(left.values()):  # which of them ended it, is found by trying each alone
        for _, results in results_of(work, [(item,)]):
            yield from results
            break
        else:
            yield Lost(item)


def _in_processes(workers: int, work: Work, tasks: Tasks) -> Results:
    """By joblib; where a process ends, its pool does too."""
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    with parallel_config("loky", inner_max_num_threads=1):
        # two at least: with one, joblib would do it in this process
        pool: Any = Parallel(max(workers, 2), return_as="generator_unordered", pre_dispatch="all", batch_size=1)  # pyright: ignore[reportArgumentType]
    try:
        yield from pool(delayed(_listed)(work, number, task) for number, task in enumerate(tasks))
    except TerminatedWorkerError:
        return


def _end_processes() -> None:
    """Stop joblib's idle workers now."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor(reuse=True).shutdown(wait=True)  # pyright: ignore[reportArgumentType]


def _on_cluster(client: Client, scheduler: str, work: Work, tasks: Tasks) -> Results:
    """By Dask; a task that ends process after process is given up."""
    from distributed import KilledWorker, as_completed
    from distributed.client import FutureCancelledError

    futures = [client.submit(_listed, work, number, task, pure=False) for number, task in enumerate(tasks)]
    for future in as_completed(futures, loop=client.loop):
        try:
            yield future.result()
        except KilledWorker:
            continue
        except FutureCancelledError:
            raise InputError("--scheduler", scheduler, "no answer any more", "a running scheduler") from None
        finally:
            future.release()  # otherwise it is repeated if its worker ends


def _listed(work: Work, number: int, task: tuple[Any, ...]) -> tuple[int, list[Any]]:
    """What work yields, in a process that is a worker's own."""
    os.environ |= ONE_THREAD  # of libraries that are yet to be loaded
    threadpool_limits(limits=1)  # of those that are
    return number, list(work(task))


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    try:
        from distributed import Client
        from distributed.comm.core import connect
    except ImportError:
        raise InputError("--scheduler", "", "no Dask", "the extra fleet: pip install 'pdr_graph[fleet]'") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # tracebacks of what is said here in a line

    async def greet() -> None:
        comm = await asyncio.wait_for(connect(scheduler, timeout=PATIENCE), PATIENCE + 1)
        await comm.close()

    try:
        with ThreadPoolExecutor(1) as thread:  # there may be a loop in this one
            thread.submit(asyncio.run, greet()).result()
    except (OSError, ValueError) as error:
        found = str(error) or "no answer"
        raise InputError("--scheduler", scheduler, found, "a Dask scheduler, as tcp://host:8786") from None
    with Client(scheduler, timeout=PATIENCE, set_as_default=False) as client:  # one that found nobody would hang
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
