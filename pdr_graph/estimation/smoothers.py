"""The most probable walk: batch smoothing of a ``WalkGraph``."""

from __future__ import annotations

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.covariance import covariance_of_rows
from pdr_graph.estimation.graph import State, WalkGraph
from pdr_graph.estimation.initial import lay_dead_reckoning
from pdr_graph.estimation.misplaced import misplaced
from pdr_graph.estimation.optimizer import Optimum, probabilities, solutions, ways
from pdr_graph.estimation.reports import beacon_reports, calibration_of, contradicted, reports_at, warnings
from pdr_graph.geometry import row_times, wrap_angle
from pdr_graph.types import Array, Estimate, Trajectory


def smooth(graph: WalkGraph) -> Estimate:
    """The most probable walk given every measurement in ``graph``, with the covariance of every step.

    Where other walks explain the measurements about as well, they widen the covariance and are warned of.

    Raises TypeError without a graph, RuntimeError where GTSAM finds no solution.
    """
    expect("smooth, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")

    # The optimum, and whatever else explains the measurements; again without what a beacon's list says wrongly
    found = solutions(graph)
    while moved := _misplaced(found[0]):
        found = solutions(found[0].graph.with_beacons_elsewhere(moved))
    best = found[0]

    # Every step, with its covariance
    rows = _rows(best)
    way = ways(found)
    probability = probabilities(found, way)
    of_way = float(probability[way == 0].sum())
    covariance, of_c = _mixed_covariance(found, probability / probability.sum())
    trajectory = Trajectory(row_times(graph.steps), rows[:, :2], wrap_angle(rows[:, 2]), graph.floors, covariance)

    # What was learnt, what was trusted, and what to beware of
    calibration = calibration_of(graph, State.of(best.values).c, of_c)
    fixes = reports_at(best.graph, best.values)
    return Estimate(
        trajectory=trajectory,
        dead_reckoning=lay_dead_reckoning(graph.steps, graph.fixes[graph.fix_believed]),
        calibration=calibration,
        beacons=beacon_reports(graph.levels, best.graph, State.of(best.values)),
        fixes=fixes,
        iterations=best.iterations,
        cost=best.cost,
        converged=best.converged,
        probability=of_way,
        warnings=(
            *warnings(graph, len(found), of_way, best.converged, calibration),
            *contradicted(best.graph, fixes),
        ),
    )


def _misplaced(optimum: Optimum) -> list[int]:
    """The beacons that are heard as if they were elsewhere; a list that is wrong of one is doubted of the next."""
    graph, state = optimum.graph, State.of(optimum.values)
    if graph.levels is None:
        return []
    return misplaced(graph.levels, graph.pieces.keyframe_time, state.poses[:, :2], state.q[0])


def _rows(optimum: Optimum) -> Array:
    """Poses ``(n + 2, 3)``: the start, the end of every step, the end."""
    own = optimum.own
    return np.concatenate([own.pose_i[:1], own.ends[optimum.graph.pieces.row_end]])


def _mixed_covariance(found: list[Optimum], weight: Array) -> tuple[Array, Array]:
    """Covariance of each row about the best solution, the others counted by their probability; that of c."""
    rows = _rows(found[0])
    covariance, of_c = covariance_of_rows(found[0].graph, found[0].own, found[0].net)
    total = weight[0] * covariance
    for w, other in zip(weight[1:], found[1:], strict=True):
        covariance, _ = covariance_of_rows(other.graph, other.own, other.net)
        apart = _rows(other) - rows
        apart[:, 2] = wrap_angle(apart[:, 2])
        total = total + w * (covariance + apart[:, :, None] * apart[:, None, :])
    return total, of_c
