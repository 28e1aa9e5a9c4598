"""The search for the most probable walk: a local optimum, from a start or near a path between walls."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis
from pdr_graph.estimation.factors.base import POSE, Stage, State
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.linear_system import Linearization, Solution
from pdr_graph.priors import SEARCH
from pdr_graph.types import Array

MOST_ITERATIONS = 60
LONGEST_MOVE = 2.0  # [m] of a pose in an iteration with walls, whose gradients are local
LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e6
CONVERGED = 3e-5  # decrease of the cost, relative and absolute, below which an iteration is the last
EXACTLY = 1e-8  # the same for the walk that is returned, if it converges slowly
AT_OPTIMUM = 5e-3  # [m] of any pose from the optimum, from which the walk that is returned is searched on
ROUGHLY = 1e-2  # the same where only the association with rooms and corridors is needed


@dataclass(frozen=True)
class Optimum:
    """Result of the optimiser.

    at: all factors at the optimum; linearization: of the factors there; last: length of the search's last move, of any
    pose along an axis [m]; unseen: the negative log posterior of a path that the search may have missed; assumed:
    hypotheses about sources that err; burden: of these, in addition to the cost, by their evidence [nats], see
    `ambiguity.bank`.
    """

    graph: WalkGraph
    at: Evaluation
    linearization: Linearization
    iterations: int
    converged: bool
    last: float
    unseen: float = np.inf
    assumed: tuple[Hypothesis, ...] = ()
    burden: float = 0.0

    @property
    def solution(self) -> Solution:
        """The solved linear system at the optimum, for covariances."""
        return self.linearization.solution

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


class Descent:
    """The search for the optimum near a start, a step at a time; batch and live.

    at: all factors at the present state; system: linearised there, or just before the last move; equations: of all such
    systems; last: length of the last move, of any pose along an axis [m]; iterations: steps so far, with those that
    were not taken. Raises RuntimeError if the cost is not finite.
    """

    def __init__(self, graph: WalkGraph, start: State | Evaluation, converged: float = CONVERGED):
        at = start if isinstance(start, Evaluation) else graph.evaluate(start)
        self.graph, self.at, self.iterations, self.converged = graph, at, 0, False
        if not np.isfinite(self.at.cost):
            bad = sorted({block.name for block in self.at.blocks if not np.isfinite(block.cost)})
            raise RuntimeError(f"the cost is not finite, of the factors of {', '.join(bad)}")
        self._least, self._damping, self._longest = converged, 0.0, LONGEST_MOVE if graph.walled else np.inf
        self.equations, self.last = graph.normal_equations(self.at), np.inf
        self.system, self._moved = self.equations.assembled(self.at), False

    def step(self) -> None:
        """Take a step if it lowers the cost; else the next step is damped more."""
        if self._moved:
            del self.system  # as large as the next
            self.system, self._moved = self.equations.assembled(self.at), False
        self.iterations += 1
        move, enough = self.system.step(self._damping), self._least * (1 + self.at.cost)
        self.last = _longest(move)
        candidate = self.graph.evaluate(self.at.state.retracted(move, self._longest))
        if not self._damping and self.system.gain(move) <= enough:  # a last move, whose cost nobody needs to know
            self.at.forget_blocks()
            self.at, self.converged = candidate, True
            return
        decrease = self.at.cost - candidate.cost
        if not decrease >= 0 and self._damping < MOST_DAMPING:
            self._damping = max(10 * self._damping, LEAST_DAMPING)
            candidate.forget_blocks()
            return
        self.converged = not decrease > enough
        if decrease >= 0:
            self.at.forget_blocks()
            self.at = candidate
        if not self.converged:
            self._damping = self._damping / 10 if self._damping > LEAST_DAMPING else 0.0
            self._moved = True


def descended(graph: WalkGraph, steps: int) -> Evaluation:
    """The walk after so many steps from the start of ``graph``, or at the optimum nearby."""
    search = Descent(graph, graph.start)
    while not search.converged and search.iterations < steps:
        search.step()
    return search.at


def optimize(graph: WalkGraph, start: State | Evaluation, converged: float = CONVERGED) -> Optimum:
    """Optimise by Gauss–Newton, with Levenberg–Marquardt damping where a step would raise the cost.

    converged: decrease of the cost, relative and absolute, below which the search ends.

    The loop and its linear algebra are not GTSAM's: that passes a copy of all values to each Python callback (quadratic
    in the length of the walk), and takes a Python call for each factor of each iteration.
    """
    search = Descent(graph, start, converged)
    while not search.converged and search.iterations < MOST_ITERATIONS:
        search.step()
    there = Linearization(search.equations, search.at)
    return Optimum(graph, search.at, there, search.iterations, search.converged, search.last)


def fully_optimized(optimum: Optimum) -> Optimum:
    """The optimum, searched on if it is farther than AT_OPTIMUM by its last step and the next: a geometric series.

    The curvature of levels makes the search converge slowly, so that a small decrease can be far from the optimum.
    """
    if optimum.last <= AT_OPTIMUM:
        return optimum
    following = _longest(Descent(optimum.graph, optimum.at).system.step())
    if following <= AT_OPTIMUM * max(1 - following / optimum.last, 0.0):
        return optimum
    further = optimize(optimum.graph, optimum.at, EXACTLY)
    both = {"iterations": optimum.iterations + further.iterations, "converged": optimum.converged or further.converged}
    return replace(optimum, at=further.at, linearization=further.linearization, last=further.last, **both)


def _longest(moves: Mapping[str, Array]) -> float:
    """The longest move of any pose along an axis [m]."""
    return float(np.abs(moves[POSE][:, :2]).max())


def solve_robust(graph: WalkGraph) -> Optimum:
    """The optimum in two passes: consistent measurements with Huber's loss and independent errors; then, from there,
    low weight for outliers, and models of common errors.

    A graph with alternative versions (closures firm or unused) is first optimised from the optimum of each.
    """
    states = [optimize(version, version.start).state for version in graph.alternatives()] or [graph.start]
    first = min((optimize(graph, state) for state in states), key=lambda optimum: optimum.surprise)
    refined = graph.refined(first.at)
    return on_ways(first if refined is graph else optimize(refined, continued(refined.start, first.state)))


def on_ways(walk: Optimum, free: bool = True) -> Optimum:
    """The walk along the outdoor paths that it followed, as matched without them; itself without a network.

    free: no path holds it yet.
    """
    ways = walk.graph.ways
    if ways is None:
        return walk
    if not free:
        walk = optimize(walk.graph.assuming((ways.about(ways.network),)), walk.state)
    covariance = walk.solution.joint((POSE, np.arange(len(walk.state.poses))))
    sigma, askew = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2), np.sqrt(covariance[:, 2, 2])
    matched = ways.matched(walk.at, sigma, askew)
    return optimize(walk.graph.assuming((matched,)), walk.state)


def continued(start: State, optimum: State, fresh: Collection[str] = ()) -> State:
    """The optimum of the earlier variables; new variables, and those of symbols ``fresh``, at ``start``."""
    old = {symbol: rows for symbol, rows in optimum.arrays.items() if symbol in start.arrays and symbol not in fresh}
    return start.replaced(**{symbol: rows for symbol, rows in old.items() if len(rows) == len(start[symbol])})


def solve_relaxed(graph: WalkGraph, path: State, sigma: Array) -> Optimum:
    """Approximate optimum near a path with sigma ``(m,)`` [m], with loose walls of the most probable regions."""
    return _staged(graph.associated_at(path, sigma, SEARCH.alike), path, ROUGHLY)


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
    return min(first, optimize(associated, first.state), key=lambda optimum: optimum.surprise)
