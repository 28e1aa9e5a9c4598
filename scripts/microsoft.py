"""Microsoft's fifteen walks: errors at the waypoints that were not given, by method and by what was given."""

from functools import cache

import numpy as np
from recorded import WAYPOINT_NOISE, Walk, fixes_as_track, gaps, helped
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, kalman_filter, kalman_smoother, magnetic_headings, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.gait.steps import gait_signals
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes

HELP = {
    "every second waypoint": lambda n: np.unique(np.append(np.arange(0, n, 2), n - 1)),
    "first and last": lambda n: np.array([0, n - 1]),
    "first only": lambda n: np.array([0]),
}
METHODS = {
    "straight lines": lambda walk: fixes_as_track(walk.fixes),
    "dead reckoning": lambda walk: smooth(WalkGraph(walk.steps, walk.fixes)).dead_reckoning,
    "filter (causal)": lambda walk: kalman_filter(graph_of(walk)).trajectory,
    "filter, smoothed (RTS)": lambda walk: kalman_smoother(graph_of(walk)).trajectory,
    "graph": lambda walk: smooth(graph_of(walk)).trajectory,
    "graph with map": lambda walk: smooth(graph_of(walk, floor=walk.floor)).trajectory,
}


def recording_paths(data):
    """The files of the fifteen."""
    paths = sorted((data / "ms_indoor20").glob("site*/*/*.txt"))
    if not paths:
        raise SystemExit(f"no recordings under {data} (set PDR_GRAPH_DATA)")
    return paths


@cache
def recordings(data):
    """The fifteen: each recording, and the walk with all its waypoints as truth and no fix."""
    return [recording_at(path) for path in recording_paths(data)]


@cache
def recording_at(path):
    """One recording, and the walk with all its waypoints as truth and no fix."""
    return walk_of(load(path), _floor(path.parent), path)


@cache
def _floor(folder):
    return FloorPlan.load(folder)


def walk_of(recording, floor, path):
    """A recording, and the walk that it is of."""
    gaits = gait_signals(recording)
    headings = magnetic_headings(gaits, floor.frame, np.zeros(2))
    name = f"{path.parent.parent.name}/{path.parent.name} {path.stem[:12]}"
    return recording, Walk(name, detect_steps(gaits), headings, Fixes.none(), recording.truth, floor)


def helped_walks(data, given):
    """Each recording that has a waypoint left to be scored at, and its walk."""
    both = [helped_walk(one, given) for one in recordings(data)]
    return [(recording, walk) for recording, walk in both if len(walk.truth)]


def helped_walk(one, given):
    """A recording, and its walk with the waypoints that are given as fixes; the others are its truth."""
    recording, walk = one
    return recording, helped(walk, HELP[given](len(walk.truth)))


def microsoft_walks(data):
    """The walks by what is given of them."""
    for given in HELP:
        yield given, [walk for _, walk in helped_walks(data, given)]


def graph_of(walk, **more):
    return WalkGraph(walk.steps, walk.fixes, headings=walk.headings, **more)


def withheld_errors(walk, method):
    """Errors [m] at the waypoints that were not given, whether each is inside its 90 % region, and wall crossings."""
    track = method(walk)
    inside = np.empty(0, dtype=bool)
    if track.covariance is not None:
        _, inside, _ = gaps(track, walk.truth, WAYPOINT_NOISE)
    crossings = walk.floor.crosses_wall(track.position[:-1], track.position[1:]).mean()
    return circular_error(pair(track, walk.truth)), inside, crossings


def percentiles_with_interval(groups, draws=2000):
    """CE50/75/95 and their 95 % bootstrap intervals: whole walks are drawn, since errors in one walk are alike."""
    random = np.random.default_rng(0)
    at = [50, 75, 95]
    samples = [
        np.percentile(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]), at)
        for _ in range(draws)
    ]
    low, high = np.percentile(samples, [2.5, 97.5], axis=0)
    values = np.percentile(np.concatenate(groups), at)
    return [f"{v:.2f} ({a:.2f}–{b:.2f})" for v, a, b in zip(values, low, high, strict=True)]


def microsoft(data):
    """CE at waypoints that were not given, by method and by what was given."""
    rows = []
    for given, walks in microsoft_walks(data):
        for name, method in METHODS.items():
            if given == "first only" and name == "straight lines":
                continue
            results = [withheld_errors(walk, method) for walk in walks]
            errors, inside = [r[0] for r in results], np.concatenate([r[1] for r in results])
            crossing = np.mean([r[2] for r in results])
            coverage = f"{100 * inside.mean():.0f} %" if len(inside) else "—"
            rows.append([given, name, *percentiles_with_interval(errors), coverage, f"{100 * crossing:.1f} %"])
    header = ["given", "method", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region", "rows that cross a wall"]
    publish("results/microsoft.md", "microsoft", table(header, rows))
