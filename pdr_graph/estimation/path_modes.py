"""Paths of a walk on a plan: those that fixes determine, and the modes of a particle filter's paths.

Fixes determine a path if the walk, estimated without its plan, has a sigma below a third of the distance between two
aisles. After the last fixes it may be wider; particles then search for alternative endings.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from pdr_graph.estimation.factors.base import State
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.normal_equations import AnySolution
from pdr_graph.estimation.particle_filter import Paths, particle_filter, particles_from
from pdr_graph.geometry import rotation
from pdr_graph.priors import PARTICLES
from pdr_graph.types import Array, Index

MOST_MODES = 8
MOST_SOUGHT = 300  # modes among which the heaviest are chosen: after a long gap particles are all over the plan
APART = 4.0  # [m] largest distance between two modes: nearer ones lead the optimiser to the same walk
MOMENTS = 60  # keyframes at which paths are compared
LIVE_MOMENTS, LIVE_MODES = 8, 5  # keyframes and modes for a walk under way
NEGLECTED = 0.01  # share of the particles that need not belong to any mode

# Paths that fixes determine without particles
LARGEST_SIGMA = 2.7  # [m] standard deviation in the worst direction: aisles lie three times as far apart and more
FEWEST_FIXES = 3  # two do not check one another
MOST_OPEN = 0.25  # share of the walk, at its end, that may be undetermined


def fixes_determine_path(graph: WalkGraph, solution: AnySolution) -> tuple[int, Array] | None:
    """The last keyframe up to which fixes determine the path, and the sigma of each piece ``(m,)`` [m].

    None if they do not determine it. solution: of the walk without its walls.
    """
    if np.count_nonzero(graph.positions.held & ~graph.positions.outlier) < FEWEST_FIXES:
        return None
    count = len(graph.start.poses)
    covariance = solution.joint(("x", np.arange(count)))[:, :2, :2]
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    last = int(np.argmax(np.append(sigma, np.inf) > LARGEST_SIGMA)) - 1
    if last < (1 - MOST_OPEN) * (count - 1):
        return None
    return last, np.maximum(sigma[:-1], sigma[1:])[graph.pieces.interval]


def alternative_endings(graph: WalkGraph, state: State, solution: AnySolution, last: int) -> list[State]:
    """Paths that differ from ``state`` after keyframe ``last``. solution: at ``state``."""
    if last == len(state.poses) - 1:
        return []
    segment = int(graph.segment[last])
    joint = solution.joint(("x", np.array([last])), ("c", np.array([segment])))[0]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), joint, PARTICLES.fewest)
    place = state.poses[last, :2] + drawn[:, :2] @ rotation(state.poses[last, 2]).T
    particles = np.column_stack([place, state.poses[last, 2] + drawn[:, 2], state.c[segment] + drawn[:, 3:]]).T
    assert graph.floor_sequence is not None, "asked for with a plan"
    at, origin = graph.pieces.last[last:], np.tile(state.poses[last, :2], (PARTICLES.fewest, 1))
    inside = np.logical_not(graph.floor_sequence.crossed(origin, place, np.tile(at[0], PARTICLES.fewest)))
    if not inside.any():
        return []
    paths, endings = particles_from(graph, last, particles[:, inside]), [state.poses[last + 1 :]]
    for path in (paths.state[1:, :3, n] for n in path_modes(paths)):
        if all(graph.floor_sequence.walled_off(path[:, :2], other[:, :2], at) for other in endings):
            endings.append(path)
    return [state.replaced(x=np.concatenate([state.poses[: last + 1], path])) for path in endings[1:]]


def hypotheses(graph: WalkGraph, attempt: int = 0) -> list[State]:
    """Starts for the optimiser: the middle path of each mode, the heaviest mode first.

    attempt: 0, 1, …; each attempt draws other particles, twice as many as the one before.
    """
    return mode_starts(graph, particle_filter(graph, seed=attempt, times=2**attempt))


def mode_starts(graph: WalkGraph, paths: Paths) -> list[State]:
    """The start of the graph with the middle path of each mode, the heaviest mode first."""
    first = graph.chain.segment_first
    return [graph.start.replaced(x=paths.state[:, :3, n], c=paths.state[first + 1, 3:, n]) for n in path_modes(paths)]


def path_modes(paths: Paths) -> list[int]:
    """The middle path of each mode of ``paths``, the heaviest mode first."""
    modes = islice(_modes(paths.state[_moments(paths, MOMENTS), :2], paths.weight), MOST_SOUGHT)
    return [n for _, n in sorted(modes, reverse=True)[:MOST_MODES]]


def dominant_modes(paths: Paths) -> list[tuple[float, int]]:
    """Share and middle path of the heaviest modes, approximately and fast, for a walk under way.

    Modes are formed around a few random paths; a mode with a large share is among them.
    """
    order = np.random.default_rng(0).permutation(len(paths.weight))
    track = paths.state[_moments(paths, LIVE_MOMENTS), :2].take(order, axis=2)
    modes = sorted(islice(_modes(track, paths.weight[order]), LIVE_MODES), reverse=True)
    return [(share, int(order[n])) for share, n in modes]


def _moments(paths: Paths, most: int) -> Index:
    """Indices of up to ``most`` keyframes, evenly spaced, at which paths are compared."""
    return np.unique(np.linspace(0, len(paths.state) - 1, most).astype(int))


def _modes(track: Array, weight: Array) -> Iterator[tuple[float, int]]:
    """Share and middle path of each mode. track: ``(k, 2, n)`` [m]; weight: ``(n,)``."""
    number, left = np.arange(len(weight)), weight > 0
    while weight[left].sum() > NEGLECTED:
        track, weight, number = track.compress(left, axis=2), weight[left], number[left]
        near = _apart(track, track[:, :, 0]) < APART**2
        share = np.where(near, weight, 0.0)
        middle = track @ (share / share.sum())
        central = int(np.argmin(np.where(near, _apart(track, middle), np.inf)))
        mode = _apart(track, track[:, :, central]) < APART**2
        yield float(weight[mode].sum()), int(number[central])
        left = ~(mode | near)


def _apart(track: Array, path: Array) -> Array:
    """Square of the greatest distance ``(n,)`` [m²] of each of the tracks ``(k, 2, n)`` from a path ``(k, 2)``."""
    x, y = (track[:, axis] - path[:, axis, None] for axis in (0, 1))
    x *= x
    y *= y
    x += y
    return x.max(axis=0)
