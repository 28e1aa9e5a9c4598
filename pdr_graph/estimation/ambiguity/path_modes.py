"""Paths of a walk: an optimum for each path that its plan admits, or for each direction without one.

Fixes determine a path if the walk, estimated without its plan, has a sigma below a third of the distance between two
aisles. After the last fixes it may be wider; particles then search for alternative endings. Else particles search from
the start, and the modes of their paths are starts of the optimiser. Each path is a solution by its cost, with the price
of the regions that it leads through.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from pdr_graph.estimation.ambiguity.bank import pruned
from pdr_graph.estimation.factors.base import Stage, State
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import OPEN_DIRECTIONS
from pdr_graph.estimation.linear_system import Solution
from pdr_graph.estimation.optimizer import (
    ROUGHLY,
    Optimum,
    continued,
    optimize,
    solve_loose_walls,
    solve_relaxed,
    solve_robust,
    solve_tight_walls,
)
from pdr_graph.estimation.particle_filter import Paths, particle_filter, particles_from
from pdr_graph.geometry import rotation
from pdr_graph.priors import INITIAL, PARTICLES, PATHS, SEARCH
from pdr_graph.types import Array, Index

FILTER_RUNS = 2  # of particles, until a path fits
MOMENTS, LIVE_MOMENTS = 60, 8  # keyframes at which paths are compared, of a whole walk and of one under way
MOST_MODES, LIVE_MODES = 8, 5  # modes that are solved
MOST_SOUGHT = 300  # modes of which those are the heaviest: after a long gap particles are all over the plan


def solutions(
    graph: WalkGraph, without_walls: Optimum | None = None, sought: Sequence[State] | None = None
) -> list[Optimum]:
    """Distinct solutions, the most probable first; much less probable ones are dropped.

    With a plan, the search starts on the paths that it admits; without, in several directions if the measurements do
    not determine the direction (one fix; two at the ends of a loop). without_walls: the walk without the plan, solved
    if missing; sought: the `sought_starts` without the plan, found if missing.
    """
    if not graph.walled:
        return pruned([solve_robust(start) for start in possible_starts(graph)])
    sought = sought_starts(graph.without_plan()) if sought is None else sought

    # Outliers are classified by the walk without walls: a walk in the wrong aisle would reject good fixes
    without_walls = without_walls or best_without_walls(graph, sought)
    robust, expected = graph.classified_as(without_walls.graph), SEARCH.usual * without_walls.cost
    optima = pruned(_paths_of_fixes(robust, without_walls))
    if not optima or optima[0].surprise >= expected + SEARCH.strained:
        starts, optima = [robust.start, continued(robust.start, without_walls.state)], list[Optimum]()
        if sought:
            optima = solutions_near(robust, [continued(robust.start, start) for start in sought])
        for attempt in range(0 if sought else FILTER_RUNS):
            optima += solutions_near(robust, path_starts(robust, attempt) + (starts if attempt == 0 else []))
            if min(optimum.surprise for optimum in optima) < expected + SEARCH.strained:
                break
    return pruned([replace(optimum, unseen=expected + SEARCH.unseen) for optimum in optima])


def near_walk(graph: WalkGraph, without_walls: Optimum, start: State | None = None) -> Optimum:
    """The local optimum between the walls near the walk without them, or near ``start``."""
    robust = graph.classified_as(without_walls.graph)
    if start is not None:
        return solve_tight_walls(solve_loose_walls(robust, continued(robust.start, start)))
    near = _paths_of_fixes(robust, without_walls)
    near = near or [solve_tight_walls(solve_loose_walls(robust, continued(robust.start, without_walls.state)))]
    return min(near, key=lambda optimum: optimum.surprise)


def different_directions(optimum: Optimum) -> list[Optimum]:
    """The distinct optima near a walk, rotated if the measurements do not determine its direction."""
    graph = optimum.graph
    return pruned([optimum, *(optimize(other, other.start) for other in possible_starts(graph)[1:])])


def best_without_walls(graph: WalkGraph, sought: Sequence[State]) -> Optimum:
    """The best walk without the plan. sought: its `sought_starts`."""
    free = graph.without_plan()
    starts = [free.at(start) for start in sought] or [free]
    return min((solve_robust(start) for start in starts), key=lambda optimum: optimum.surprise)


def sought_starts(graph: WalkGraph) -> list[State]:
    """Rough optima without walls from `WalkGraph.starts`, the distinct ones; empty if a single start is enough."""
    rough = graph.staged(Stage.ROUGH)
    return [optimum.state for optimum in pruned([optimize(rough, start, ROUGHLY) for start in graph.starts()])]


def possible_starts(graph: WalkGraph) -> list[WalkGraph]:
    """The graph at each start of its search: in OPEN_DIRECTIONS if the measurements do not determine its direction."""
    if sought := sought_starts(graph):
        return [graph.at(start) for start in sought]
    if not graph.positions.used.any() or graph.sigma_direction < INITIAL.ambiguous:
        return [graph]
    angles = np.arange(1, OPEN_DIRECTIONS) * 2 * np.pi / OPEN_DIRECTIONS
    return [graph, *(graph.rotated(angle) for angle in angles)]


def solutions_near(graph: WalkGraph, starts: Sequence[State]) -> list[Optimum]:
    """The optima between the walls near some starts, the most probable first."""
    loose = pruned([solve_loose_walls(graph, start) for start in starts])
    return pruned([solve_tight_walls(near) for near in loose])


def _paths_of_fixes(graph: WalkGraph, without_walls: Optimum) -> list[Optimum]:
    """An optimum for each path if the fixes determine it except for its end; else an empty list."""
    until = fixes_determine_path(graph, without_walls.solution)
    if until is None:
        return []
    last, sigma = until
    rough = solve_relaxed(graph, continued(graph.start, without_walls.state), sigma)
    first = solve_tight_walls(rough)
    others = alternative_endings(first.graph, first.state, first.solution, last)
    return [first, *(solve_tight_walls(solve_loose_walls(graph, path)) for path in others)]


def fixes_determine_path(graph: WalkGraph, solution: Solution) -> tuple[int, Array] | None:
    """The last keyframe up to which fixes determine the path, and the sigma of each piece ``(m,)`` [m].

    None if they do not determine it. solution: of the walk without its walls.
    """
    if np.count_nonzero(graph.positions.held & ~graph.positions.outlier) < PATHS.fewest_fixes:
        return None
    count = len(graph.start.poses)
    covariance = solution.joint(("x", np.arange(count)))[:, :2, :2]
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    last = int(np.argmax(np.append(sigma, np.inf) > PATHS.largest_sigma)) - 1
    if last < (1 - PATHS.most_open) * (count - 1):
        return None
    return last, np.maximum(sigma[:-1], sigma[1:])[graph.pieces.interval]


def alternative_endings(graph: WalkGraph, state: State, solution: Solution, last: int) -> list[State]:
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


def path_starts(graph: WalkGraph, attempt: int = 0) -> list[State]:
    """Starts for the optimiser: the middle path of each mode, the heaviest mode first.

    attempt: 0, 1, …; each attempt draws other particles, twice as many as the attempt before.
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
    while weight[left].sum() > 0.01:
        track, weight, number = track.compress(left, axis=2), weight[left], number[left]
        near = _apart(track, track[:, :, 0]) < SEARCH.same_path**2
        share = np.where(near, weight, 0.0)
        middle = track @ (share / share.sum())
        central = int(np.argmin(np.where(near, _apart(track, middle), np.inf)))
        mode = _apart(track, track[:, :, central]) < SEARCH.same_path**2
        yield float(weight[mode].sum()), int(number[central])
        left = ~(mode | near)


def _apart(track: Array, path: Array) -> Array:
    """Square of the greatest distance ``(n,)`` [m²] of each of the tracks ``(k, 2, n)`` from a path ``(k, 2)``."""
    x, y = (track[:, axis] - path[:, axis, None] for axis in (0, 1))
    x *= x
    y *= y
    x += y
    return x.max(axis=0)
