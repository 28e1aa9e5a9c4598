"""The most probable walk: batch smoothing of a ``WalkGraph``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.ambiguity.bank import contradictions, paths, probabilities
from pdr_graph.estimation.ambiguity.plan_hypotheses import Localization, joint_solutions, localized
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import lay_dead_reckoning, positions_of
from pdr_graph.estimation.linear_system import covariance_of_ends, one_thread
from pdr_graph.estimation.optimizer import Optimum, fully_optimized
from pdr_graph.estimation.results import (
    calibration_of,
    contradiction_warnings,
    missing_steps,
    place_warnings,
    plan_contradictions,
    stated_probability,
    warnings,
)
from pdr_graph.geometry import differences, row_times, wrap_angle
from pdr_graph.priors import INITIAL, REPORTS, SEARCH
from pdr_graph.types import Array, Estimate, Trajectory


@one_thread
def smooth(graph: WalkGraph) -> Estimate:
    """The most probable walk given all measurements in ``graph``, with the covariance of every step.

    If other walks explain the measurements about as well, they widen the covariance and add a warning. A walk on a plan
    without any position is sought all over the plan.

    Raises TypeError without a graph, RuntimeError if GTSAM finds no solution.
    """
    expect("smooth, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")
    return estimated(graph, localized(graph) if graph.unplaced else Localization(joint_solutions(graph)))


def estimated(graph: WalkGraph, found: Localization) -> Estimate:
    """The walk of a graph by its solutions."""
    optima = [fully_optimized(found.optima[0]), *found.optima[1:]]
    best = optima[0]

    # Every step, with its covariance; dead reckoning before that, since covariances take most memory
    rows, used = poses_of_rows(best), graph.positions
    track = Trajectory(row_times(graph.steps), rows[:, :2], wrap_angle(rows[:, 2]), graph.floors)
    aligned = used.fixes[used.consistent] if used.consistent.any() else positions_of(track)
    dead_reckoning = lay_dead_reckoning(graph.steps, aligned)
    path = paths(optima)
    share = probabilities(optima, path)
    probability = (1.0 - found.elsewhere) * share
    of_c = best.solution.joint(("c", np.arange(len(best.state.c))))
    covariance = found.covariance(rows, _mixture_covariance(optima, share / share.sum()))
    if (ways := best.graph.ways) is not None:
        covariance[:, :2, :2] = ways.widened(track.time, rows[:, :2], covariance[:, :2, :2])
    fits = best.graph.walled == graph.walled
    of_path = float(probability[path == 0].sum())
    if not (path.any() or graph.walled or len(graph.sought) or graph.sigma_direction >= INITIAL.ambiguous):
        of_path = np.nan  # no other route was tried
    if not fits:  # nothing keeps the walk in one aisle: the probability that it is within SEARCH.same_path
        variance = np.trace(_covariance_of_rows(best)[:, :2, :2], axis1=1, axis2=2).mean() / 2
        of_path *= 1 - float(np.exp(-(SEARCH.same_path**2) / (2 * variance)))
    trajectory = replace(track, covariance=covariance)
    outside = None if best.graph.floor_sequence is None else best.graph.floor_sequence.outdoors
    on_plan = trajectory if outside is None else trajectory[~outside[np.append(0, best.at.pieces.row_end)]]

    # The routes that are worth reporting, the estimate's first
    routes = list[tuple[float, Trajectory]]()
    for n in np.unique(path).tolist() if graph.unplaced or path.any() else ():
        other, of_route = poses_of_rows(optima[n]), float(probability[path == n].sum())
        if n == 0 or of_route > REPORTS.least_reported:
            shown = replace(trajectory, position=other[:, :2], heading=wrap_angle(other[:, 2]), covariance=None)
            routes.append((of_route, shown))
    routes[1:] = sorted(routes[1:], key=lambda route: -route[0])

    # Calibration, reports, warnings
    calibration = calibration_of(best.graph, best.state.c, of_c)
    reports = {
        measurement.name: reports_of_kind
        for measurement in best.graph.measurements
        if (reports_of_kind := measurement.reports(best.at))
    }
    estimate = Estimate(
        trajectory=trajectory,
        dead_reckoning=dead_reckoning,
        calibration=calibration,
        reports=reports,
        iterations=best.iterations,
        cost=best.cost,
        converged=best.converged,
        probability=of_path,
        contradictions=(
            *plan_contradictions(graph, on_plan if best.graph.walled else None),
            *contradictions(optima, share),
            *(() if ways is None else ways.contradictions(best.at, best.solution)),
            *missing_steps(graph.steps),
        ),
        routes=tuple(routes),
        assumed=tuple(claim.label for claim in best.assumed),
        graph=best.graph.smoothed(best.state),
    )
    stated = stated_probability(replace(estimate, trajectory=on_plan), graph.floor, fits=fits)
    walks = sum(float(probability[path == n].sum()) > REPORTS.least_reported for n in np.unique(path).tolist())
    warned = (
        *warnings(graph, walks, stated, best.converged, calibration),
        *contradiction_warnings(reports.get(used.name, ())),
        *place_warnings(estimate.untimed),
        *(() if ways is None else ways.warnings()),
    )
    return replace(estimate, probability=stated, warnings=warned)


def poses_of_rows(optimum: Optimum) -> Array:
    """Poses ``(n + 2, 3)`` of the trajectory's rows: the start, the end of every step, the end."""
    at = optimum.at
    return np.concatenate([at.pose_i[:1], at.ends[at.pieces.row_end]])


def _mixture_covariance(optima: list[Optimum], weight: Array) -> Array:
    """Covariance of each row about the best solution, the others counted by their probability.

    weight: ``(n,)`` with sum 1.
    """
    rows, total = poses_of_rows(optima[0]), np.zeros(())
    for share, optimum in zip(weight.tolist(), optima, strict=True):
        apart = differences(poses_of_rows(optimum), rows)
        total = total + share * (_covariance_of_rows(optimum) + apart[:, :, None] * apart[:, None, :])
    return total


def _covariance_of_rows(optimum: Optimum) -> Array:
    return covariance_of_ends(optimum.at, optimum.solution, optimum.at.pieces.row_end)
