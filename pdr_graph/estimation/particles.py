"""Where a walk may have gone: a particle filter on the plan.

Walls are local: the optimum next to a wrong aisle is a walk through that aisle. So thousands of walkers are sent off
as a `Cloud`; walls, fixes and compass weigh them. The ancestors of those that are left are the ways that the building
admits.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.cloud import Cloud, Paths, Seen
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.preintegration import Pieces
from pdr_graph.types import Array

FEWEST, MOST = 1000, 8000  # particles


def particle_filter(graph: WalkGraph, seed: int = 0, times: int = 1) -> Paths:
    """The walks that plan, fixes and headings admit.

    graph: with walls, and at least one fix that is used. times: as many particles as usual.
    """
    cloud = Cloud(graph.prior, seed, fewest=times * FEWEST, most=times * MOST)
    _begin(cloud, graph)
    return _advanced(cloud, graph, 0)


def particles_from(graph: WalkGraph, keyframe: int, state: Array) -> Paths:
    """As `particle_filter`, from a keyframe on at which particles ``(6, n)`` are known."""
    cloud = Cloud(graph.prior, 0, fewest=FEWEST, most=MOST)
    cloud.begin_at(state)
    return _advanced(cloud, graph, keyframe)


def _advanced(cloud: Cloud, graph: WalkGraph, begin: int) -> Paths:
    """The ways of a cloud that was at keyframe ``begin``, to the end."""
    ground, pieces = graph.ground, graph.pieces
    assert ground is not None, "asked for with a plan"
    ways = {piece: [way.field for way in others] for piece, others in ground.changes.items()}
    for interval in range(begin, len(pieces.first)):
        first = int(pieces.first[interval])
        here = range(first, int(pieces.last[interval]) + 1)
        cloud.advance(
            _pieces(graph, interval),
            [ground.field(m) for m in here],
            {m - first: ways[m] for m in here if m in ways},
            _seen(graph, interval + 1),
        )
    return cloud.paths()


def _pieces(graph: WalkGraph, interval: int) -> Pieces:
    """The pieces of an interval; over a gap of which a closure says that they stood, they did: who
    walked on is found by the walk as fixes lay it.
    """
    own = graph.pieces.only(interval)
    bound = np.flatnonzero((graph.closure_keyframe == (interval, interval + 1)).all(axis=1))
    if not len(bound):
        return own
    stood = graph.closures.sigma[bound].min() ** 2
    return replace(own, variance=np.minimum(own.variance, [stood, stood, np.inf]))


def _begin(cloud: Cloud, graph: WalkGraph) -> None:
    """At the walk's start, such that steps lead to the first fix."""
    used = np.flatnonzero(graph.fix_used)
    first = used[np.argmin(graph.fix_keyframe[used])]
    cloud.begin(
        graph.fixes.position[first],
        float(graph.fix_sigma_together[first]),
        float(graph.start.poses[0, 2]),
        graph.sigma_direction,
        complex(graph.track[graph.fix_keyframe[first]]),
        _seen(graph, 0),
    )


def _seen(graph: WalkGraph, keyframe: int) -> Seen:
    """The fixes and headings at a keyframe."""
    fixes = graph.fix_used & (graph.fix_keyframe == keyframe)
    headings = graph.heading_keyframe == keyframe
    return Seen(
        graph.fixes.position[fixes],
        graph.fix_sigma_together[fixes],
        graph.fix_wild[fixes],
        graph.headings.heading[headings],
        graph.headings.sigma[headings],
    )
