"""Time limits of a build: of an item in a worker process, and of a fleet that writes no results."""

from __future__ import annotations

import faulthandler
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from io import TextIOWrapper
from threading import Lock, get_ident
from time import monotonic
from typing import TypeVar

Item = TypeVar("Item")

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
