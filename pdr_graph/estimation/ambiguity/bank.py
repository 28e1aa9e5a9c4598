"""The bank of doubts: solutions of a walk under joint hypotheses about its sources, weighed by their evidence.

A source may err beyond what it states: two beacons of a list are swapped, a receiver is several times worse than it
says, a plan is of another floor. No robust loss helps where its measurements agree with one another. So each kind of
measurement proposes hypotheses about itself (`Doubted.hypotheses`), combinations of them are solved, and each is
weighed by Laplace's approximation of its evidence (MacKay, *Information Theory, Inference, and Learning Algorithms*,
Ch. 28),

    −log p(z | H) − log p(H) = cost + log |R| + price,      RᵀR the information matrix at the optimum

in which constants that all share are left out. The walk is the best; the others widen its covariance. What is much less
probable than the best is pruned. Batch and live use the same bank; that of a live walk also remembers what was adopted
(`HypothesisBank.remember`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.errors import percent
from pdr_graph.estimation.ambiguity.hypothesis import Hypothesis, Proposal
from pdr_graph.estimation.factors.base import AnyArray, Doubted, decisions_of
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.start import WALKER_KIND
from pdr_graph.estimation.optimizer import Optimum, continued, on_ways, optimize, solve_robust
from pdr_graph.priors import DOUBTS, SEARCH
from pdr_graph.types import Array, Contradiction, Index

SAME_SOLUTION = 0.5  # [m] largest distance at any step of two walks that are one
LEAST_LOGARITHM = -300.0  # of a probability: its square is not 0; a walk that fits nothing is still the best there is


@dataclass(frozen=True)
class Findings:
    """What a review of a walk found: the adopted hypotheses, and all that remain possible.

    contradictions: what sources probably get wrong; warnings: what else they leave open.
    """

    adopted: tuple[Hypothesis, ...] = ()
    possible: tuple[Hypothesis, ...] = ()
    contradictions: tuple[Contradiction, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def changes(self) -> frozenset[str]:
        """The names of the measurement kinds that the adopted hypotheses change."""
        return frozenset(name for claim in self.adopted for name in claim.changes)

    def same_decisions(self, other: Findings) -> bool:
        """True if both adopt the same hypotheses, of the same size."""
        mine, theirs = ({(claim, claim.parameter) for claim in each.adopted} for each in (self, other))
        return mine == theirs


class HypothesisBank:
    """Solutions of one walk under joint hypotheses.

    first: without any; members: the most probable first; numbers: permanent numbers of rows, by kind of measurement;
    recalled: the member under adopted hypotheses that no source suggests any more.
    """

    def __init__(self, first: Optimum, numbers: Mapping[str, Index] | None = None):
        self.first, self.members, self.recalled = first, [first], None
        self._numbers = numbers or {}

    def explain(self) -> HypothesisBank:
        """Add the walk near ``first`` under each joint hypothesis that remains.

        Kind by kind, hypotheses are added to those of the best walk so far, or made instead of them. Of a walk that is
        solved from two starts, the better solution remains.
        """
        names = [kind.name for kind in self.first.graph.measurements]
        for name in sorted(names, key=lambda name: name != WALKER_KIND):  # a wrong profile accuses the rest
            best, new = self.members[0], list[Optimum]()
            for base in [best] if best is self.first else [best, self.first]:
                solved = dict[tuple[Hypothesis, tuple[float, ...]], Optimum]()
                for proposal in self.propose(base, name):
                    claim, optimum = (proposal.hypothesis, proposal.hypothesis.parameter), self.solve(base, proposal)
                    solved[claim] = min(solved.get(claim, optimum), optimum, key=lambda each: each.surprise)
                new += solved.values()
            self.add(new, DOUBTS.unlikely)
        return self

    def add(self, optima: Iterable[Optimum], within: float) -> None:
        """Add members, and prune all that are not within some nats of the best."""
        self.members = pruned([*self.members, *optima], within)

    def propose(self, base: Optimum, name: str) -> Sequence[Proposal]:
        """What may be wrong with one kind of measurement along ``base``, or along the walk by the others alone."""
        kind = next(kind for kind in base.graph.measurements if kind.name == name)
        fixes = base.graph.positions
        placed = fixes.used.any() and not fixes.approximate

        def by_others() -> Evaluation:
            without = base.graph.without(kind)
            return optimize(without, without.start).at

        return kind.hypotheses(base.at, by_others if placed else None) if isinstance(kind, Doubted) else ()

    def solve(self, base: Optimum, proposal: Proposal) -> Optimum:
        """The optimum under one more hypothesis than ``base``."""
        changes, hypothesis = tuple(kind.name for kind in proposal.measurements), proposal.hypothesis
        if proposal.another_walker:
            optimum = solve_robust(base.graph.by_another_walker(base.state))
            hypothesis = replace(hypothesis, estimate=tuple(optimum.state.c.mean(axis=0)[:2].tolist()))
        else:
            graph = base.graph.assuming(proposal.measurements)
            before = continued(graph.start, proposal.start or base.state, proposal.fresh)
            optimum = optimize(graph, graph.start if proposal.anew else before)
            if all(kind is not graph.ways for kind in proposal.measurements):
                optimum = on_ways(optimum, free=False)
        hypothesis = replace(hypothesis.numbered(self._numbers), changes=changes)
        information = optimum.solution.log_determinant - base.solution.log_determinant
        return weighed(replace(optimum, unseen=self.first.unseen), base, hypothesis, information=information)

    def remember(self, before: Findings, decisions: Mapping[str, Mapping[str, AnyArray]]) -> None:
        """Count the evidence from before the data of this walk, and put first the member that is to be adopted.

        Adopted hypotheses are kept until evidence speaks against them. It supports as much what competed with them:
        often it says only that one of two sources is wrong. decisions: about the kinds that the adopted change.
        """
        adopted = frozenset(before.adopted)
        kept = [frozenset(lasting(member.assumed)) == adopted for member in self.members]
        if not kept[0]:
            for n, member in enumerate(self.members):
                if (claims := lasting(member.assumed)) and set(claims) <= set(before.possible):
                    older = min(self._older(claims), self._older(before.adopted))
                    self.members[n] = replace(member, burden=member.burden - older)
        if adopted and not any(kept):
            graph = self.first.graph.decided(decisions)
            optimum = replace(optimize(graph, graph.start), unseen=self.first.unseen)
            information = optimum.solution.log_determinant - self.first.solution.log_determinant
            held = weighed(optimum, self.first, *before.adopted, information=information)
            self.recalled = replace(held, burden=held.burden - self._older(before.adopted))
            self.members, kept = [*self.members, self.recalled], [*kept, True]
        lead = np.array([member.surprise for member in self.members]) - DOUBTS.lead * np.array(kept)
        for n, member in enumerate(self.members):  # a walk under way can adopt changes of kinds that have decisions
            changed = {name for hypothesis in member.assumed for name in hypothesis.changes}
            if not all(decisions_of(kind) for kind in member.graph.measurements if kind.name in changed):
                lead[n] = np.inf
        self.members = [self.members[n] for n in np.argsort(lead, kind="stable").tolist()]

    @property
    def findings(self) -> Findings:
        """The hypotheses of the first member, and those that remain possible."""
        best, least = self.members[0], min(member.surprise for member in self.members)
        possible = [member for member in self.members if member is best or member.surprise < least + DOUBTS.unlikely]
        every = dict.fromkeys(claim for member in possible for claim in lasting(member.assumed))
        return Findings(lasting(best.assumed), tuple(every))

    def _older(self, hypotheses: Iterable[Hypothesis]) -> float:
        """What older evidence says for hypotheses [nats]; nothing where all that they are about is in the data."""
        older = 0.0
        for claim in hypotheses:
            rows = [n for n in claim.instances if isinstance(n, int)]
            present = np.isin(rows, self._numbers.get(claim.kind[0], ())).all()
            older += 0.0 if present and len(rows) == len(claim.instances) > 0 else DOUBTS.older
        return older


def lasting(hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """The hypotheses that hold for a whole walk."""
    return tuple(claim for claim in hypotheses if claim.lasting)


def weighed(optimum: Optimum, base: Optimum, *hypotheses: Hypothesis, information: float = 0.0) -> Optimum:
    """An optimum under more hypotheses than ``base``, with their evidence.

    information: log |R| in addition to that of the base [nats].
    """
    price = sum(hypothesis.price for hypothesis in hypotheses)
    burden = optimum.burden + base.burden + information + price
    return replace(optimum, assumed=(*base.assumed, *hypotheses), burden=burden)


def pruned(optima: Iterable[Optimum], within: float | None = None) -> list[Optimum]:
    """Distinct solutions within some nats of the best, by default those of other paths, the most probable first.

    Of equal solutions the first is first: it has heading 0 if a walk has one fix.
    """
    kept, within = list[Optimum](), SEARCH.dropped if within is None else within

    def same(one: Optimum, other: Optimum) -> bool:
        """True if two solutions assume the same, and lead along the same path."""
        claims = [[(claim, claim.parameter) for claim in optimum.assumed] for optimum in (one, other)]
        apart = one.at.ends[:, :2] - other.at.ends[:, :2]
        return claims[0] == claims[1] and float(np.abs(apart).max()) <= SAME_SOLUTION

    for new in sorted(optima, key=lambda optimum: round(optimum.surprise, 3)):
        if kept and new.surprise - kept[0].surprise >= within:
            break
        if not any(same(new, other) for other in kept):
            kept.append(new)
    return kept


def probabilities(optima: Sequence[Optimum], path: Index) -> Array:
    """Probabilities ``(n,)`` of different solutions, by their negative log posterior.

    path: ``(n,)`` see `paths`; solutions on one path share the weight of the best. The remainder to 1 is the
    probability of paths that the search missed; it grows with the excess of the best cost over the usual cost. On
    simulated walks (docs/results/routes.md shows others) cost and price need no scale; the curvature at a
    solution (Laplace's approximation) and the number of particles on its path add no information.
    """
    surprise = np.array([optimum.surprise for optimum in optima])
    least = min(surprise.min(), optima[0].unseen)
    weight, together = np.exp(np.maximum(least - surprise, LEAST_LOGARITHM)), path[:, None] == path
    weight = weight * np.max(weight * together, axis=1) / (together @ weight)
    return weight / (weight.sum() + np.exp(least - optima[0].unseen))


def paths(optima: Sequence[Optimum]) -> Index:
    """The path of each solution ``(n,)``: index of the first solution within SEARCH.same_path of it on average.

    Without walls, a walk and the same walk by another walker are the same path.
    """
    tracks = np.array([optimum.at.ends[:, :2] for optimum in optima])
    near = np.hypot(*(tracks[:, None] - tracks).transpose(3, 0, 1, 2)).mean(axis=2) < SEARCH.same_path
    for n, m in zip(*np.nonzero(~near), strict=True):
        apart = {claim.kind[0] for claim in set(optima[n].assumed) ^ set(optima[m].assumed)}
        near[n, m] = apart == {WALKER_KIND} and not optima[n].graph.walled
    return np.argmax(near, axis=1)


def contradictions(optima: Sequence[Optimum], probability: Array) -> tuple[Contradiction, ...]:
    """What the sources probably get wrong. probability: ``(n,)`` of each solution, up to a factor."""
    found = []
    for claim in dict.fromkeys(claim for optimum in optima for claim in optimum.assumed):
        share = float(probability[[claim in optimum.assumed for optimum in optima]].sum() / probability.sum())
        words = claim.wording
        if share > 0.5 and words.check:
            text = f"{words.text} (probability {percent(share)})"
            against = "the steps and the other sources"
            found.append(Contradiction(words.source, against, round(share, 3), "probability", text, words.check))
    return tuple(found)
