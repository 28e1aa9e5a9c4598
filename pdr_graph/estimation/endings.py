"""Paths that the fixes determine without particles, and the alternatives after the last fix.

The walk is estimated without its plan. Where its sigma is below a third of the distance between two aisles there is no
other path; after the last fixes there may be, and particles search for it.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.covariance import CovarianceBlocks
from pdr_graph.estimation.factors.base import State
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.particle_filter import FEWEST, particles_from
from pdr_graph.estimation.path_modes import path_modes
from pdr_graph.geometry import rotation
from pdr_graph.types import Array

LARGEST_SIGMA = 2.7  # [m] standard deviation in the worst direction: aisles lie three times as far apart and more
FEWEST_FIXES = 3  # two do not check one another
MOST_OPEN = 0.25  # of the walk, at its end


def fixes_determine_path(graph: WalkGraph, net: gtsam.GaussianBayesNet) -> tuple[int, Array] | None:
    """The last keyframe up to which fixes determine the path, and by how much each piece errs ``(m,)`` [m].

    None where they do not. net: the graph of the walk without its walls, factorised.
    """
    if any(one.yields_slowly for one in graph.measurements):
        return None
    if np.count_nonzero(graph.positions.held & ~graph.positions.outlier) < FEWEST_FIXES:
        return None
    count = len(graph.start.poses)
    covariance = CovarianceBlocks(net).joint([(X(k),) for k in range(count)])[:, :2, :2]
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    last = int(np.argmax(np.append(sigma, np.inf) > LARGEST_SIGMA)) - 1
    if last < (1 - MOST_OPEN) * (count - 1):
        return None
    return last, np.maximum(sigma[:-1], sigma[1:])[graph.pieces.interval]


def alternative_endings(graph: WalkGraph, state: State, net: gtsam.GaussianBayesNet, last: int) -> list[State]:
    """Other paths that the walk may have taken from the keyframe ``last`` on, besides that of ``state``.

    net: the graph factorised there.
    """
    if last == len(state.poses) - 1:
        return []
    segment = int(graph.segment[last])
    joint = CovarianceBlocks(net).joint([(X(last), C(segment))])[0]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), joint, FEWEST)
    place = state.poses[last, :2] + drawn[:, :2] @ rotation(state.poses[last, 2]).T
    particles = np.column_stack([place, state.poses[last, 2] + drawn[:, 2], state.c[segment] + drawn[:, 3:]]).T
    assert graph.floor_sequence is not None, "asked for with a plan"
    at, known = graph.pieces.last[last:], np.tile(state.poses[last, :2], (FEWEST, 1))
    here = np.logical_not(graph.floor_sequence.crossed(known, place, np.tile(at[0], FEWEST)))
    if not here.any():
        return []
    paths, ends = particles_from(graph, last, particles[:, here]), [state.poses[last + 1 :]]
    for way in (paths.state[1:, :3, n] for n in path_modes(paths)):
        if all(graph.floor_sequence.walled_off(way[:, :2], other[:, :2], at) for other in ends):
            ends.append(way)
    return [state.replaced(x=np.concatenate([state.poses[: last + 1], way])) for way in ends[1:]]
