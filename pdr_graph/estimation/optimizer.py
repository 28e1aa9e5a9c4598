"""The search for the most probable walk: a local optimum, from a start or near a path between walls."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis
from pdr_graph.estimation.factors.base import Stage, State
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.normal_equations import LinearSystem, Solution
from pdr_graph.types import Array

MOST_ITERATIONS = 60
LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e6
CONVERGED = 3e-5  # decrease of the cost, relative and absolute, below which an iteration is the last
ROUGHLY = 1e-2  # the same where only the association with rooms and corridors is needed
ALIKE = 30.0  # steps in a row with the same position error, between fixes
LONGEST_MOVE = 2.0  # [m] of any pose in one iteration with walls, whose gradients are valid only nearby


@dataclass(frozen=True)
class Optimum:
    """Result of the optimiser.

    at: all factors at the optimum; system: linearised just before the last move; unseen: the negative log posterior of
    a path that the search may have missed; assumed: hypotheses about sources that err; burden: of these, in addition to
    the cost, by their evidence [nats], see `ambiguity.bank`.
    """

    graph: WalkGraph
    at: Evaluation
    system: LinearSystem | Solution
    iterations: int
    converged: bool
    unseen: float = np.inf
    assumed: tuple[Hypothesis, ...] = ()
    burden: float = 0.0

    @property
    def solution(self) -> Solution:
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


def near_start(graph: WalkGraph) -> Optimum:
    """The local optimum near the start of ``graph``, with rooms and corridors associated along it."""
    first = solve_robust(graph)
    return _between_own_walls(first.graph, first)


def optimize(graph: WalkGraph, start: State, converged: float = CONVERGED) -> Optimum:
    """Optimise by Gauss–Newton, with Levenberg–Marquardt damping where a step would raise the cost.

    converged: decrease of the cost, relative and absolute, below which the search ends.

    The loop and its linear algebra are not GTSAM's: that passes a copy of all values to each Python callback (quadratic
    in the length of the walk), and takes a Python call for each factor of each iteration.
    """
    at, damping, longest = graph.evaluate(start), 0.0, LONGEST_MOVE if graph.walled else np.inf
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
    return min((optimize(graph, start) for start in starts), key=negative_log_posterior) if starts else None


def continued(start: State, optimum: State, fresh: Collection[str] = ()) -> State:
    """The optimum of the variables that were there before; new ones, and those of symbols ``fresh``, at ``start``."""
    old = {symbol: rows for symbol, rows in optimum.arrays.items() if symbol in start.arrays and symbol not in fresh}
    return start.replaced(**{symbol: rows for symbol, rows in old.items() if len(rows) == len(start[symbol])})


def solve_relaxed(graph: WalkGraph, path: State, sigma: Array) -> Optimum:
    """Approximate optimum near a path with sigma ``(m,)`` [m], with loose walls of the most probable regions."""
    return _staged(graph.associated_at(path, sigma, ALIKE), path, ROUGHLY)


def solve_loose_walls(graph: WalkGraph, path: State) -> Optimum:
    """The optimum near a path, with loose walls of the rooms and corridors that it leads through."""
    return _staged(graph.associated_at(path), path, CONVERGED)


def _staged(graph: WalkGraph, path: State, converged: float) -> Optimum:
    """The optimum in the rough stage, together with the original graph."""
    return replace(optimize(graph.staged(Stage.ROUGH), path, converged), graph=graph)


def solve_tight_walls(near: Optimum) -> Optimum:
    """The optimum with tight walls from ``near``, then with walls associated along itself."""
    return _between_own_walls(near.graph, optimize(near.graph.staged(Stage.FINAL), near.state))


def _between_own_walls(graph: WalkGraph, first: Optimum) -> Optimum:
    """The better of ``first`` and the optimum near it with walls associated along it."""
    associated = graph.associated_at(first.state)
    if associated.same_association(first.graph):
        return first
    return min(first, optimize(associated, first.state), key=negative_log_posterior)


def negative_log_posterior(optimum: Optimum) -> float:
    """The key by which optima are compared."""
    return optimum.surprise
