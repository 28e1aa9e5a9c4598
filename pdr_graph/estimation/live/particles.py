"""Where else the plan lets a walk under way have gone: a cloud of particles beside the graph.

Walls are local: a graph that went into the wrong aisle stays there. The cloud goes with every step, and where most of
it is elsewhere than the graph the way that it took is one to try.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.factors.base import poses_at
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.live.prediction import Belief
from pdr_graph.estimation.live.step_buffer import Interval
from pdr_graph.estimation.optimizer import SAME_PATH
from pdr_graph.estimation.particle_filter import KeyframeMeasurements, ParticleFilter
from pdr_graph.estimation.path_modes import dominant_modes
from pdr_graph.floor.building import Building
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.types import Array

FEWEST, MOST = 500, 1000  # particles: more are in the right aisle no more often
JOBS, BACKLOG = 3, 15  # of the cloud with each step that has nothing else to do, and with any when so many wait
MOSTLY = 0.7  # of the particles in one bundle, of which the present is right 96 times in a hundred
AGREED = 2  # keyframes in a row at which they are elsewhere
SEED = 0


@dataclass(frozen=True)
class OtherPath:
    """time ``(k,)`` [s] and state ``(k, 6)``: x, y, θ, R_s, R_d, b."""

    time: Array
    state: Array

    def poses(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at some times."""
        return poses_at(time, self.time, self.state[:, :3])


@dataclass(frozen=True)
class _Piece:
    length: float
    turn: float
    time: float
    variance: Array
    label: str


@dataclass(frozen=True)
class _Keyframe:
    time: float
    seen: KeyframeMeasurements


class ParallelParticleFilter:
    """The cloud of a walk whose place and direction are known by ``belief`` at a ``time`` [s], on a floor."""

    def __init__(self, plan: Building, prior: Prior, belief: Belief, time: float, label: str):
        self.plan, self.label, self.times = plan, label, [time]
        self._jobs: deque[_Piece | _Keyframe] = deque()
        self._apart = 0
        spread = np.sqrt(np.diag(belief.covariance))
        self._cloud = ParticleFilter(prior, SEED, fewest=FEWEST, most=MOST, tiles=1)
        self._cloud.begin(belief.mean[:2], float(spread[:2].max()), float(belief.mean[2]), float(spread[2]))

    def add(self, one: Interval, seen: KeyframeMeasurements) -> None:
        """The next interval, and what was measured at its end: to be done bit by bit."""
        pieces = one.pieces
        turn, time = (2 * (pieces.to_end - pieces.to_middle)).tolist()
        for m, length in enumerate(pieces.length.tolist()):
            self._jobs.append(_Piece(length, turn[m], time[m], pieces.variance[m], one.label))
        self._jobs.append(_Keyframe(one.end, seen))

    def work(self, busy: bool) -> bool:
        """Do some of what is to be done, later if the graph is busy; whether a keyframe was."""
        if busy and len(self._jobs) < BACKLOG:
            return False
        for _ in range(min(JOBS, len(self._jobs))):
            job = self._jobs.popleft()
            if isinstance(job, _Keyframe):
                self._cloud.close(job.seen)
                self.times.append(job.time)
                return True
            if job.label != self.label:
                self._cloud.change_floor(self._between(self.label, job.label))
                self.label = job.label
            floor = self.plan.floors[self.plan.index(job.label)]
            self._cloud.step(job.length, job.turn, job.time, job.variance, floor.distance)
        return False

    def elsewhere(self, place: Array) -> OtherPath | None:
        """The way of most particles, if for a while it has not been where the graph is, now at ``place (2,)`` [m]."""
        paths = self._cloud.paths()
        share, which = dominant_modes(paths)[0]
        way = paths.state[:, :, which]
        apart = share > MOSTLY and np.hypot(*(way[-1, :2] - place)) > SAME_PATH
        self._apart = self._apart + 1 if apart else 0
        if self._apart < AGREED:
            return None
        self._apart = 0
        return OtherPath(np.array(self.times), way)

    def forget(self, before: float) -> None:
        """Let go of what was before the window [s]."""
        count = min(int(np.searchsorted(self.times, before)), len(self.times) - 1)
        self._cloud.forget(count)
        del self.times[:count]

    def _between(self, one: str, other: str) -> list[DistanceField]:
        """The stairs and lifts that lead from one floor to another."""
        floors = {self.plan.index(one), self.plan.index(other)}
        return [way.field for way in self.plan.connections if floors <= set(way.floors)]
