"""Where a walk under way began, and which way it went: the batch smoother is asked, until it is sure."""

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

LONG = 15.0  # [s] of a walk that a plan can tell from others: on a shorter one a compass that errs fits some aisle
POINTED, BESIDE_WALLS = 0.5, 0.35  # [rad] of the direction at the end, below which it is linearised about


@dataclass(frozen=True)
class BatchSolution:
    """The most probable walk so far.

    time: ``(m + 1,)`` of the ends of its pieces [s]; pose: ``(m + 1, 3)`` there; segment_start: ``(s,)`` [s]; c:
    ``(s, 3)``; decisions: about measurements, by kind; sure: no other path is likely, and its direction is known.
    """

    time: Array
    pose: Array
    segment_start: Array
    c: Array
    decisions: dict[str, dict[str, AnyArray]]
    sure: bool

    def poses(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at some times."""
        return poses_at(time, self.time, self.pose)

    def calibration(self, time: float) -> Array:
        """(R_s, R_d, b) at a moment [s]."""
        return self.c[max(int(np.searchsorted(self.segment_start, time)) - 1, 0)]


def solve_batch(graph: WalkGraph) -> BatchSolution:
    """The most probable walk of a window."""
    found = corrected_solutions(graph)
    best, path = found[0], paths(found)
    certain = float(probabilities(found, path)[path == 0].sum()) > SURE
    long = graph.steps.end - graph.steps.start > LONG
    told = not best.graph.walled or _by_fixes(graph) < AMBIGUOUS or long
    return _solution(best, certain and told)


def _by_fixes(graph: WalkGraph) -> float:
    """How well the fixes alone determine the direction of the walk. [rad]"""
    fixes, (track, _) = graph.positions, graph.chain.track
    used = fixes.consistent
    length = float(np.sum(graph.pieces.length))
    return sigma_direction(track[fixes.keyframe[used]], fixes.independent_sigma[used], length)


def _solution(best: Optimum, certain: bool) -> BatchSolution:
    at, chain = best.at, best.at.chain
    ends = chain.time[:-1][at.pieces.interval] + at.pieces.to_end[1]
    last = CovarianceBlocks(best.net).joint([(X(len(chain.segment)),)])[0]
    decided = {one.name: decisions for one in best.graph.measurements if (decisions := one.decisions())}
    return BatchSolution(
        time=np.append(chain.time[0], ends),
        pose=np.vstack([at.pose_i[:1], at.ends]),
        segment_start=chain.time[chain.segment_first],
        c=best.state.c,
        decisions={} if best.graph.positions.approximate else decided,
        sure=bool(certain and last[2, 2] < (BESIDE_WALLS if best.graph.walled else POINTED) ** 2),
    )
