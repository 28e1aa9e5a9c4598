"""Doubts about the floor plan of a walk: it does not fit, it is displaced, or nothing says where on it the walk was.

A plan may be of another floor, displaced, or lack a door. A walk between its walls then costs more than a right plan
adds to the walk without it. So the walk without walls is a solution too, at a price. If a single position relates the
walk to the plan, neither confirms the other: then the walk may also start some metres from that position.

Without any position, walls and the turns of a walk leave few places for it. Particles start all over the plan, in all
directions (Woodman & Harle 2008, *Pedestrian localisation for indoor environments*, Sec. 4), in several independent
runs, each weighted by its evidence. The modes of their paths are starts of the graph, which solves and weighs them like
any other paths. The particles that belong to no solution say how probable another place is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pdr_graph.estimation.ambiguity.bank import HypothesisBank, pruned, weighed
from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Wording, wording_of
from pdr_graph.estimation.ambiguity.path_modes import (
    FILTER_RUNS,
    best_without_walls,
    different_directions,
    mode_starts,
    near_walk,
    solutions,
    solutions_near,
    sought_starts,
)
from pdr_graph.estimation.factors.start import WALKER_KIND
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import Optimum, optimize
from pdr_graph.estimation.particle_filter import ParticleFilter, Paths, advance_through, pose_costs
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import ANY_HEADING
from pdr_graph.priors import ANYWHERE, DOUBTS, PRICES, SEARCH
from pdr_graph.types import Array

PLAN_KIND = "plan"  # the kind of hypotheses about it
RUNS_ANYWHERE, MOST_ANYWHERE = 2, 200_000  # independent runs: one may lose the right place; most particles of each
PATHS_KEPT, MOST_DRAWN = 5000, 2000  # paths of each; of them, and places on the plan, that stand for all
MOST_STORED = 10_000_000  # particles times keyframes of a run: half a gigabyte, if a walk fits everywhere


@wording_of(PLAN_KIND)
def _wording(hypothesis: Hypothesis) -> Wording:
    """The plan does not fit, or is displaced."""
    text = "the floor plan does not fit the walk and the positions on it"
    if hypothesis.kind[1] == "displaced":
        text = f"the floor plan, or the only position on it, is displaced by about {hypothesis.parameter[0]:.0f} m"
    check = "the floor plan (another floor, displaced, a door missing?) and the positions on it (start, fixes)"
    return Wording(PLAN_KIND, text, check)


def joint_solutions(graph: WalkGraph) -> list[Optimum]:
    """Distinct solutions under all hypotheses about sources that remain, the most probable first.

    With a plan, what the other sources get wrong is explained along the walk without its walls; each such walk is then
    a walk between the walls, or the plan does not fit.
    """
    if not graph.walled:
        first, *others = solutions(graph)
        bank = HypothesisBank(first).explain()
        bank.add(others, SEARCH.dropped)
        return bank.members
    sought = sought_starts(graph.without_plan())
    free = HypothesisBank(best_without_walls(graph, sought)).explain().members
    best, *others = free

    # Between the walls: on each path for the best walk without walls, then near each other one
    first, *more = solutions(graph, best, sought)
    between = [_assuming(walk, best) for walk in (first, *more)]
    strangers = [other for other in others if _by_profile(other) != _by_profile(best)]
    for other in strangers[:1]:  # other strides fit other paths
        between += [_assuming(walk, other) for walk in solutions(graph, other, sought)]
    for other in others:
        same_path = float(np.hypot(*(other.at.ends[:, :2] - best.at.ends[:, :2]).T).mean()) < SEARCH.same_path
        between.append(_assuming(near_walk(graph, other, first.state if same_path else None), other))
    by_walls = _measurements_by_walls(between[0])
    placing = [kind for kind in graph.measurements if kind.determines_position]
    single = placing == [graph.positions] and np.count_nonzero(graph.positions.used) == 1
    if single:
        between += _displaced(graph, best)

    # If the plan does not fit: in each direction if the other sources do not determine it
    for other in free:
        walks = different_directions(other)
        for walk in walks:
            price = max(PRICES.wrong_plan, PRICES.added_by_walls * (by_walls + walk.cost))
            wrong = Hypothesis((PLAN_KIND, "wrong"), price=price + float(np.log(len(walks))))
            between.append(_assuming(replace(walk, burden=0.0), other, wrong))
    return pruned(between)


def _by_profile(walk: Optimum) -> bool:
    """True if the walk is not assumed to be that of another walker."""
    return all(claim.kind[0] != WALKER_KIND for claim in walk.assumed)


def _assuming(walk: Optimum, free: Optimum, *hypotheses: Hypothesis) -> Optimum:
    """A walk with the hypotheses of the walk ``free`` without walls, and more."""
    return weighed(replace(walk, unseen=np.inf), free, *hypotheses)


def _measurements_by_walls(optimum: Optimum) -> float:
    """The number of independent measurements that the walls amount to: tr(J Σ Jᵀ) over the steps that they press.

    It grows with the corridors walked through, and what right walls add to the cost grows with it: a walk errs anew
    between two corridors. J: whitened derivatives; Σ: covariance of the walk between the walls.
    """
    total = 0.0
    for block in optimum.at.blocks_of(optimum.graph.walls.name):
        J = np.hstack(block.weighted[1])[:, None]
        of_rows = [(symbol, rows[block.row_of]) for symbol, rows in block.variables]
        total += float(np.sum((J @ optimum.solution.joint(*of_rows)) * J))
    return total


def _displaced(graph: WalkGraph, free: Optimum) -> Iterator[Optimum]:
    """Walks between the walls that start some metres from the only fix: it is misplaced, or the plan by as much."""
    positions = free.graph.positions
    wide = free.graph.assuming((positions.misplaced(DOUBTS.misplaced),))
    wrong = Hypothesis((PLAN_KIND, "wrong"), price=PRICES.displaced_plan + float(np.log(2)))  # it, or the position
    for walk in solutions(graph, optimize(wide, free.state)):
        fix = int(np.argmax(positions.used))
        by = positions.fixes.position[fix] - walk.state.poses[positions.keyframe[fix], :2]
        displaced = Hypothesis((PLAN_KIND, "displaced"), parameter=(float(np.round(np.hypot(*by))),))
        for place in (walk, _moved(walk, by, free.graph)):
            yield _assuming(place, free, wrong, displaced)


def _moved(walk: Optimum, by: Array, graph: WalkGraph) -> Optimum:
    """A walk moved by ``by (2,)`` [m] together with its walls, as probable as before. graph: without walls."""
    state = walk.state.replaced(x=walk.state.poses + np.append(by, 0.0))
    at = graph.evaluate(state)
    return replace(walk, graph=graph, at=at, burden=walk.surprise - at.surprise)


@dataclass(frozen=True)
class Localization:
    """Where a walk can have been.

    optima: the solutions, the most probable first; elsewhere: probability of another place; evidence: logarithm of the
    probability of the steps on this floor; anywhere: ``(n, 2)`` other places [m].
    """

    optima: list[Optimum]
    elsewhere: float = 0.0
    evidence: float = 0.0
    anywhere: Array = field(default_factory=lambda: np.empty((0, 2)))

    def covariance(self, poses: Array, of_optima: Array) -> Array:
        """Covariance ``(n, 3, 3)`` about ``poses (n, 3)``, if ``of_optima (n, 3, 3)`` is that of the solutions."""
        if not self.elsewhere:
            return of_optima
        apart = self.anywhere.mean(axis=0) - poses[:, :2]
        another = np.zeros_like(of_optima)
        another[:, :2, :2] = np.cov(self.anywhere.T) + apart[:, :, None] * apart[:, None, :]
        another[:, 2, 2] = ANY_HEADING**2
        return (1.0 - self.elsewhere) * of_optima + self.elsewhere * another


def begun_on(graphs: Sequence[WalkGraph]) -> tuple[WalkGraph, Localization]:
    """The graph of the floor where a walk most probably began, and its solutions.

    graphs: of the same walk, begun on each floor; `unplaced`.
    """
    found = [localized(graph) for graph in graphs]
    evidence = np.array([one.evidence + np.log(_floor(g).walkable_area) for g, one in zip(graphs, found, strict=True)])
    best = int(np.argmax(evidence))
    share = float(np.exp(evidence[best] - np.logaddexp.reduce(evidence)))
    return graphs[best], replace(found[best], elsewhere=1.0 - share * (1.0 - found[best].elsewhere))


def localized(graph: WalkGraph) -> Localization:
    """The solutions of a walk on a plan without any position. graph: `unplaced`."""
    free = graph.without_plan()
    runs, optima = list[tuple[Paths, float]](), list[Optimum]()
    state, weight = np.empty(0), np.empty(0)
    for attempt in range(FILTER_RUNS):
        runs += [particles_anywhere(free, RUNS_ANYWHERE * attempt + n, 2**attempt) for n in range(RUNS_ANYWHERE)]

        # The paths of all runs, weighted by their evidence; starts on the modes of some drawn from them
        evidence = np.array([logarithm for _, logarithm in runs])
        share = np.exp(evidence - np.logaddexp.reduce(evidence))
        state = np.concatenate([paths.state for paths, _ in runs], axis=2)
        weight = np.concatenate([s * paths.weight for s, (paths, _) in zip(share, runs, strict=True)])
        count = min(MOST_DRAWN, len(weight))
        drawn = np.random.default_rng(0).choice(len(weight), count, p=weight / weight.sum())
        some = Paths(state[:, :, drawn], np.full(count, 1.0 / count))
        optima = solutions_near(graph, mode_starts(graph, some))
        if not SEARCH.strained <= optima[0].surprise < SEARCH.dropped:
            break  # it fits, or no walk on this plan does

    # The share of the paths near a solution
    near = np.zeros(len(weight), dtype=bool)
    for optimum in optima:
        apart = state[:, :2] - optimum.state.poses[:, :2, None]
        near |= np.hypot(apart[:, 0], apart[:, 1]).mean(axis=0) < SEARCH.same_path
    evidence = float(np.logaddexp.reduce([logarithm for _, logarithm in runs]) - np.log(len(runs)))
    anywhere = _floor(graph).random_places(MOST_DRAWN, np.random.default_rng(0))
    optima = [replace(optimum, unseen=PRICES.wrong_plan) for optimum in optima]
    return Localization(optima, max(0.0, 1.0 - float(weight[near].sum())), evidence, anywhere)


def particles_anywhere(graph: WalkGraph, seed: int, times: int = 1) -> tuple[Paths, float]:
    """The paths of particles that start all over the plan, and their log evidence.

    graph: without walls; times: multiple of the usual number of particles.
    """
    floor = _floor(graph)
    area = floor.walkable_area
    most = min(ANYWHERE.most_density * area, MOST_ANYWHERE, MOST_STORED / len(graph.keyframe_time))
    count = times * int(min(max(ANYWHERE.density * area, ANYWHERE.fewest_at_first), most))
    per_bin = ANYWHERE.per_bin * count / area
    particles = ParticleFilter(graph.prior, seed, fewest=ANYWHERE.fewest, most=count, per_bin=per_bin)
    particles.begin_anywhere(floor, pose_costs(graph.measurements, 0))
    advance_through(particles, graph, 0)
    return particles.paths(PATHS_KEPT), particles.evidence


def _floor(graph: WalkGraph) -> FloorPlan:
    """The floor where the walk begins."""
    sequence = graph.floor_sequence
    assert sequence is not None, "asked for with a plan"
    return sequence.building.floors[sequence.level[0]]
