"""The most probable walk, and other walks that explain the measurements about as well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pdr_graph.estimation.endings import alternative_endings, fixes_determine_path
from pdr_graph.estimation.factors.base import Stage, State
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import AMBIGUOUS
from pdr_graph.estimation.path_modes import hypotheses
from pdr_graph.types import Array, Index

MOST_ITERATIONS = 60
LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e6
CONVERGED = 3e-5  # an iteration that takes less than this share, or this much, off the cost is the last
ROUGHLY = 1e-2  # the same where only the rooms and corridors about the walk are sought
ALIKE = 30.0  # steps in a row whose places err alike, between fixes
LONGEST_MOVE = 2.0  # [m] of any pose in one iteration where walls are near, whose pull is local
UNLIKELY = 12.0  # cost above the best at which another solution is not worth mentioning
USUAL = 1.5  # times the cost of a walk without walls that one between walls has
STRAINED = 3.0  # cost above the usual at which other paths are sought
ATTEMPTS = 2
DIRECTIONS = 8  # to start in where any is possible
UNSEEN = 4.5  # cost above the usual at which a path that the particles missed must be reckoned with
DIFFERENT = 0.5  # [m] apart at some step: another solution
SAME_PATH = 4.0  # [m] apart on average: half the distance from the middle of an aisle to that of the next


@dataclass(frozen=True)
class Optimum:
    """Where the optimiser stopped.

    at: all factors there; net: the graph factorised just before the last move; unseen: the negative log posterior of a
    path that was not found.
    """

    graph: WalkGraph
    at: Evaluation
    net: gtsam.GaussianBayesNet
    iterations: int
    converged: bool
    unseen: float = np.inf

    @property
    def state(self) -> State:
        """The variables there."""
        return self.at.state

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted residuals."""
        return self.at.cost

    @property
    def surprise(self) -> float:
        """Negative log posterior, least for the most probable walk."""
        return self.at.surprise


def solutions(graph: WalkGraph) -> list[Optimum]:
    """The most probable walk first, then different ones that are not hopeless.

    With a plan, the paths that it admits are followed; without, any direction where the measurements leave it open (one
    fix; two at the ends of a loop).
    """
    return _distinct(_in_the_building(graph) if graph.walled else [solve_robust(start) for start in _rotated(graph)])


def corrected_solutions(graph: WalkGraph) -> list[Optimum]:
    """As `solutions`, again without what the most probable walk shows to be listed wrongly (beacons elsewhere)."""
    found = solutions(graph)
    while corrected := found[0].graph.corrected(found[0].at):
        found = solutions(corrected)
    return found


def near_start(graph: WalkGraph) -> Optimum:
    """The most probable walk near the start of ``graph``, whose rooms and corridors are those of the walk."""
    first = solve_robust(graph)
    return _between_own_walls(first.graph, first)


def probabilities(found: list[Optimum], path: Index) -> Array:
    """Probabilities ``(n,)`` of different solutions: the less measurements and plan have against one, the likelier.

    path: ``(n,)`` as of `paths`; solutions on one path share its weight, that of the best. What all lack to 1 is of
    paths on the plan that nobody found: the more the best is strained beyond the walk without walls, the more. On
    simulated walks (`scripts/reproduce topology` has others) cost and price count as they are; how sharply a solution
    is determined (Laplace's approximation) and how many particles went its path tell nothing more.
    """
    surprise = np.array([one.surprise for one in found])
    least = min(surprise.min(), found[0].unseen)
    weight, together = np.exp(least - surprise), path[:, None] == path
    weight = weight * np.max(weight * together, axis=1) / (together @ weight)
    return weight / (weight.sum() + np.exp(least - found[0].unseen))


def paths(found: list[Optimum]) -> Index:
    """Which path each solution takes ``(n,)``: the first solution's that it keeps near."""
    tracks = np.array([one.at.ends[:, :2] for one in found])
    near = np.hypot(*(tracks[:, None] - tracks).transpose(3, 0, 1, 2)).mean(axis=2) < SAME_PATH
    return np.argmax(near, axis=1)


def optimize(graph: WalkGraph, start: State, converged: float = CONVERGED) -> Optimum:
    """Gauss–Newton, with Levenberg–Marquardt damping where a step would raise the cost.

    converged: share of the cost, or cost, below which a step ends it.

    The loop is our own because GTSAM's hands each Python callback a copy of all values (quadratic in the walk's
    length). METIS ordering: the default overflows the stack on long chains.
    """
    at, damping, longest = graph.evaluate(start), 0.0, LONGEST_MOVE if graph.walled else np.inf
    linear = at.linearized()
    ordering = at.ordering(linear)
    stay = dict[float, gtsam.GaussianFactorGraph]()
    for iteration in range(1, MOST_ITERATIONS + 1):
        net = _damped(linear, damping, stay).eliminateSequential(ordering)
        candidate = graph.evaluate(at.state.retracted(net.optimize(), longest))
        decrease = at.cost - candidate.cost
        if decrease < 0 and damping < MOST_DAMPING:
            damping = max(10 * damping, LEAST_DAMPING)
            continue
        last = decrease <= converged * (1 + at.cost)
        if decrease >= 0:
            at = candidate
        if last:
            net = linear.eliminateSequential(ordering) if damping else net
            return Optimum(graph, at, net, iteration, converged=True)
        damping = damping / 10 if damping > LEAST_DAMPING else 0.0
        linear = at.linearized()
    net = linear.eliminateSequential(ordering)
    return Optimum(graph, at, net, MOST_ITERATIONS, converged=False)


def _damped(
    linear: gtsam.GaussianFactorGraph, damping: float, stay: dict[float, gtsam.GaussianFactorGraph]
) -> gtsam.GaussianFactorGraph:
    """The graph with Levenberg–Marquardt's prior on every variable to stay where it is; ``stay`` keeps these."""
    if damping == 0:
        return linear
    if damping not in stay:
        stay[damping], unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(3)
        root, nothing = np.sqrt(damping) * np.eye(3), np.zeros(3)
        for key in linear.keyVector():
            stay[damping].add(key, root, nothing, unit)
    damped = gtsam.GaussianFactorGraph()
    damped.push_back(linear)
    damped.push_back(stay[damping])
    return damped


def _rotated(graph: WalkGraph) -> list[WalkGraph]:
    """The starts that the measurements leave open: one, or as many directions."""
    if not graph.positions.used.any() or graph.sigma_direction < AMBIGUOUS:
        return [graph]
    return [graph, *(graph.rotated(angle) for angle in np.arange(1, DIRECTIONS) * 2 * np.pi / DIRECTIONS)]


def solve_robust(graph: WalkGraph) -> Optimum:
    """The optimum under Huber's loss, with all that is consistent, each instance for itself; then again from there,
    with little weight for outliers, and with the common errors of the others.
    """
    first = _solve_alternatives(graph) or optimize(graph, graph.start)
    again = graph.refined(first.at)
    return first if again is graph else optimize(again, _continued(again.start, first.state))


def _solve_alternatives(graph: WalkGraph) -> Optimum | None:
    """The better of the optima that versions of the graph lead to; None if it has none.

    An optimum near a closure that holds, say, knows of no other.
    """
    starts = [optimize(one, one.start).state for one in graph.alternatives()]
    return min((optimize(graph, start) for start in starts), key=_negative_log_posterior) if starts else None


def _continued(start: State, found: State) -> State:
    """What was found of the variables that there were before; of new ones the start."""
    known = {symbol: rows for symbol, rows in found.arrays.items() if len(rows) == len(start.arrays.get(symbol, ()))}
    return start.replaced(**{symbol: rows for symbol, rows in known.items() if symbol in start.arrays})


def _in_the_building(graph: WalkGraph) -> list[Optimum]:
    """An optimum for each path that the plan admits, and near the walk aligned with the fixes.

    Outliers are classified by the walk without walls: a walk in the wrong aisle would reject good fixes.
    """
    without_walls = solve_robust(graph.without_plan())
    robust, expected = graph.classified_as(without_walls.graph), USUAL * without_walls.cost
    found = _distinct(_paths_of_fixes(robust, without_walls))
    if found and found[0].surprise < expected + STRAINED:
        return [replace(one, unseen=expected + UNSEEN) for one in found]
    aligned, found = [robust.start, _continued(robust.start, without_walls.state)], list[Optimum]()
    for attempt in range(ATTEMPTS):
        starts = hypotheses(robust, attempt) + (aligned if attempt == 0 else [])
        found += [
            _solve_tight_walls(near) for near in _distinct([_solve_loose_walls(robust, start) for start in starts])
        ]
        if min(one.surprise for one in found) < expected + STRAINED:
            break
    return [replace(one, unseen=expected + UNSEEN) for one in found]


def _paths_of_fixes(graph: WalkGraph, without_walls: Optimum) -> list[Optimum]:
    """An optimum for each path, if the fixes determine it but for its end; else an empty list."""
    until = fixes_determine_path(graph, without_walls.net)
    if until is None:
        return []
    last, sigma = until
    rough = _solve_relaxed(graph, _continued(graph.start, without_walls.state), sigma)
    first = _solve_tight_walls(rough)
    others = alternative_endings(first.graph, first.state, first.net, last)
    return [first, *(_solve_tight_walls(_solve_loose_walls(graph, path)) for path in others)]


def _solve_relaxed(graph: WalkGraph, path: State, sigma: Array) -> Optimum:
    """About the optimum near a path that errs by ``sigma (m,)`` [m], between the loose walls that it may be between."""
    about = graph.associated_at(path, sigma, ALIKE)
    return _staged(about, path, ROUGHLY)


def _solve_loose_walls(graph: WalkGraph, path: State) -> Optimum:
    """The optimum near one path, between the loose walls of the rooms and corridors that it leads through."""
    return _staged(graph.associated_at(path), path, CONVERGED)


def _staged(graph: WalkGraph, path: State, converged: float) -> Optimum:
    """The optimum with all factors as in a rough search; it keeps the graph as it is without."""
    return replace(optimize(graph.staged(Stage.ROUGH), path, converged), graph=graph)


def _solve_tight_walls(near: Optimum) -> Optimum:
    """The optimum from there between the walls as they are, then between those that it has itself."""
    return _between_own_walls(near.graph, optimize(near.graph.staged(Stage.FINAL), near.state))


def _between_own_walls(graph: WalkGraph, first: Optimum) -> Optimum:
    """An optimum, or the one near it between the walls of the rooms and corridors that it has itself."""
    again = graph.associated_at(first.state)
    return (
        first
        if again.same_association(first.graph)
        else min(first, optimize(again, first.state), key=_negative_log_posterior)
    )


def _negative_log_posterior(one: Optimum) -> float:
    return one.surprise


def _distinct(solutions: list[Optimum]) -> list[Optimum]:
    """Different solutions that are not hopeless, the most probable first."""
    kept: list[Optimum] = []
    for one in sorted(solutions, key=lambda s: round(s.surprise, 3)):  # of equals the first: heading 0 with one fix
        track = one.at.ends[:, :2]
        apart = [np.abs(track - other.at.ends[:, :2]).max() for other in kept]
        if all(a > DIFFERENT for a in apart) and (not kept or one.surprise - kept[0].surprise < UNLIKELY):
            kept.append(one)
    return kept
