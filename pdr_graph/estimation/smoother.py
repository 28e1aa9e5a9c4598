"""The most probable walk: batch smoothing of a ``WalkGraph``."""

from __future__ import annotations

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.covariance import covariance_of_ends
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import lay_dead_reckoning
from pdr_graph.estimation.optimizer import Optimum, corrected_solutions, paths, probabilities
from pdr_graph.estimation.results import calibration_of, contradiction_warnings, warnings
from pdr_graph.geometry import row_times, wrap_angle
from pdr_graph.types import Array, Estimate, Trajectory


def smooth(graph: WalkGraph) -> Estimate:
    """The most probable walk given every measurement in ``graph``, with the covariance of every step.

    Where other walks explain the measurements about as well, they widen the covariance and a warning says so.

    Raises TypeError without a graph, RuntimeError where GTSAM finds no solution.
    """
    expect("smooth, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")

    # The optimum, and whatever else explains the measurements; again without what is listed wrongly
    found = corrected_solutions(graph)
    best = found[0]

    # Every step, with its covariance
    rows = poses_of_rows(best)
    path = paths(found)
    probability = probabilities(found, path)
    of_path = float(probability[path == 0].sum())
    covariance, of_c = _mixture_covariance(found, probability / probability.sum())
    trajectory = Trajectory(row_times(graph.steps), rows[:, :2], wrap_angle(rows[:, 2]), graph.floors, covariance)

    # What was estimated of the walker, what became of each measurement, and what to know before trusting it
    calibration = calibration_of(graph, best.state.c, of_c)
    reports = {one.name: told for one in best.graph.measurements if (told := one.reports(best.at))}
    used = graph.positions
    return Estimate(
        trajectory=trajectory,
        dead_reckoning=lay_dead_reckoning(graph.steps, used.fixes[used.consistent]),
        calibration=calibration,
        reports=reports,
        iterations=best.iterations,
        cost=best.cost,
        converged=best.converged,
        probability=of_path,
        warnings=(
            *warnings(graph, len(found), of_path, best.converged, calibration),
            *contradiction_warnings(reports.get(used.name, ())),
        ),
    )


def poses_of_rows(optimum: Optimum) -> Array:
    """Poses ``(n + 2, 3)`` of the trajectory's rows: the start, the end of every step, the end."""
    at = optimum.at
    return np.concatenate([at.pose_i[:1], at.ends[at.pieces.row_end]])


def _mixture_covariance(found: list[Optimum], weight: Array) -> tuple[Array, Array]:
    """Covariance of each row about the best solution, the others counted by their probability; that of c."""
    rows = poses_of_rows(found[0])
    row_end = found[0].at.pieces.row_end
    covariance, of_c = covariance_of_ends(found[0].at, found[0].net, row_end)
    total = weight[0] * covariance
    for w, other in zip(weight[1:], found[1:], strict=True):
        covariance, _ = covariance_of_ends(other.at, other.net, row_end)
        apart = poses_of_rows(other) - rows
        apart[:, 2] = wrap_angle(apart[:, 2])
        total = total + w * (covariance + apart[:, :, None] * apart[:, None, :])
    return total, of_c
