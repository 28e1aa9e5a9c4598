"""Solutions of a walk between the walls of its plan, and without them in case that the plan does not fit.

A plan may be of another floor, displaced, or lack a door. A walk between its walls then costs more than a right plan
usually adds to the walk without it. So the walk without walls is a solution too, at that usual cost and a price.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.factors.base import Hypothesis
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import (
    SAME_PATH,
    USUAL,
    Optimum,
    corrected_solutions,
    different_directions,
    near_walk,
)

WRONG_PLAN = 5.0  # [nats] price of a plan that does not fit the walk; chosen on simulated walks of development
CARRIED = 3.0  # [nats] above the best at which an explanation of the other sources is not tried between the walls
TEXT = "the floor plan does not fit the walk: its walls were not used"
CHECK = "the floor plan (another floor, displaced, a door missing?) and the positions on it (start, fixes)"


def solutions_on_plan(graph: WalkGraph, explained: list[Optimum]) -> list[Optimum]:
    """Solutions between the walls, and those without walls, the most probable first.

    explained: the walk without walls under each joint assumption about the other sources, the most probable first.
    """
    likely = [other for other in explained if other.surprise < explained[0].surprise + CARRIED]
    optima = [_assuming(optimum, likely[0]) for optimum in corrected_solutions(graph, likely[0])]
    for other in likely[1:]:
        alike = _apart(other, likely[0]) < SAME_PATH
        optima.append(_assuming(near_walk(graph, other, optima[0].state if alike else None), other))
    optima += [free for other in likely for free in _without_walls(other)]
    return sorted(optima, key=lambda optimum: optimum.surprise)


def _assuming(optimum: Optimum, free: Optimum) -> Optimum:
    """A solution between the walls, with the assumptions of the walk ``free`` without them."""
    return replace(optimum, assumed=free.assumed, burden=free.burden, unseen=np.inf)


def _without_walls(free: Optimum) -> list[Optimum]:
    """The walk if the plan does not fit; one for each direction if the other sources do not determine it."""
    directions = different_directions(free)
    price = WRONG_PLAN + float(np.log(len(directions)))
    hypothesis = Hypothesis((), price, "plan", TEXT, CHECK)
    assumed = (*free.assumed, hypothesis)
    return [
        replace(one, assumed=assumed, burden=free.burden + price + (USUAL - 1) * one.cost, unseen=np.inf)
        for one in directions
    ]


def _apart(one: Optimum, other: Optimum) -> float:
    """Mean distance of two walks [m]."""
    return float(np.hypot(*(one.at.ends[:, :2] - other.at.ends[:, :2]).T).mean())
