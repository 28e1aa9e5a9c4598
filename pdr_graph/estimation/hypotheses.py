"""Joint hypotheses about what the sources of a walk get wrong, each solved and weighed by its evidence.

A source may err beyond what it states: two beacons of a list are swapped, a receiver is several times worse than it
says. No robust loss helps where its measurements agree with one another. So each kind of measurement proposes
assumptions about itself (`Doubted.hypotheses`), combinations of them are solved, and each is weighed by Laplace's
approximation of its evidence (MacKay, *Information Theory, Inference, and Learning Algorithms*, Ch. 28),

    −log p(z | H) − log p(H) = cost + log |R| + price,      RᵀR the information matrix at the optimum

in which constants that all share are left out. The walk is the best; the others widen its covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.contradiction import Contradiction
from pdr_graph.errors import percent
from pdr_graph.estimation.changed_prior import with_changed_prior
from pdr_graph.estimation.factors.base import Hypothesis, State
from pdr_graph.estimation.factors.protocols import Doubted, Listed
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import Optimum, continued, optimize, solutions, solve_robust
from pdr_graph.estimation.wrong_plan import solutions_on_plan
from pdr_graph.types import Array

PROBABLE = 0.5  # probability above which a user is told what a source gets wrong
UNLIKELY = 5.0  # [nats] above the best at which an assumption is dropped: 0.7 %


def joint_solutions(graph: WalkGraph) -> list[Optimum]:
    """Distinct solutions under all assumptions about sources that remain, the most probable first.

    With a plan, what the other sources get wrong is explained along the walk without its walls.
    """
    if not graph.walled:
        optima = solutions(graph)
        return sorted([*explanations(optima[0]), *optima[1:]], key=lambda optimum: optimum.surprise)
    return solutions_on_plan(graph, explanations(solve_robust(graph.without_plan())))


def contradictions(optima: list[Optimum], probability: Array) -> tuple[Contradiction, ...]:
    """What the sources probably get wrong. probability: ``(n,)`` of each solution, up to a factor."""
    assumed = {hypothesis.text: hypothesis for optimum in optima for hypothesis in optimum.assumed if hypothesis.check}
    found = []
    for text, hypothesis in assumed.items():
        holds = np.array([any(other.text == text for other in optimum.assumed) for optimum in optima])
        share = float(probability[holds].sum() / probability.sum())
        if share > PROBABLE:
            text = f"{text} (probability {percent(share)})"
            against = "the steps and the other sources"
            found.append(
                Contradiction(hypothesis.source, against, round(share, 3), "probability", text, hypothesis.check)
            )
    return tuple(found)


def explanations(first: Optimum) -> list[Optimum]:
    """The walk near ``first`` under the joint assumptions that remain, the most probable first.

    Kind by kind, assumptions are added to those of the best walk so far, or made instead of them.
    """
    known = [first]
    for name in [kind.name for kind in first.graph.measurements]:
        bases = [known[0]] if known[0] is first else [known[0], first]
        known = _likely([*known, *(new for base in bases for new in _alternatives(base, name, first))])
    return known


def _alternatives(old: Optimum, name: str, first: Optimum) -> list[Optimum]:
    """The walk under each assumption about a kind that is promising along ``old``, or along the walk by the others."""
    kind = next(kind for kind in old.graph.measurements if kind.name == name)
    if not isinstance(kind, Doubted):
        return []
    fixes = old.graph.positions
    placed = fixes.used.any() and not fixes.approximate
    proposals = [
        (hypothesis, old.state) for hypothesis in kind.hypotheses(old.at) if placed or not hypothesis.place_lost
    ]
    if placed and (isinstance(kind, Listed) or any(hypothesis.apart for hypothesis, _ in proposals)):
        others = optimize(without := old.graph.without(kind), without.start).at
        proposals += [(new, others.state) for new in kind.hypotheses(others) if proposals]
        by = np.mean(others.state.poses[:, :2] - old.state.poses[:, :2], axis=0)
        displaced = kind.displaced(by) if isinstance(kind, Listed) else None
        proposals += [(new, others.state) for new in [displaced] if new is not None]
    best = dict[str, Optimum]()
    for hypothesis, start in proposals:
        new = _assuming(old, hypothesis, start, first)
        if hypothesis.text not in best or new.surprise < best[hypothesis.text].surprise:
            best[hypothesis.text] = new
    return list(best.values())


def _assuming(old: Optimum, hypothesis: Hypothesis, start: State, first: Optimum) -> Optimum:
    """The optimum near ``start`` under one more assumption than ``old``."""
    graph = old.graph.assuming(hypothesis.measurements)
    start = continued(graph.start, start, hypothesis.fresh)
    optimum = with_changed_prior(old, graph, start, hypothesis.prior) if hypothesis.prior else None
    optimum = optimum or optimize(graph, start)
    information = optimum.solution.log_determinant - first.solution.log_determinant
    assumed = (*old.assumed, hypothesis)
    burden = information + sum(hypothesis.price for hypothesis in assumed)
    return replace(optimum, assumed=assumed, burden=burden, unseen=first.unseen)


def _likely(optima: list[Optimum]) -> list[Optimum]:
    """Those within UNLIKELY of the best, the most probable first."""
    ordered = sorted(optima, key=lambda optimum: optimum.surprise)
    return [optimum for optimum in ordered if optimum.surprise - ordered[0].surprise < UNLIKELY]
