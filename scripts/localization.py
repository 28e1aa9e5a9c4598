"""Without any position: how often the place of a walk is found on its plan, and how sure that is said to be.

python scripts/localization.py [WALKS] [--write]: so many simulated walks on each floor, by default 3; the seeds are not
those on which the constants were chosen.
"""

import os
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import topology
from microsoft import recording_at, recording_paths
from tables import publish, table
from topology import BINS, SURE, WRONG, floors

from pdr_graph import WalkGraph, smooth
from pdr_graph.geometry import interpolate

DATA = Path(os.environ.get("PDR_GRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
SEEDS, WALKS, LENGTH = 810_000, 3, (120.0, 400.0)  # [m]
HEADER = ["plan", "compass", "walks", "walkable [m²]", "duration [s]", "first route right", "a listed route right"]
HEADER += ["mean stated", "stated over 90 %", "of these right", "CPU [s]", "longest"]


@dataclass(frozen=True)
class Outcome:
    """What became of a walk: its row, area of its floor [m²], duration [s], probability stated, mean error of the first
    route and least of all routes [m], processor time [s]."""

    row: tuple[str, str]
    area: float
    duration: float
    stated: float
    error: float
    least: float
    seconds: float

    @property
    def right(self):
        """Near the truth all along."""
        return self.error < WRONG


def localization(data=DATA, walks=WALKS):
    """Both tables."""
    jobs = [partial(real, path, compass) for path in recording_paths(data) for compass in (True, False)]
    for kind, places in floors(data).items():
        for number, (path, label) in enumerate(places, start=10 * (kind == "drawn")):
            seeds = SEEDS + 1000 * number + np.arange(walks)
            jobs += [partial(simulated, kind, path, label, int(seed)) for seed in seeds]
    with ProcessPoolExecutor() as pool:
        found = [one for some in pool.map(_call, jobs) for one in some]
    rows = list(dict.fromkeys(one.row for one in found))
    text = table(HEADER, [described(row, [one for one in found if one.row == row]) for row in rows])
    publish("results/localization.md", "localization", f"{text}\n\n{reliability(found)}")


def _call(job):
    warnings.simplefilter("ignore")
    return job()


def real(path, compass):
    """A Microsoft recording without its waypoints."""
    _, walk = recording_at(path)
    row = ("Microsoft's fifteen recordings", "yes" if compass else "no")
    return [outcome(row, walk.floor, walk.steps, walk.headings if compass else None, walk.truth)]


def simulated(kind, path, label, seed):
    """A simulated walk, with and without its compass."""
    walk = _walked(path, label, seed)
    return [
        outcome((f"simulated, {kind}", said), walk.floor, walk.steps, headings, walk.truth)
        for said, headings in (("yes", walk.headings), ("no", None))
    ]


def _walked(path, label, seed):
    """A walk along a route of LENGTH."""
    route, topology.route = topology.route, partial(topology.route, ways=LENGTH)
    try:
        return topology.walked(path, label, seed)
    finally:
        topology.route = route


def outcome(row, floor, steps, headings, truth):
    """What is found of a walk by its steps, its headings and the plan."""
    began = time.process_time()
    estimate = smooth(WalkGraph(steps, headings=headings, floor=floor))
    seconds = time.process_time() - began
    errors = [mean_error(track, truth) for _, track in estimate.routes]
    duration = steps.end - steps.start
    return Outcome(row, floor.walkable_area, duration, estimate.probability, errors[0], min(errors), seconds)


def mean_error(track, truth):
    """Mean distance from the truth at its times [m]."""
    at = interpolate(truth.time, track.time, track.position)
    return float(np.hypot(*(at - truth.position).T).mean())


def described(row, some):
    """A row about some outcomes."""
    sure = [one for one in some if one.stated > SURE]
    share = [one.right for one in some], [one.least < WRONG for one in some], [one.stated for one in some]
    return [
        *row,
        len(some),
        *(f"{low:.0f}–{high:.0f}" for low, high in (_range(some, "area"), _range(some, "duration"))),
        *(f"{100 * np.mean(values):.0f} %" for values in share),
        len(sure),
        sum(one.right for one in sure),
        f"{np.median([one.seconds for one in some]):.1f}",
        f"{max(one.seconds for one in some):.1f}",
    ]


def _range(some, name):
    values = [getattr(one, name) for one in some]
    return min(values), max(values)


def reliability(found):
    """How often walks are right that say how sure they are."""
    rows = []
    for low, high in pairwise(BINS):
        here = [one for one in found if low < one.stated <= high or one.stated == low == 0]
        if here:
            share = np.mean([one.stated for one in here]), np.mean([one.right for one in here])
            rows.append([f"{100 * low:.0f}–{100 * high:.0f} %", len(here), *(f"{100 * s:.0f} %" for s in share)])
    return table(["stated", "walks", "mean stated", "right"], rows)


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word.isdigit()]
    localization(walks=numbers[0] if numbers else WALKS)
