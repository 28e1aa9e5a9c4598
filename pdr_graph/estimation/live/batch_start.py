"""Start and direction of a walk under way, by the batch smoother, until they are certain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.covariance import CovarianceBlocks
from pdr_graph.estimation.factors.base import AnyArray, poses_at
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import AMBIGUOUS, sigma_direction
from pdr_graph.estimation.optimizer import Optimum, corrected_solutions, paths, probabilities
from pdr_graph.estimation.results import SURE
from pdr_graph.types import Array

LEAST_DURATION = 15.0  # [s] on a plan, unless fixes determine the direction: shorter walks fit several aisles
MOST_SIGMA, MOST_SIGMA_ON_PLAN = 0.5, 0.35  # [rad] of the last heading, for a linearisation there; chosen by hand


@dataclass(frozen=True)
class BatchSolution:
    """The most probable walk so far.

    time: ``(m + 1,)`` start and ends of the pieces [s]; pose: ``(m + 1, 3)`` there; segment_start: ``(s,)`` [s]; c:
    ``(s, 3)``; decisions: about measurements, by kind; sure: no other path is likely, and the direction is certain.
    """

    time: Array
    pose: Array
    segment_start: Array
    c: Array
    decisions: dict[str, dict[str, AnyArray]]
    sure: bool

    def poses(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at times ``(n,)`` [s]."""
        return poses_at(time, self.time, self.pose)

    def calibration(self, time: float) -> Array:
        """(R_s, R_d, b) ``(3,)`` at a time [s]."""
        return self.c[max(int(np.searchsorted(self.segment_start, time)) - 1, 0)]


def solve_batch(graph: WalkGraph) -> BatchSolution:
    """The most probable walk of a window, with a test whether it is certain."""
    optima = corrected_solutions(graph)
    best, path = optima[0], paths(optima)
    certain = float(probabilities(optima, path)[path == 0].sum()) > SURE
    long = graph.steps.end - graph.steps.start > LEAST_DURATION
    determined = not best.graph.walled or sigma_direction(graph.chain, graph.positions) < AMBIGUOUS or long
    return _solution(best, certain and determined)


def _solution(best: Optimum, certain: bool) -> BatchSolution:
    at, chain = best.at, best.at.chain
    ends = chain.time[:-1][at.pieces.interval] + at.pieces.to_end[1]
    last = CovarianceBlocks(best.net).joint([(X(len(chain.segment)),)])[0]
    decided = {
        measurement.name: decisions for measurement in best.graph.measurements if (decisions := measurement.decisions())
    }
    return BatchSolution(
        time=np.append(chain.time[0], ends),
        pose=np.vstack([at.pose_i[:1], at.ends]),
        segment_start=chain.time[chain.segment_first],
        c=best.state.c,
        decisions={} if best.graph.positions.approximate else decided,
        sure=bool(certain and last[2, 2] < (MOST_SIGMA_ON_PLAN if best.graph.walled else MOST_SIGMA) ** 2),
    )
