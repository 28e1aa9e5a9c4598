"""A particle filter beside the graph of a walk under way, to find other paths on the plan.

Walls are local constraints: a graph in the wrong aisle stays there. The particles follow every step; if most of them
are elsewhere than the graph, their path is an alternative for it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from pdr_graph.estimation.ambiguity.path_modes import dominant_modes
from pdr_graph.estimation.factors.chain import Pieces
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.window import Interval, Path
from pdr_graph.estimation.particle_filter import LEAST_STRIDE, KeyframeMeasurements, ParticleFilter, Paths, resampled
from pdr_graph.floor.building import Building
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.geometry import differences
from pdr_graph.priors import LIVE_PATHS, SEARCH
from pdr_graph.types import Array, Index

JOBS, BACKLOG = 3, 15  # jobs per call; queue length from which jobs are done even if the graph is busy
FEW = LIVE_PATHS.fewest // 2  # particles of a prediction: a quarter of a metre of its mean, where they are 4 m apart


class ParallelParticleFilter:
    """A particle filter that runs in small jobs between the updates of the graph.

    belief, time [s], label: state and floor at which it starts. times: of its keyframes [s]; elsewhere: the ways of the
    particles that are not where the graph is, see `ways_elsewhere`, at the last keyframe.
    """

    def __init__(self, plan: Building, prior: Prior, belief: GaussianMixture, time: float, label: str):
        self.plan, self.label, self.times = plan, label, [time]
        self._jobs = deque[Callable[[], bool]]()  # each returns True if it closes a keyframe
        self.elsewhere: GaussianMixture | None = None
        self._filter = ParticleFilter(prior, seed=0, fewest=LIVE_PATHS.fewest, most=LIVE_PATHS.most, at_once=1)
        self._filter.begin_at(drawn(belief, LIVE_PATHS.most, self._filter.random, LIVE_PATHS.spread)[0])

    def enqueue(self, interval: Interval, measurements: KeyframeMeasurements) -> None:
        """Queue the next interval and the measurements at its end."""
        pieces, floor = interval.pieces, self.plan[interval.label]
        turn, time = (2 * (pieces.to_end - pieces.to_middle)).tolist()

        def step(m: int, changed: set[int]) -> bool:
            """Move by piece m, through stairs or lifts if the floor has ``changed`` before it."""
            if changed:
                ways = [way.field for way in self.plan.connections if changed <= set(way.floors)]
                self._filter.change_floor(ways)
            self._filter.step(float(pieces.length[m]), turn[m], time[m], pieces.variance[m], floor.distance)
            return False

        def close() -> bool:
            self._filter.close(measurements)
            self.times.append(interval.end)
            return True

        floors = {self.plan.index(self.label), self.plan.index(interval.label)}
        self._jobs += [partial(step, m, floors if m == 0 and len(floors) > 1 else set()) for m in range(len(turn))]
        self._jobs.append(close)
        self.label = interval.label

    def process(self, busy: bool) -> bool:
        """Do up to JOBS queued jobs, none if the graph is ``busy`` and few wait; True if a keyframe was closed."""
        if busy and len(self._jobs) < BACKLOG:
            return False
        return any(self._jobs.popleft()() for _ in range(min(JOBS, len(self._jobs))))

    def alternative_path(self, position: Array) -> Path | None:
        """The heaviest path if most particles are apart from the graph, which is at ``position (2,)`` [m]."""
        paths = self._filter.paths()
        modes = dominant_modes(paths)
        self.elsewhere = ways_elsewhere(paths, [which for _, which in modes], position)
        share, which = modes[0]
        path = paths.state[:, :, which]
        gone = 0.0 if self.elsewhere is None else float(np.exp(self.elsewhere.log_weight).sum())
        most = share > LIVE_PATHS.dominant or gone > LIVE_PATHS.mostly
        if not most or np.hypot(*(path[-1, :2] - position)) <= SEARCH.same_path:
            return None
        time = np.array(self.times)
        return Path(time, path[:, :3], time, path[:, 3:]).uniform

    def forget(self, before: float) -> None:
        """Drop keyframes from before ``before`` [s]."""
        count = min(int(np.searchsorted(self.times, before)), len(self.times) - 1)
        self._filter.forget(count)
        del self.times[:count]


class PredictionBetweenWalls:
    """Predicts a mixture through the steps after it by particles, which walls stop.

    The provisional steps of seven to ten seconds follow the last keyframe. All but the last five or six stay as they
    are when they are detected again, and are not predicted again. Each step has random numbers of its own and all walls
    at once, so that the result does not depend on how often it is asked for.
    """

    def __init__(self, prior: Prior):
        self._filter = ParticleFilter(prior, 0, fewest=FEW, most=FEW)
        self._begun: tuple[GaussianMixture, DistanceField] | None = None
        self._done = np.empty((0, 5))  # pieces that the particles went through: length, turn, time, variance
        self._after = list[tuple[Array, Array, Index]]()  # state, logarithm of the weight, mode; before and after each

    def predict(self, ways: GaussianMixture, pieces: Pieces, floor: DistanceField) -> GaussianMixture:
        """The mixture after an interval of pieces, between the walls of a floor.

        A mode whose particles meet walls loses weight to the others.
        """
        rows = np.column_stack([pieces.length, *2 * (pieces.to_end - pieces.to_middle), pieces.variance])
        if self._begun is None or self._begun[0] is not ways or self._begun[1] is not floor:
            self._begin(ways, floor)
        shared = min(len(rows), len(self._done))
        different = np.flatnonzero((rows[:shared] != self._done[:shared]).any(axis=1))
        if len(different) or len(rows) > shared:
            kept = int(different[0]) if len(different) else shared
            del self._after[kept + 1 :]
            for n in range(kept, len(rows)):
                self._after.append(self._moved(n, rows[n], floor))
            self._done = rows
        return self._grouped(*self._after[len(rows)])

    def _begin(self, ways: GaussianMixture, floor: DistanceField) -> None:
        state, mode = drawn(ways, FEW, np.random.default_rng(0))
        nothing = np.zeros(len(mode))
        self._begun, self._done, self._after = (ways, floor), self._done[:0], [(state, nothing, mode)]

    def _moved(self, n: int, row: Array, floor: DistanceField) -> tuple[Array, Array, Index]:
        """The particles after piece n, resampled if few of them have most of the weight."""
        particles, (state, weight, mode) = self._filter, self._after[n]
        particles.state, particles.weight, particles.random = state, weight, np.random.default_rng(n)
        length, turn, time = row[:3].tolist()
        particles.step(length, turn, time, row[3:], floor)
        weight = particles.weight - np.logaddexp.reduce(particles.weight)
        if np.exp(2 * weight).sum() * len(weight) < 2:  # half of them count
            return particles.state, weight, mode
        which = resampled(weight, len(weight), particles.random)
        return particles.state[:, which], np.zeros(len(which)), mode[which]

    def _grouped(self, state: Array, weight: Array, mode: Index) -> GaussianMixture:
        """The mean, covariance and weight of the particles of each mode that is left."""
        share = np.exp(weight - np.logaddexp.reduce(weight))
        total = np.bincount(mode, share)
        left = np.flatnonzero(total > (LIVE_PATHS.least_share if len(total) > 1 else 0.0))
        ways = [moments(state[:, mode == n].T, share[mode == n]) for n in left.tolist()]
        mean, covariance = (np.array(each) for each in zip(*ways, strict=True))
        every = np.arange(len(left))
        return GaussianMixture(mean, covariance, np.log(total[left]), every).take(every)


def drawn(ways: GaussianMixture, count: int, random: np.random.Generator, spread: float = 1.0) -> tuple[Array, Index]:
    """States ``(6, n)`` drawn from a mixture, and the mode of each. spread: factor of its sigmas."""
    share = np.exp(ways.log_weight - np.logaddexp.reduce(ways.log_weight))
    mode = np.repeat(np.arange(len(ways)), random.multinomial(count, share))
    # Not checked: a covariance is positive semidefinite but for rounding
    state = [
        random.multivariate_normal(ways.mean[n], spread**2 * ways.covariance[n], of_mode, check_valid="ignore").T
        for n, of_mode in enumerate(np.bincount(mode, minlength=len(ways)).tolist())
    ]
    every = np.concatenate(state, axis=1)
    every[3] = np.maximum(every[3], LEAST_STRIDE)
    return every, mode


def moments(state: Array, weight: Array) -> tuple[Array, Array]:
    """Mean ``(6,)`` and covariance ``(6, 6)`` of states ``(n, 6)``; the mean of directions is circular."""
    weight = weight / weight.sum()
    mean = weight @ state
    mean[2] = np.angle(weight @ np.exp(1j * state[:, 2]))
    off = differences(state, mean)
    return mean, off.T * weight @ off


def ways_elsewhere(paths: Paths, middles: Sequence[int], position: Array) -> GaussianMixture | None:
    """The paths of particles that are not where the graph is, with the logarithm of their share; None without any.

    middles: the middle particle of each mode; a particle belongs to the nearest. position: of the graph ``(2,)`` [m].
    """
    state, ways = paths.state[-1], list[tuple[Array, Array, float]]()
    apart = np.hypot(*(state[:2, None] - state[:2, middles][:, :, None]))
    mode = np.where(np.hypot(*(state[:2] - position[:, None])) < SEARCH.same_path, -1, np.argmin(apart, axis=0))
    for k in range(len(middles)):
        own, weight = state[:, mode == k].T, paths.weight[mode == k]
        share = float(weight.sum())
        if share > LIVE_PATHS.least_share:
            ways.append((*moments(own, weight), np.log(share)))
    if not ways:
        return None
    mean, covariance, log_share = map(np.array, zip(*ways, strict=True))
    return GaussianMixture(mean, covariance, log_share, np.arange(len(ways)))
