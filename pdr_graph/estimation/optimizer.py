"""Finding the most probable walk, and whatever else explains the measurements about as well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pdr_graph.estimation.factors import Evaluation
from pdr_graph.estimation.graph import AMBIGUOUS, DOUBTED, FIRM, UNBOUND, State, WalkGraph
from pdr_graph.estimation.hypotheses import hypotheses
from pdr_graph.estimation.told import other_ends, told
from pdr_graph.types import Array, Index, Mask

MOST_ITERATIONS = 60
LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e6
SETTLED = 3e-5  # the cost has settled when an iteration takes less than this share, or this much, off it
ROUGHLY = 1e-2  # the same where only the rooms and corridors about the walk are sought
ALIKE = 30.0  # steps in a row whose places err alike, between fixes
LONGEST_MOVE = 2.0  # [m] of any pose in one iteration where walls are near, whose pull is local
LOOSE = 3.0  # times as loosely walls hold at first: hard walls keep a walk that starts 3° off in the wrong aisle
WILD = 5.0  # [σ] beyond which a fix loses its grip in the second pass
UNLIKELY = 12.0  # cost above the best at which another solution is not worth mentioning
USUAL = 1.5  # times the cost of a walk in the open that one between walls has
STRAINED = 3.0  # cost above the usual at which other ways are sought
ATTEMPTS = 2
DIRECTIONS = 8  # to start in where any is possible
UNSEEN = 4.5  # cost above the usual at which a way that the particles missed must be reckoned with
DIFFERENT = 0.5  # [m] apart at some step: another solution
SAME_WAY = 4.0  # [m] apart on average: half the distance from the middle of an aisle to that of the next


def solutions(graph: WalkGraph) -> list[Optimum]:
    """The most probable walk first, then different ones that are not hopeless.

    With a plan, the ways that it admits are followed; without, any direction where the measurements leave it open (one
    fix; two at the ends of a loop).
    """
    return _distinct(_in_the_building(graph) if graph.walled else [_robustly(start) for start in _turned(graph)])


def near_start(graph: WalkGraph) -> Optimum:
    """The most probable walk near the start of ``graph``, whose rooms and corridors are those of the walk."""
    first = _robustly(graph)
    return _between_own_walls(first.graph, first)


def probabilities(found: list[Optimum], way: Index) -> Array:
    """Of different solutions ``(n,)``: the less the measurements and the plan have against one, the likelier.

    way: ``(n,)`` as of `ways`; solutions of one way share its weight, that of the best. What all lack to 1 is of ways
    on the plan that nobody found: the more the best is strained beyond the walk in the open, the more. On simulated
    walks (`scripts/reproduce topology` has others) cost and price count as they are; how sharply a solution is
    determined (Laplace's approximation) and how many particles went its way tell nothing more.
    """
    surprise = np.array([one.surprise for one in found])
    least = min(surprise.min(), found[0].unseen)
    weight, together = np.exp(least - surprise), way[:, None] == way
    weight = weight * np.max(weight * together, axis=1) / (together @ weight)
    return weight / (weight.sum() + np.exp(least - found[0].unseen))


def ways(found: list[Optimum]) -> Index:
    """Which way each solution goes ``(n,)``: the first one's that it keeps near."""
    tracks = np.array([one.own.ends[:, :2] for one in found])
    near = np.hypot(*(tracks[:, None] - tracks).transpose(3, 0, 1, 2)).mean(axis=2) < SAME_WAY
    return np.argmax(near, axis=1)


@dataclass(frozen=True)
class Optimum:
    """Where the optimiser stopped.

    own: the own factors there; net: the graph factorised just before the last move; unseen: the surprise of a way that
    was not found.
    """

    graph: WalkGraph
    values: gtsam.Values
    own: Evaluation
    net: gtsam.GaussianBayesNet
    cost: float
    iterations: int
    converged: bool
    unseen: float = np.inf

    @property
    def surprise(self) -> float:
        """What the measurements and the plan have against it: least for the most probable."""
        return self.cost + (self.graph.walls.price if self.graph.walls else 0.0)


def optimize(graph: WalkGraph, start: gtsam.Values, settled: float = SETTLED) -> Optimum:
    """Gauss–Newton, with Levenberg–Marquardt damping where a step would raise the cost.

    settled: share of the cost, or cost, below which a step ends it.

    The loop is our own because GTSAM's hands each Python callback a copy of all values (quadratic in the walk's
    length). METIS ordering: the default overflows the stack on long chains.
    """
    values, own = start, graph.evaluate(start)
    cost, damping = own.cost + graph.native.error(values), 0.0
    linear = graph.linearize(values, own)
    ordering = gtsam.Ordering.MetisGaussianFactorGraph(linear)
    stay = dict[float, gtsam.GaussianFactorGraph]()
    for iteration in range(1, MOST_ITERATIONS + 1):
        net = _damped(linear, damping, stay).eliminateSequential(ordering)
        move = net.optimize()
        candidate = values.retract(_capped(move, len(graph.start.poses)) if graph.walls else move)
        candidate_own = graph.evaluate(candidate)
        decrease = cost - candidate_own.cost - graph.native.error(candidate)
        if decrease < 0 and damping < MOST_DAMPING:
            damping = max(10 * damping, LEAST_DAMPING)
            continue
        if decrease >= 0:
            values, own, cost = candidate, candidate_own, cost - decrease
        if decrease <= settled * (1 + cost):
            net = linear.eliminateSequential(ordering) if damping else net
            return Optimum(graph, values, own, net, cost, iteration, converged=True)
        damping = damping / 10 if damping > LEAST_DAMPING else 0.0
        linear = graph.linearize(values, own)
    net = linear.eliminateSequential(ordering)
    return Optimum(graph, values, own, net, cost, MOST_ITERATIONS, converged=False)


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


def _capped(move: gtsam.VectorValues, poses: int) -> gtsam.VectorValues:
    """The move, shortened so that no pose goes further than LONGEST_MOVE. Poses come last, their key being x."""
    furthest = np.abs(move.vector().reshape(-1, 3)[-poses:, :2]).max()
    move.scaleInPlace(min(1.0, LONGEST_MOVE / max(furthest, 1e-9)))
    return move


def _turned(graph: WalkGraph) -> list[WalkGraph]:
    """The starts that the measurements leave open: one, or as many directions."""
    if not graph.fix_used.any() or graph.sigma_direction < AMBIGUOUS:
        return [graph]
    return [graph, *(graph.turned(angle) for angle in np.arange(1, DIRECTIONS) * 2 * np.pi / DIRECTIONS)]


def _robustly(graph: WalkGraph) -> Optimum:
    """The optimum under Huber's loss, every fix that is within reach of the others for itself; then again from there,
    without the grip of those that it left far off, and with what the others have in common.
    """
    first = _bound(graph) if len(graph.closures) else optimize(graph, graph.start.to_values())
    far = graph.fix_used & (graph.fix_distance(first.values) > WILD * graph.fix_sigma)
    held = graph.fix_used & (graph.fix_believed | ~_mostly(far, graph.fix_run))
    if not (far.any() or any(graph.fixes.sources) or graph.by_proximity) and (held == graph.fix_held).all():
        return first
    again = graph.with_offsets(far, held)
    return optimize(again, replace(State.of(first.values), g=again.start.g).to_values())


def _bound(graph: WalkGraph) -> Optimum:
    """Closures may be mistaken, and an optimum near one that holds knows of no other: the better of two, from where all
    hold and from where none does.
    """
    starts = [optimize(graph.with_closures(hold), graph.start.to_values()).values for hold in (FIRM, UNBOUND)]
    return min((optimize(graph, start) for start in starts), key=_surprise)


def _mostly(far: Mask, run: Index) -> Mask:
    """Whether most fixes of each one's run are far off ``(f,)``: the others of a run in one wild place do not become
    right where the walk happens to pass it.
    """
    share = np.bincount(run + 1, far) / np.maximum(np.bincount(run + 1), 1)
    return share[run + 1] > 0.5


def _in_the_building(graph: WalkGraph) -> list[Optimum]:
    """An optimum for each of the ways that the plan admits, and near the walk as fixes lay it, which may know it well.

    Which fixes are wild is asked of the walk without walls: a walk that they lead astray would blame the fixes.
    """
    in_the_open = _robustly(graph.without_walls())
    held = in_the_open.graph.fix_held
    robust, expected = graph.with_offsets(in_the_open.graph.fix_wild, held), USUAL * in_the_open.cost
    found = _distinct(_as_fixes_tell(robust, in_the_open))
    if found and found[0].surprise < expected + STRAINED:
        return [replace(one, unseen=expected + UNSEEN) for one in found]
    as_laid, found = [robust.start, State.of(in_the_open.values)], list[Optimum]()
    for attempt in range(ATTEMPTS):
        ways = hypotheses(robust, attempt) + (as_laid if attempt == 0 else [])
        found += [_closely(robust, near) for near in _distinct([_loosely(robust, way) for way in ways])]
        if min(one.surprise for one in found) < expected + STRAINED:
            break
    return [replace(one, unseen=expected + UNSEEN) for one in found]


def _as_fixes_tell(graph: WalkGraph, in_the_open: Optimum) -> list[Optimum]:
    """An optimum for each way that fixes leave open, where that is one but for its end; else none."""
    until = told(graph, in_the_open.net)
    if until is None:
        return []
    last, sigma = until
    first = _closely(graph, _roughly(graph, State.of(in_the_open.values), sigma))
    others = other_ends(first.graph, State.of(first.values), first.net, last)
    return [first, *(_closely(graph, _loosely(graph, way)) for way in others)]


def _roughly(graph: WalkGraph, way: State, sigma: Array) -> Optimum:
    """About the optimum near a way that errs by ``sigma (m,)`` [m], between the loose walls that it may be between."""
    about = graph.following(way, sigma, ALIKE).with_loose_walls(LOOSE).with_closures(FIRM)
    return optimize(about, way.to_values(), ROUGHLY)


def _loosely(graph: WalkGraph, way: State) -> Optimum:
    """The optimum near one way, between the loose walls of the rooms and corridors that it leads through."""
    return optimize(graph.following(way).with_loose_walls(LOOSE).with_closures(FIRM), way.to_values())


def _closely(graph: WalkGraph, near: Optimum) -> Optimum:
    """The optimum from there between the walls as they are, then between those that it has itself."""
    first = optimize(near.graph.with_loose_walls(1 / LOOSE).with_closures(DOUBTED), near.values)
    return _between_own_walls(graph, first)


def _between_own_walls(graph: WalkGraph, first: Optimum) -> Optimum:
    """An optimum, or the one near it between the walls of the rooms and corridors that it has itself."""
    again = graph.following(State.of(first.values))
    return first if again.walls == first.graph.walls else min(first, optimize(again, first.values), key=_surprise)


def _surprise(one: Optimum) -> float:
    return one.surprise


def _distinct(solutions: list[Optimum]) -> list[Optimum]:
    """Different solutions that are not hopeless, the most probable first."""
    kept: list[Optimum] = []
    for one in sorted(solutions, key=lambda s: round(s.surprise, 3)):  # of equals the first: heading 0 with one fix
        track = one.own.ends[:, :2]
        apart = [np.abs(track - other.own.ends[:, :2]).max() for other in kept]
        if all(a > DIFFERENT for a in apart) and (not kept or one.surprise - kept[0].surprise < UNLIKELY):
            kept.append(one)
    return kept
