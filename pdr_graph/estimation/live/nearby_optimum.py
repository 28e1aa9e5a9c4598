"""The optimum near a path of the window, by damped steps.

A wall pulls only at steps that are near it. A solution without damping, linearised where no wall pulls, is held by
nothing and may end behind the wall, tens of metres away; a damped step is taken only if it lowers the cost.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from pdr_graph.estimation.live.isam import POSE_CHARACTER, SYMBOL_BITS, Linear, Name

if TYPE_CHECKING:
    from pdr_graph.estimation.live.live_graph import LiveGraph

# All are chosen by hand
FIRST_REACH, LEAST_REACH, MOST_REACH = 3.0, 0.01, 100.0  # of a step, see POSE_REACH
REACH_CHANGE = 4.0  # factor by which the reach grows after a step that lowers the cost, and shrinks after another
POSE_REACH, OTHER_REACH = np.array([1.0, 1.0, 0.1]), np.full(3, 0.1)  # [m, m, rad], [-] sigma of a step at reach 1
ENOUGH = 1e-4  # share of the cost by which a step must lower it for another to follow


def optimize_nearby(graph: LiveGraph, names: Collection[Name], rounds: int) -> float:
    """Move the window to the optimum near its present path, and return the cost there (Levenberg-Marquardt).

    names: of all factors, see `LiveGraph.restart_solver`; rounds: most linearisations. The solver of the graph is
    another afterwards, which has not started.
    """
    reach, cost = FIRST_REACH, graph.total_cost
    for _ in range(rounds):
        system = graph.linearized(names)
        before = graph.isam
        while reach > LEAST_REACH:
            graph.place(before.moved(_stepped(system, before.values, reach)))
            if (lower := graph.total_cost) < cost:
                break
            graph.place(before)
            reach /= REACH_CHANGE
        else:
            break
        gain, cost, reach = cost - lower, lower, min(reach * REACH_CHANGE, MOST_REACH)
        if gain < ENOUGH * cost:
            break
    return cost


def restart_nearby(graph: LiveGraph, factors: Mapping[Name, Linear], rounds: int) -> None:
    """Restart the solver at the optimum near the present path.

    The solver of the graph has not started, and may have factors that are linearised nearby; factors: all that it had
    before; rounds: most linearisations.
    """
    graph.isam.absorb(graph.outside(factors))
    optimize_nearby(graph, factors, rounds)
    graph.restart_solver(graph.isam, factors)


def _stepped(system: gtsam.GaussianFactorGraph, values: gtsam.Values, reach: float) -> gtsam.Values:
    """The values at the damped solution of a system that is linearised at ``values``; these if it has none."""
    damped = system.clone()
    for key in values.keys():
        sigma = reach * (POSE_REACH if key >> SYMBOL_BITS == POSE_CHARACTER else OTHER_REACH)
        damped.add(key, np.diag(1.0 / sigma), np.zeros(3), gtsam.noiseModel.Unit.Create(3))
    try:
        return values.retract(damped.optimize())
    except (RuntimeError, ValueError, IndexError):  # of GTSAM, by rounding errors or factors that are not finite
        return values
