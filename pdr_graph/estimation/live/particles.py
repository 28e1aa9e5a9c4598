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
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.window import Interval, Path
from pdr_graph.estimation.particle_filter import LEAST_STRIDE, KeyframeMeasurements, ParticleFilter, Paths
from pdr_graph.floor.building import Building
from pdr_graph.geometry import differences
from pdr_graph.priors import LIVE_PATHS, SEARCH
from pdr_graph.types import Array

JOBS, BACKLOG = 3, 15  # jobs per call; queue length from which jobs are done even if the graph is busy


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
        wider = LIVE_PATHS.spread**2 * belief.covariance[0]
        # Not checked: the covariance is positive semidefinite but for rounding
        state = self._filter.random.multivariate_normal(belief.mean[0], wider, LIVE_PATHS.most, check_valid="ignore").T
        state[3] = np.maximum(state[3], LEAST_STRIDE)
        self._filter.begin_at(state)

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
            mean = weight @ own / share
            mean[2] = np.angle(weight @ np.exp(1j * own[:, 2]))
            off = differences(own, mean)
            ways.append((mean, off.T * weight @ off / share, np.log(share)))
    if not ways:
        return None
    mean, covariance, log_share = map(np.array, zip(*ways, strict=True))
    return GaussianMixture(mean, covariance, log_share, np.arange(len(ways)))
