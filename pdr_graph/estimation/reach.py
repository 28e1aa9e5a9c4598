"""Which fixes can all be of one walk: nobody gets from one to the next further than the steps lead.

A robust loss forgives scattered wild fixes. Those in a row that agree with one another (a receiver that settled on a
reflection, a beacon that is listed wrongly) bend the walk until the good ones beside them look wild, and no loss finds
back from there. But a walk that goes there must jump, twice: of all chains of fixes of which each is within reach of
the one before, the longest is believed first.
"""

from __future__ import annotations

import numpy as np

from pdr_graph.geometry import walked
from pdr_graph.types import Array, Fixes, Index, Mask, Steps

STRETCHED = 1.5  # times as far as strides say that a walk may lead
WITHIN = 5.0  # [σ] of both fixes
DRIVEN = 30.0  # [m/s] while the recording has a gap, who knows how
MOST_RUNS = 1000  # that are looked back
ENDS = 3  # fixes at the end of a run that may lead to the next: a wild one just within reach must not part two runs


def within_reach(steps: Steps, fixes: Fixes, sigma: Array, used: Mask) -> tuple[Index, Mask]:
    """Of every fix ``(f,)`` its run, and whether it is of the longest chain that one walk can have made.

    A run is of used fixes that follow one another within reach: they are believed or not together. Others are of
    run -1. sigma: ``(f,)`` [m] per axis.
    """
    run, believed = np.full(len(fixes), -1), np.zeros(len(fixes), dtype=bool)
    order = np.flatnonzero(used)
    order = order[np.argsort(fixes.time[order], kind="stable")]
    if len(order):
        moved = np.where(steps.length == 0, DRIVEN * steps.duration, steps.length)
        way = STRETCHED * walked(steps, fixes.time[order], moved)
        run[order], believed[order] = chained(fixes.position[order], WITHIN * sigma[order], way, np.inf, ENDS)
    return run, believed


def chained(position: Array, error: Array, way: Array, jump: float, ends: int = 1) -> tuple[Index, Mask]:
    """The run of each of at least one fix ``(f,)``, and whether it is of the longest chain.

    position: ``(f, 2)`` [m] in order of time; error: ``(f,)`` at most [m]; way: ``(f,)`` at most, since the start [m].
    jump: as how many fixes it counts against a chain to go where nobody could; ends: how many fixes at a run's end,
        and at the start of the next, may lead on.
    """

    def reaches(one: Index, other: Index) -> Mask:
        apart = np.linalg.norm(position[other] - position[one], axis=-1)
        return apart <= way[other] - way[one] + np.hypot(error[one], error[other])

    every = np.arange(len(position))
    begins = np.append(True, ~reaches(every[:-1], every[1:]))
    first, run = np.flatnonzero(begins), np.cumsum(begins) - 1
    last = np.append(first[1:], len(position)) - 1
    length, before = (last - first + 1).astype(float), np.full(len(first), -1)
    for n in range(1, len(first)):
        earlier = np.arange(max(0, n - MOST_RUNS), n)
        leaving = np.maximum(last[earlier, None] - np.arange(ends), first[earlier, None])
        entering = np.minimum(first[n] + np.arange(ends), last[n])
        led = np.any([reaches(leaving, np.full_like(leaving, at)) for at in entering], axis=(0, 2))
        gain = length[earlier] - np.where(led, 0.0, jump)
        if gain.max() > 0:
            before[n] = earlier[np.argmax(gain)]
            length[n] += gain.max()
    chain = [int(np.argmax(length))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return run, np.isin(run, chain)
