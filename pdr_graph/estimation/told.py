"""Where fixes tell the way through a building, so that no particles need be sent off to find it.

Fixes lay a walk without its plan, and its covariance says how well. Where it errs by less than a third of the distance
of two aisles there is no other way; what follows the last fixes may lead elsewhere, and there particles are sent off.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.covariance import CovarianceBlocks
from pdr_graph.estimation.graph import State, WalkGraph
from pdr_graph.estimation.hypotheses import bundles
from pdr_graph.estimation.particles import FEWEST, particles_from
from pdr_graph.geometry import rotation
from pdr_graph.types import Array

TOLD = 2.7  # [m] standard deviation in the worst direction: aisles lie three times as far apart and more
FEWEST_FIXES = 3  # two do not check one another
MOST_OPEN = 0.25  # of the walk, at its end


def told(graph: WalkGraph, net: gtsam.GaussianBayesNet) -> tuple[int, Array] | None:
    """The last keyframe up to which fixes tell the way, and by how much each piece errs ``(m,)`` [m]; None where they
    do not tell it. net: the graph of the walk without its walls, factorised.
    """
    if graph.levels is not None:  # beacons give way slowly: from far off the optimiser does not settle
        return None
    if np.count_nonzero(graph.fix_held & ~graph.fix_wild) < FEWEST_FIXES:
        return None
    count = len(graph.start.poses)
    covariance = CovarianceBlocks(net).joint([(X(k),) for k in range(count)])[:, :2, :2]
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    last = int(np.argmax(np.append(sigma, np.inf) > TOLD)) - 1
    if last < (1 - MOST_OPEN) * (count - 1):
        return None
    return last, np.maximum(sigma[:-1], sigma[1:])[graph.pieces.interval]


def other_ends(graph: WalkGraph, state: State, net: gtsam.GaussianBayesNet, last: int) -> list[State]:
    """Where else than ``state`` has it the walk may have gone from the keyframe ``last`` on.

    net: the graph factorised there.
    """
    if last == len(state.poses) - 1:
        return []
    segment = int(graph.segment[last])
    joint = CovarianceBlocks(net).joint([(X(last), C(segment))])[0]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), joint, FEWEST)
    place = state.poses[last, :2] + drawn[:, :2] @ rotation(state.poses[last, 2]).T
    particles = np.column_stack([place, state.poses[last, 2] + drawn[:, 2], state.c[segment] + drawn[:, 3:]]).T
    assert graph.ground is not None, "asked for with a plan"
    at, known = graph.pieces.last[last:], np.tile(state.poses[last, :2], (FEWEST, 1))
    here = np.logical_not(graph.ground.crossed(known, place, np.tile(at[0], FEWEST)))
    if not here.any():
        return []
    paths, ends = particles_from(graph, last, particles[:, here]), [state.poses[last + 1 :]]
    for way in (paths.state[1:, :3, n] for n in bundles(paths)):
        if all(graph.ground.walled_off(way[:, :2], other[:, :2], at) for other in ends):
            ends.append(way)
    return [replace(state, poses=np.concatenate([state.poses[: last + 1], way])) for way in ends[1:]]
