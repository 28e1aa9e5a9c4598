"""Which fixes can all be of one walk: nobody gets from one to the next further than the steps lead.

A robust loss forgives scattered wild fixes. Those in a row that agree with one another (a receiver that settled on a
reflection, a beacon that is listed wrongly) bend the walk until the good ones beside them look wild, and no loss finds
back from there. But a walk that goes there must jump, twice: of all chains of fixes of which each is within reach of
the one before, the longest is believed first.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pdr_graph.geometry import row_times
from pdr_graph.types import Array, Fixes, Index, Mask, Steps

STRETCHED = 1.5  # times as far as strides say that a walk may lead
WITHIN = 5.0  # [σ] of both fixes
DRIVEN = 30.0  # [m/s] while the recording has a gap, who knows how
MOST_RUNS = 1000  # that are looked back


def within_reach(steps: Steps, fixes: Fixes, sigma: Array, used: Mask) -> tuple[Index, Mask]:
    """Of every fix ``(f,)`` its run, and whether it is of the longest chain.

    A run is of used fixes that follow one another within reach: they are believed or not together. Others are of
    run -1. sigma: ``(f,)`` [m] per axis.
    """
    run, believed = np.full(len(fixes), -1), np.zeros(len(fixes), dtype=bool)
    order = np.flatnonzero(used)
    order = order[np.argsort(fixes.time[order], kind="stable")]
    if not len(order):
        return run, believed
    position, sigma, walked = fixes.position[order], sigma[order], _walked(steps, fixes.time[order])

    def reaches(one: Index, other: Index) -> Mask:
        apart = np.hypot(*(position[other] - position[one]).T)
        return apart <= STRETCHED * (walked[other] - walked[one]) + WITHIN * np.hypot(sigma[one], sigma[other])

    every = np.arange(len(order))
    begins = np.append(True, ~reaches(every[:-1], every[1:]))
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(order)) - 1
    run[order] = np.cumsum(begins) - 1
    believed[order] = np.isin(run[order], _longest_chain(first, last, reaches))
    return run, believed


def _longest_chain(first: Index, last: Index, reaches: Callable[[Index, Index], Mask]) -> list[int]:
    """The runs, from ``first`` to ``last`` fix ``(r,)``, of the chain that holds most fixes; the earliest of equals."""
    fixes, before = last - first + 1, np.full(len(first), -1)
    for run in range(1, len(first)):
        earlier = np.arange(max(0, run - MOST_RUNS), run)
        earlier = earlier[reaches(last[earlier], first[run])]
        if len(earlier):
            before[run] = earlier[np.argmax(fixes[earlier])]
            fixes[run] += fixes[before[run]]
    chain = [int(np.argmax(fixes))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return chain


def _walked(steps: Steps, time: Array) -> Array:
    """How far the steps have led by ``time (n,)``. [m]"""
    moved = np.where(steps.length == 0, DRIVEN * steps.duration, steps.length)
    return np.interp(time, row_times(steps)[:-1], np.append(0.0, np.cumsum(moved)))
