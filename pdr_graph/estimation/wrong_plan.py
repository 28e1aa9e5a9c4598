"""Solutions of a walk on a plan that may be wrong: between its walls, without them, and with the plan displaced.

A plan may be of another floor, displaced, or lack a door. A walk between its walls then costs more than a right plan
adds to the walk without it. So the walk without walls is a solution too, at a price. If a single position relates the
walk to the plan, neither confirms the other: then the walk may also start some metres from that position.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.factors.base import Hypothesis
from pdr_graph.estimation.factors.steps_and_walls import WallFactor
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import Optimum, corrected_solutions, different_directions, near_walk, optimize
from pdr_graph.priors import SEARCH
from pdr_graph.types import Array

WRONG_PLAN = 6.0  # [nats] least price of a plan that does not fit; between right walls a walk of some minutes costs 0
# to 4.5 nats more, on 60 simulated walks of development and 45 real ones; where the plan is wrong, mostly 5 to 140
PER_MEASUREMENT = 0.25  # [nats] per measurement that walls amount to; right walls add less: 0.10 to 0.21 in laps of 4
# to 66 min, up to 53 nats in all; 0.5 to 1.0 where the fixes are 3 m beside the plan, 0.6 where it is turned by 10°
PER_STEP = 0.1  # measurements per step that right walls amount to at most; 0.03 in these laps, in corridors of 2.5 m
CORRELATED = 0.25  # share of the cost by which walls add more where the errors of fixes are correlated; IPIN21 at 1 Hz
MOST_ADDED = 5.0  # [nats] that right walls hardly add: beyond it a displaced plan or position is tried
DISPLACED = 3.0  # [nats] price of a plan or a single position that is displaced: they then cost 0 to 5 nats, walks
# on a plan of another floor 13; on the same simulated walks
MISPLACED = 6.0  # [m] sigma of that displacement, per axis; chosen by hand
CARRIED = 3.0  # [nats] above the best at which an explanation of the other sources is not tried between the walls
TEXT = "the floor plan does not fit the walk and the positions on it"
CHECK = "the floor plan (another floor, displaced, a door missing?) and the positions on it (start, fixes)"


def solutions_on_plan(graph: WalkGraph, explained: list[Optimum]) -> list[Optimum]:
    """Solutions between the walls, and those with a plan that is wrong, the most probable first.

    explained: the walk without walls under each joint assumption about the other sources, the most probable first.
    """
    likely = [other for other in explained if other.surprise < explained[0].surprise + CARRIED]
    optima = [_assuming(optimum, likely[0]) for optimum in corrected_solutions(graph, likely[0])]
    for other in likely[1:]:
        alike = _apart(other, likely[0]) < SEARCH.same_path
        optima.append(_assuming(near_walk(graph, other, optima[0].state if alike else None), other))
    usual = PER_MEASUREMENT * min(_measurements_by_walls(optima[0]), PER_STEP * len(graph.steps))
    if optima[0].surprise > likely[0].surprise + max(MOST_ADDED, usual) and _single_position(graph):
        optima += _displaced(graph, likely[0])
    optima += [free for other in likely for free in _without_walls(other, max(WRONG_PLAN, usual))]
    ordered = sorted(optima, key=lambda optimum: optimum.surprise)
    return [optimum for optimum in ordered if optimum.surprise < ordered[0].surprise + SEARCH.dropped]


def _assuming(optimum: Optimum, free: Optimum, price: float = 0.0, *more: Hypothesis) -> Optimum:
    """A solution with the assumptions of the walk ``free`` without walls, and more at a price [nats]."""
    return replace(optimum, assumed=(*free.assumed, *more), burden=optimum.burden + free.burden + price, unseen=np.inf)


def _wrong(price: float) -> Hypothesis:
    return Hypothesis((), price, "plan", TEXT, CHECK)


def _measurements_by_walls(optimum: Optimum) -> float:
    """The number of independent measurements that the walls amount to: tr(J Σ Jᵀ) over the steps that they press.

    It grows with the corridors walked through, and what right walls add to the cost grows with it: a walk errs anew
    between two corridors. J: whitened derivatives; Σ: covariance of the walk between the walls.
    """
    total = 0.0
    for block in optimum.at.blocks_of(WallFactor.name):
        J = np.hstack(block.weighted[1])[:, None]
        of_rows = [(symbol, rows[block.row_of]) for symbol, rows in block.variables]
        total += float(np.sum((J @ optimum.solution.joint(*of_rows)) * J))
    return total


def _without_walls(free: Optimum, price: float) -> list[Optimum]:
    """The walk if the plan does not fit; in each direction if the other sources do not determine it."""
    walks = different_directions(free)
    price += float(np.log(len(walks)))
    without = [replace(walk, burden=CORRELATED * walk.cost) for walk in walks]
    return [_assuming(walk, free, price, _wrong(price)) for walk in without]


def _single_position(graph: WalkGraph) -> bool:
    """True if one fix is all that determines positions."""
    kinds = [kind for kind in graph.measurements if kind.determines_position]
    return kinds == [graph.positions] and np.count_nonzero(graph.positions.used) == 1


def _displaced(graph: WalkGraph, free: Optimum) -> list[Optimum]:
    """Walks between the walls that start some metres from the only fix: it is misplaced, or the plan by as much."""
    positions = free.graph.positions
    wider = [np.hypot(sigma, MISPLACED) for sigma in (positions.sigma, positions.independent_sigma)]
    wide = free.graph.assuming((replace(positions, sigma=wider[0], independent_sigma=wider[1]),))
    price, found = DISPLACED + float(np.log(2)), list[Optimum]()
    for walk in corrected_solutions(graph, optimize(wide, free.state)):
        fix = int(np.argmax(positions.used))
        by = positions.fixes.position[fix] - walk.state.poses[positions.keyframe[fix], :2]
        text = f"the floor plan, or the only position on it, is displaced by about {np.hypot(*by):.0f} m"
        assumed = (_wrong(price), Hypothesis((), 0.0, "plan", text, CHECK))
        found += [_assuming(one, free, price, *assumed) for one in (walk, _moved(walk, by, free.graph))]
    return found


def _moved(walk: Optimum, by: Array, graph: WalkGraph) -> Optimum:
    """A walk moved by ``by (2,)`` [m] together with its walls, as probable as before. graph: without walls."""
    state = walk.state.replaced(x=walk.state.poses + np.append(by, 0.0))
    at = graph.evaluate(state)
    return replace(walk, graph=graph, at=at, burden=walk.surprise - at.surprise)


def _apart(one: Optimum, other: Optimum) -> float:
    """Mean distance of two walks [m]."""
    return float(np.hypot(*(one.at.ends[:, :2] - other.at.ends[:, :2]).T).mean())
