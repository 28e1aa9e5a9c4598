"""Workers of a build on a Dask cluster, any of which may go at any time, as may the scheduler."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from time import monotonic
from typing import TYPE_CHECKING, Any

from pdr_graph.errors import InputError, install
from pdr_graph.lifelog.remote_tasks import Look, Tasks, Work, collected, finished
from pdr_graph.lifelog.time_limits import FleetLostError

if TYPE_CHECKING:
    from distributed import Client

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
