"""Which way a walk may have set off: as fixes and compass say, else along the corridors, else any way.

A direction is the angle by which the graph's start is turned about its fixes. The optimum is found from several, and
what they lead to is compared: a wall's pull is local, so that a start half a block off ends in another aisle.
"""

from __future__ import annotations

import numpy as np

from pdr_graph.estimation.graph import AMBIGUOUS, WalkGraph
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Mask

CERTAIN = 0.2  # [rad] of the start's direction: walls can do the rest. A few fixes of metres along a walk know it
ANY_WAY = 8  # directions without a plan
ALONG_CORRIDORS = 12  # directions with one
TRIED, APART = 144, 0.2  # directions that are looked at, and how far those that are followed lie apart [rad]
LOOKED_AHEAD = 60.0  # [m] of the walk on both sides of its first fix
WALL_COST = 0.5  # of one step through a wall, against half a squared sigma of the compass


def directions(graph: WalkGraph) -> Array:
    """Angles ``(d,)`` to start the optimisation from, the likeliest first. [rad]"""
    sigma = graph.sigma_direction
    if not graph.fix_used.any() or sigma < (CERTAIN if graph.walls else AMBIGUOUS):
        return np.zeros(1)
    if graph.walls is None:
        return np.arange(ANY_WAY) * 2 * np.pi / ANY_WAY
    return along_corridors(graph)


def along_corridors(graph: WalkGraph) -> Array:
    """The angles ``(d,)`` at which the walk about its first fix goes through fewest walls. [rad]

    What fixes and compass say counts too, unless they leave the direction open.
    """
    assert graph.floor is not None, "asked for with a plan"
    near = _near_first_fix(graph)
    angles = np.arange(TRIED) * 2 * np.pi / TRIED
    through = np.empty(TRIED)
    for n, angle in enumerate(angles):
        track = graph.turned_start(angle).poses[near, :2]
        through[n] = graph.floor.crosses_wall(track[:-1], track[1:]).sum()
    through = np.convolve(np.concatenate([through[-2:], through, through[:2]]), np.full(5, 0.2), "valid")
    told = wrap_angle(angles) / graph.sigma_direction if graph.sigma_direction < AMBIGUOUS else np.zeros(TRIED)
    chosen: list[int] = []
    for n in np.argsort(WALL_COST * through + told**2 / 2, kind="stable"):
        if np.all(np.abs(wrap_angle(angles[n] - angles[chosen])) > APART):
            chosen.append(int(n))
    return angles[chosen[:ALONG_CORRIDORS]]


def _near_first_fix(graph: WalkGraph) -> Mask:
    """Keyframes ``(k + 1,)`` within LOOKED_AHEAD of the first fix, by the way walked."""
    position = graph.start.poses[:, :2]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(position, axis=0).T))])
    return np.abs(way - way[graph.fix_keyframe[graph.fix_used][0]]) < LOOKED_AHEAD
