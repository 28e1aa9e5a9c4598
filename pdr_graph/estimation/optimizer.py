"""The search for the most probable walk, and for other walks that explain the measurements about as well."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.factors.base import Hypothesis, Stage, State
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.normal_equations import AnySolution, LinearSystem
from pdr_graph.estimation.path_modes import alternative_endings, fixes_determine_path, hypotheses
from pdr_graph.priors import INITIAL, SEARCH
from pdr_graph.types import Array, Index

MOST_ITERATIONS = 60
LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e6
CONVERGED = 3e-5  # decrease of the cost, relative and absolute, below which an iteration is the last
ROUGHLY = 1e-2  # the same where only the association with rooms and corridors is needed
DIFFERENT = 0.5  # [m] largest distance at some step above which two solutions differ
# Of a probability: its square is not 0, as a walk that fits nothing is still the best there is
LEAST_LOGARITHM = -300.0


@dataclass(frozen=True)
class Optimum:
    """Result of the optimiser.

    at: all factors at the optimum; system: linearised just before the last move, or derived from a solved one; unseen:
    the negative log posterior of a path that the search may have missed; assumed: about sources that err, see
    `hypotheses`; burden: of these assumptions, in addition to the cost, by their evidence [nats].
    """

    graph: WalkGraph
    at: Evaluation
    system: LinearSystem | AnySolution
    iterations: int
    converged: bool
    unseen: float = np.inf
    assumed: tuple[Hypothesis, ...] = ()
    burden: float = 0.0

    @property
    def solution(self) -> AnySolution:
        """The solved linear system, for covariances."""
        return self.system.solution if isinstance(self.system, LinearSystem) else self.system

    @property
    def state(self) -> State:
        """The variables at the optimum."""
        return self.at.state

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted residuals."""
        return self.at.cost

    @property
    def surprise(self) -> float:
        """Negative log posterior, least for the most probable walk."""
        return self.at.surprise + self.burden


def solutions(graph: WalkGraph, without_walls: Optimum | None = None) -> list[Optimum]:
    """Distinct solutions, the most probable first; much less probable ones are dropped.

    With a plan, the search starts on the paths that it admits; without, in several directions if the measurements do
    not determine the direction (one fix; two at the ends of a loop). without_walls: the walk without the plan, solved
    if missing.
    """
    if graph.walled:
        return _distinct(_in_the_building(graph, without_walls or solve_robust(graph.without_plan())))
    return _distinct([solve_robust(start) for start in _rotated(graph)])


def corrected_solutions(graph: WalkGraph, without_walls: Optimum | None = None) -> list[Optimum]:
    """As `solutions`, repeated without listed positions that the most probable walk contradicts (relocated beacons)."""
    optima = solutions(graph, without_walls)
    while corrected := optima[0].graph.corrected(optima[0].at):
        optima = solutions(corrected)
    return optima


def near_start(graph: WalkGraph) -> Optimum:
    """The local optimum near the start of ``graph``, with rooms and corridors associated along it."""
    first = solve_robust(graph)
    return _between_own_walls(first.graph, first)


def near_walk(graph: WalkGraph, without_walls: Optimum, start: State | None = None) -> Optimum:
    """The local optimum between the walls near the walk without them, or near ``start``."""
    robust = graph.classified_as(without_walls.graph)
    if start is not None:
        return _solve_tight_walls(_solve_loose_walls(robust, continued(robust.start, start)))
    near = _paths_of_fixes(robust, without_walls)
    near = near or [_solve_tight_walls(_solve_loose_walls(robust, continued(robust.start, without_walls.state)))]
    return min(near, key=_negative_log_posterior)


def different_directions(optimum: Optimum) -> list[Optimum]:
    """The distinct optima near a walk, rotated if the measurements do not determine its direction."""
    graph = optimum.graph
    return _distinct([optimum, *(optimize(other, other.start) for other in _rotated(graph)[1:])])


def probabilities(optima: list[Optimum], path: Index) -> Array:
    """Probabilities ``(n,)`` of different solutions, by their negative log posterior.

    path: ``(n,)`` see `paths`; solutions on one path share the weight of the best. The remainder to 1 is the
    probability of paths that the search missed; it grows with the excess of the best cost over the usual cost. On
    simulated walks (`scripts/reproduce topology` shows others) cost and price need no scale; the curvature at a
    solution (Laplace's approximation) and the number of particles on its path add no information.
    """
    surprise = np.array([optimum.surprise for optimum in optima])
    least = min(surprise.min(), optima[0].unseen)
    weight, together = np.exp(np.maximum(least - surprise, LEAST_LOGARITHM)), path[:, None] == path
    weight = weight * np.max(weight * together, axis=1) / (together @ weight)
    return weight / (weight.sum() + np.exp(least - optima[0].unseen))


def paths(optima: list[Optimum]) -> Index:
    """The path of each solution ``(n,)``: index of the first solution within SEARCH.same_path of it on average."""
    tracks = np.array([optimum.at.ends[:, :2] for optimum in optima])
    near = np.hypot(*(tracks[:, None] - tracks).transpose(3, 0, 1, 2)).mean(axis=2) < SEARCH.same_path
    return np.argmax(near, axis=1)


def optimize(graph: WalkGraph, start: State, converged: float = CONVERGED) -> Optimum:
    """Optimise by Gauss–Newton, with Levenberg–Marquardt damping where a step would raise the cost.

    converged: decrease of the cost, relative and absolute, below which the search ends.

    The loop and its linear algebra are not GTSAM's: that passes a copy of all values to each Python callback (quadratic
    in the length of the walk), and takes a Python call for each factor of each iteration.
    """
    at, damping, longest = graph.evaluate(start), 0.0, SEARCH.longest_move if graph.walled else np.inf
    equations = graph.normal_equations(at)
    system = equations.assembled(at)
    for iteration in range(1, MOST_ITERATIONS + 1):
        candidate = graph.evaluate(at.state.retracted(system.step(damping), longest))
        decrease = at.cost - candidate.cost
        if decrease < 0 and damping < MOST_DAMPING:
            damping = max(10 * damping, LEAST_DAMPING)
            candidate.forget_blocks()
            continue
        last = decrease <= converged * (1 + at.cost)
        if decrease >= 0:
            at.forget_blocks()
            at = candidate
        if last:
            return Optimum(graph, at, system.solved, iteration, converged=True)
        damping = damping / 10 if damping > LEAST_DAMPING else 0.0
        del system  # as large as the next
        system = equations.assembled(at)
    return Optimum(graph, at, system.solved, MOST_ITERATIONS, converged=False)


def _rotated(graph: WalkGraph) -> list[WalkGraph]:
    """The graph, rotated to SEARCH.directions starts if the measurements do not determine its direction."""
    if not graph.positions.used.any() or graph.sigma_direction < INITIAL.ambiguous:
        return [graph]
    every = 2 * np.pi / SEARCH.directions
    return [graph, *(graph.rotated(every * n) for n in range(1, SEARCH.directions))]


def solve_robust(graph: WalkGraph) -> Optimum:
    """The optimum in two passes: consistent measurements with Huber's loss and independent errors; then, from there,
    low weight for outliers, and models of common errors.
    """
    first = _solve_alternatives(graph) or optimize(graph, graph.start)
    refined = graph.refined(first.at)
    return first if refined is graph else optimize(refined, continued(refined.start, first.state))


def _solve_alternatives(graph: WalkGraph) -> Optimum | None:
    """The best optimum from the alternative versions of the graph (closures firm or unused); None without any."""
    starts = [optimize(version, version.start).state for version in graph.alternatives()]
    return min((optimize(graph, start) for start in starts), key=_negative_log_posterior) if starts else None


def continued(start: State, optimum: State, fresh: Collection[str] = ()) -> State:
    """The optimum of the variables that were there before; new ones, and those of symbols ``fresh``, at ``start``."""
    old = {symbol: rows for symbol, rows in optimum.arrays.items() if symbol in start.arrays and symbol not in fresh}
    return start.replaced(**{symbol: rows for symbol, rows in old.items() if len(rows) == len(start[symbol])})


def _in_the_building(graph: WalkGraph, without_walls: Optimum) -> list[Optimum]:
    """An optimum for each path that the plan admits, and near the walk aligned with the fixes.

    Outliers are classified by the walk without walls: a walk in the wrong aisle would reject good fixes.
    """
    robust, expected = graph.classified_as(without_walls.graph), SEARCH.usual * without_walls.cost
    optima = _distinct(_paths_of_fixes(robust, without_walls))
    if optima and optima[0].surprise < expected + SEARCH.strained:
        return [replace(optimum, unseen=expected + SEARCH.unseen) for optimum in optima]
    aligned, optima = [robust.start, continued(robust.start, without_walls.state)], list[Optimum]()
    for attempt in range(SEARCH.attempts):
        optima += solutions_near(robust, hypotheses(robust, attempt) + (aligned if attempt == 0 else []))
        if min(optimum.surprise for optimum in optima) < expected + SEARCH.strained:
            break
    return [replace(optimum, unseen=expected + SEARCH.unseen) for optimum in optima]


def solutions_near(graph: WalkGraph, starts: Sequence[State]) -> list[Optimum]:
    """The optima between the walls near some starts, the most probable first."""
    loose = _distinct([_solve_loose_walls(graph, start) for start in starts])
    return _distinct([_solve_tight_walls(near) for near in loose])


def _paths_of_fixes(graph: WalkGraph, without_walls: Optimum) -> list[Optimum]:
    """An optimum for each path if the fixes determine it except for its end; else an empty list."""
    until = fixes_determine_path(graph, without_walls.solution)
    if until is None:
        return []
    last, sigma = until
    rough = _solve_relaxed(graph, continued(graph.start, without_walls.state), sigma)
    first = _solve_tight_walls(rough)
    others = alternative_endings(first.graph, first.state, first.solution, last)
    return [first, *(_solve_tight_walls(_solve_loose_walls(graph, path)) for path in others)]


def _solve_relaxed(graph: WalkGraph, path: State, sigma: Array) -> Optimum:
    """Approximate optimum near a path with sigma ``(m,)`` [m], with loose walls of the most probable regions."""
    return _staged(graph.associated_at(path, sigma, SEARCH.alike), path, ROUGHLY)


def _solve_loose_walls(graph: WalkGraph, path: State) -> Optimum:
    """The optimum near a path, with loose walls of the rooms and corridors that it leads through."""
    return _staged(graph.associated_at(path), path, CONVERGED)


def _staged(graph: WalkGraph, path: State, converged: float) -> Optimum:
    """The optimum in the rough stage, together with the original graph."""
    return replace(optimize(graph.staged(Stage.ROUGH), path, converged), graph=graph)


def _solve_tight_walls(near: Optimum) -> Optimum:
    """The optimum with tight walls from ``near``, then with walls associated along itself."""
    return _between_own_walls(near.graph, optimize(near.graph.staged(Stage.FINAL), near.state))


def _between_own_walls(graph: WalkGraph, first: Optimum) -> Optimum:
    """The better of ``first`` and the optimum near it with walls associated along it."""
    associated = graph.associated_at(first.state)
    if associated.same_association(first.graph):
        return first
    return min(first, optimize(associated, first.state), key=_negative_log_posterior)


def _negative_log_posterior(optimum: Optimum) -> float:
    return optimum.surprise


def _distinct(solutions: list[Optimum]) -> list[Optimum]:
    """Distinct solutions within SEARCH.dropped of the best, the most probable first."""
    kept: list[Optimum] = []
    for solution in sorted(
        solutions, key=lambda s: round(s.surprise, 3)
    ):  # of equals the first: heading 0 with one fix
        track = solution.at.ends[:, :2]
        apart = [np.abs(track - other.at.ends[:, :2]).max() for other in kept]
        if all(a > DIFFERENT for a in apart) and (not kept or solution.surprise - kept[0].surprise < SEARCH.dropped):
            kept.append(solution)
    return kept
