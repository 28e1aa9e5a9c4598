"""Tasks in other processes: what a worker process does with one, and how the build waits for them."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from time import sleep
from typing import Any

from threadpoolctl import threadpool_limits

from pdr_graph.lifelog.time_limits import limited

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Tasks = Sequence[tuple[Any, ...]]
Work = Callable[[tuple[Any, ...]], Iterator[Any]]
Look = Callable[[], None]  # called while waiting; raises FleetLostError


def knowing_kinds(work: Work) -> Work:
    """The work, for a process that has yet to learn the kinds of measurements that this one has registered."""
    factors: Any = sys.modules.get("pdr_graph.estimation.factors")  # not loaded: nothing was registered
    kinds = factors.kinds_of_others() if factors else []
    return partial(_with_kinds, kinds, work) if kinds else work


def _with_kinds(kinds: Sequence[tuple[type, tuple[Any, ...]]], work: Work, task: tuple[Any, ...]) -> Iterator[Any]:
    """Register kinds of measurements, and do the work."""
    from pdr_graph.estimation.factors import register

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
