"""Walks along the ways of a town, or across them, and what a phone measures of them; no sensors, only steps and fixes.

The walker takes random routes through a `PathNetwork`, each leg at its own distance from the drawn line. Errors of
steps are those of the front end on real walks; errors of the receiver are those of `sensors.gnss_fixes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pdr_graph.floor.paths import PathNetwork, WayPoints
from pdr_graph.geometry import interpolate, length_along, wrap_angle
from pdr_graph.priors import WAYS
from pdr_graph.types import Array, Fixes, Index, Mask, Steps

PERIOD, STRIDE = 0.53, 0.7  # [s], [m] of a step
LEG = 120.0, 400.0  # [m] from where a leg begins to where it leads, straight
SIGMA = 5.0  # [m] stated by the receiver, per axis
COMMON, LASTS, WHITE = 4.5, 50.0, 2.2  # [m], [s], [m] of its errors, as of `sensors.gnss_fixes`
EVERY = 2.0  # [s] between fixes


@dataclass(frozen=True)
class TownWalk:
    """A simulated walk. time, place: of the truth, at the start and the end of each step; on: along ways there."""

    steps: Steps
    time: Array
    place: Array
    on: Mask

    def at(self, time: Array) -> Array:
        """True places ``(n, 2)`` at times [s]. [m]"""
        return interpolate(time, self.time, self.place)


def town_walk(network: PathNetwork, seed: int, length: float = 1500.0, across: bool = False) -> TownWalk:
    """A walk of a length [m] along random routes. across: a third of it, in the middle, leads across all ways."""
    random = np.random.default_rng(seed)
    line, on = _route(network.points, random, length, across)
    walked = length_along(line)
    n = int(walked[-1] / STRIDE)
    at = np.linspace(0, walked[-1], n + 1)
    place = _smooth(interpolate(at, walked, line), 2.0)  # corners are cut
    along = on[np.clip(np.searchsorted(walked, at, side="right") - 1, 0, len(on) - 1)]
    steps = measured_steps(place, random)
    return TownWalk(steps, np.append(0.0, steps.time), place, along)


def measured_steps(place: Array, random: np.random.Generator, period: float = PERIOD) -> Steps:
    """The steps between places ``(n + 1, 2)`` [m] as a phone measures them. period: of a step [s]."""
    move, n = np.diff(place, axis=0), len(place) - 1
    heading = np.unwrap(np.arctan2(move[:, 1], move[:, 0]))
    turn, true = np.diff(heading, prepend=0.0), np.asarray(np.hypot(move[:, 0], move[:, 1]))
    time = np.arange(n + 1, dtype=np.float64) * period
    turn[0] = 0.0
    measured = turn * random.normal(1, 0.01) + random.normal(0, 0.02, n) + random.normal(0, 0.001) * period
    return Steps(
        start=0.0,
        end=float(time[-1]) + 0.5,
        time=time[1:],
        duration=np.full(n, period),
        length=true * random.normal(1, 0.05) + random.normal(0, 0.05, n),
        turn=wrap_angle(measured),
        pause_turn=np.zeros(n),
        sigma_length=np.full(n, 0.07),
        sigma_turn=np.full(n, 0.025),
    )


def _smooth(rows: Array, sigma: float) -> Array:
    """Rows smoothed along the first axis by a Gaussian of ``sigma`` rows."""
    return np.asarray(gaussian_filter1d(rows, sigma, axis=0), dtype=np.float64)


def _route(points: WayPoints, random: np.random.Generator, length: float, across: bool) -> tuple[Array, Mask]:
    """Corners ``(m, 2)`` of a random route [m], and whether each is on a way."""
    p = len(points.place)
    graph = coo_array((points.length, (points.edges[:, 0], points.edges[:, 1])), shape=(p, p)).tocsr()
    while True:
        here, parts, on, total, crossed = int(random.integers(p)), list[Array](), list[Mask](), 0.0, not across
        for _ in range(100):
            straight = np.hypot(*(points.place - points.place[here]).T)
            distance, before = dijkstra(graph, directed=False, indices=here, return_predecessors=True)
            crossing = not crossed and total > length / 3
            least, most = (length / 3 - 50, length / 3 + 50) if crossing else LEG
            to = np.flatnonzero((straight > least) & (straight < most) & np.isfinite(distance))
            to = to[distance[to] < 2.5 * straight[to]]
            if not len(to):
                break
            there = int(random.choice(to))
            if crossing:
                leg, crossed = _meander(points.place[here], points.place[there], random), True
            else:
                leg = _aside(points, _traced(before, here, there), random)
            parts.append(leg)
            on.append(np.full(len(leg), not crossing))
            total, here = total + float(length_along(leg)[-1]), there
            if total > length and crossed:
                return np.concatenate(parts), np.concatenate(on)


def _traced(before: Array, here: int, there: int) -> Index:
    """The points from one to another on the shortest way."""
    chain = [there]
    while chain[-1] != here:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def _aside(points: WayPoints, chain: Index, random: np.random.Generator) -> Array:
    """The line of a leg, beside the drawn line by some share of the width, and by what that is off."""
    line = points.place[chain]
    move = _smooth(np.gradient(line, axis=0), 1.0)
    normal = np.stack([-move[:, 1], move[:, 0]], axis=1) / np.maximum(np.hypot(*move.T), 1e-6)[:, None]
    half = np.sqrt(np.maximum(points.sigma[chain] ** 2 - WAYS.drawn**2, 0.0)) / WAYS.side
    off = half * random.uniform(-1, 1) + random.normal(0, WAYS.drawn)
    return line + normal * _smooth(off[:, None], 3.0)


def _meander(here: Array, there: Array, random: np.random.Generator) -> Array:
    """A line that no way follows: a wide arc with waves."""
    share = np.linspace(0, 1, 100)[:, None]
    along = there - here
    normal = np.array([-along[1], along[0]])
    bend, wave = random.uniform(-0.2, 0.2), random.uniform(-0.03, 0.03)
    return here + share * along + normal * (bend * np.sin(np.pi * share) + wave * np.sin(5 * np.pi * share))


def fixes_of(walk: TownWalk, seed: int) -> Fixes:
    """The fixes of an honest receiver."""
    random = np.random.default_rng(seed + 1_000_000)
    time = np.arange(1.0, walk.time[-1], EVERY, dtype=np.float64)
    n, keep = len(time), np.exp(-EVERY / LASTS)
    noise = random.normal(0, COMMON * np.sqrt(1 - keep**2), (n, 2))
    noise[0] = random.normal(0, COMMON, 2)
    error = lfilter([1], [1, -keep], noise, axis=0) + random.normal(0, WHITE, (n, 2))
    return Fixes(time, walk.at(time) + error, np.full(n, SIGMA), ("",) * n, source=("GPS",) * n)


def displaced(fixes: Fixes, random: np.random.Generator, by: float = 10.0) -> Fixes:
    """The fixes, all off by some metres to the same side."""
    angle = random.uniform(0, 2 * np.pi)
    return replace(fixes, position=fixes.position + by * np.array([np.cos(angle), np.sin(angle)]))


def jumping(fixes: Fixes, random: np.random.Generator) -> Fixes:
    """The fixes, a tenth of them off by 20 to 60 m, for 10 to 30 s at a time."""
    position = fixes.position.copy()
    for begin in random.uniform(fixes.time[0], fixes.time[-1] - 30, int((fixes.time[-1] - fixes.time[0]) / 200)):
        angle, by = random.uniform(0, 2 * np.pi), random.uniform(20, 60)
        held = (fixes.time > begin) & (fixes.time < begin + random.uniform(10, 30))
        position[held] += by * np.array([np.cos(angle), np.sin(angle)])
    return replace(fixes, position=position)


def late(fixes: Fixes, random: np.random.Generator, by: float = 5.0) -> Fixes:
    """The fixes, each stated some seconds after it was true."""
    kept = fixes[np.arange(len(fixes) - int(np.ceil(by / EVERY)))]
    return replace(kept, time=kept.time + by)


def outages(fixes: Fixes, each: float, count: int) -> Mask:
    """``(f,)`` True for fixes within ``count`` outages of ``each`` [s], evenly spread."""
    begin, end = fixes.time[0], fixes.time[-1]
    middle = begin + (end - begin) * (np.arange(count) + 0.5) / count
    return (np.abs(fixes.time[:, None] - middle) < each / 2).any(axis=1)


def lawn(network: PathNetwork, walk: TownWalk, around: float = 40.0) -> PathNetwork:
    """The network without ways on the lawn that a walk crosses: those within a distance [m] of it, but for its ends."""
    off = walk.place[~walk.on]
    inner = off[len(off) // 10 : -(len(off) // 10)]
    return network.outside(shapely.LineString(inner).buffer(around, quad_segs=8))
