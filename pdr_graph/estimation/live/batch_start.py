"""Start and direction of a walk under way, by the batch smoother, until they are certain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.ambiguity.bank import paths, probabilities
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.factors.base import decisions_of, poses_at
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import sigma_direction
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.measurement_log import Decisions, numbered
from pdr_graph.estimation.live.particles import AlternativePath
from pdr_graph.estimation.live.prediction import Position, in_output_axes
from pdr_graph.estimation.optimizer import Optimum
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.priors import INITIAL, KALMAN, REPORTS, SCHEDULE
from pdr_graph.types import Array, Index


@dataclass(frozen=True)
class BatchSolution:
    """The most probable walk so far.

    time: ``(m + 1,)`` start and ends of the pieces [s]; pose: ``(m + 1, 3)`` there; segment_start: ``(s,)`` [s]; c:
    ``(s, 3)``; decisions: about measurements, by kind; sure: no other path is likely, and the direction is certain;
    modes: all paths that remain, at the end; directed: each has a direction; headings: numbers of those that it used.
    """

    time: Array
    pose: Array
    segment_start: Array
    c: Array
    decisions: Decisions
    sure: bool
    modes: GaussianMixture
    directed: bool
    headings: Index

    @property
    def near(self) -> Position:
        """The end as a fix, for a walk of unknown direction."""
        sigma = float(horizontal_sigma(self.modes.covariance[0]))
        return Position(float(self.time[-1]), self.pose[-1, :2], sigma, 1.0)

    @property
    def path(self) -> AlternativePath:
        """The walk as a path to try."""
        return AlternativePath(self.time, np.column_stack([self.pose, np.tile(self.c[-1], (len(self.time), 1))]))

    def poses(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at times ``(n,)`` [s]."""
        return poses_at(time, self.time, self.pose)

    def calibration(self, time: float) -> Array:
        """(R_s, R_d, b) ``(3,)`` at a time [s]."""
        return self.c[max(int(np.searchsorted(self.segment_start, time)) - 1, 0)]


@dataclass(frozen=True)
class BatchQuestion:
    """A solution that is due.

    graph: builds that of the window; numbers: permanent numbers of its rows, by kind.
    """

    graph: Callable[[], WalkGraph]
    numbers: dict[str, Index]

    def answer(self) -> BatchSolution:
        """The most probable walk, with a test whether it is certain, and the other ways that remain."""
        graph = self.graph()
        optima = solutions(graph)
        best, path = optima[0], paths(optima)
        walled, at, chain = best.graph.walled, best.at, best.at.chain
        probability = probabilities(optima, path)
        modes = modes_at_end(optima, probability)
        variance = modes.covariance[:, 2, 2]
        certain = float(probability[path == 0].sum()) > REPORTS.sure
        long = graph.steps.end - graph.steps.start > SCHEDULE.least_duration
        determined = not walled or sigma_direction(graph.chain, graph.positions) < INITIAL.ambiguous or long
        narrow = variance[0] < (SCHEDULE.most_sigma_on_plan if walled else SCHEDULE.most_sigma) ** 2
        return BatchSolution(
            time=np.append(chain.time[0], chain.time[:-1][at.pieces.interval] + at.pieces.to_end[1]),
            pose=np.vstack([at.pose_i[:1], at.ends]),
            segment_start=chain.time[chain.segment_first],
            c=best.state.c,
            decisions={} if best.graph.positions.approximate else self._decisions(best.graph),
            sure=bool(certain and determined and narrow),
            modes=modes,
            directed=bool((variance < INITIAL.ambiguous**2).all()),
            headings=self.numbers.get("headings", np.empty(0, dtype=np.intp)),
        )

    def alternative(self) -> tuple[AlternativePath, Decisions]:
        """The most probable walk as a path to try, and the decisions on it."""
        solution = self.answer()
        return solution.path, solution.decisions

    def _decisions(self, graph: WalkGraph) -> Decisions:
        found = {kind.name: decisions_of(kind) for kind in graph.measurements}
        return {name: numbered(rows, self.numbers.get(name)) for name, rows in found.items() if rows}


def modes_at_end(optima: list[Optimum], probability: Array) -> GaussianMixture:
    """The last pose and calibration of each solution, with its covariance in the output axes and its probability."""
    mean, covariance = [], []
    for optimum in optima:
        state = optimum.state
        last = (("x", np.array([len(state.poses) - 1])), ("c", np.array([len(state.c) - 1])))
        joint = optimum.solution.joint(*last)[0]
        mean.append(np.append(state.poses[-1], state.c[-1]))
        covariance.append(in_output_axes(joint, float(state.poses[-1, 2])))
    share = probability / probability.max()
    mixture = GaussianMixture(np.array(mean), np.array(covariance), np.log(probability), np.arange(len(mean)))
    return mixture.take(np.flatnonzero(share > KALMAN.hopeless))
