"""Review of a walk under way: what its sources get wrong, by the batch's joint hypotheses over its recent past.

A review solves the last minutes of the walk under each hypothesis (`explanations`). The window adopts the decisions
of the best (which beacons are where, how far off a receiver is); the others widen the covariance that is stated.

A hypothesis holds for the whole walk. Its evidence may be older than the history, so one that was adopted is kept until
evidence speaks against it. Often that evidence says only that one of two sources is wrong: then it supports what
competed with the adopted hypothesis as much, and that stays possible.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pdr_graph.contradiction import Contradiction
from pdr_graph.estimation.factors.base import Hypothesis, poses_at
from pdr_graph.estimation.factors.protocols import decisions_of
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.hypotheses import contradictions, explanations
from pdr_graph.estimation.live.measurement_log import Decisions, numbered
from pdr_graph.estimation.optimizer import Optimum, optimize, paths, probabilities, solve_robust
from pdr_graph.geometry import differences, interpolate, nearest, pose_rotation, rotation
from pdr_graph.types import Array, Index

LEAD = 1.0  # [nats] by which other assumptions must be better than those adopted; chosen by hand
KEPT = 8.0  # [nats] the same per adopted assumption: its price, 5.5, and 2.5 of evidence that may be older
PLAIN = 3.0  # [nats] by which a first assumption must be better than none: it is kept for long; chosen by hand
LIKELY = 0.01  # probability from which an assumption remains possible; chosen by hand
SPACING = 10.0  # [s] between the times at which the covariance of a review is computed


@dataclass(frozen=True)
class Excess:
    """Covariance ``(n, 3, 3)`` at times ``(n,)`` [s] to add to that of the solver, in the output axes."""

    time: Array
    covariance: Array

    @classmethod
    def none(cls) -> Excess:
        """Nothing to add."""
        return cls(np.zeros(1), np.zeros((1, 3, 3)))

    def at(self, time: Array) -> Array:
        """The covariances ``(n, 3, 3)`` at times ``(n,)`` [s]; constant before the first and after the last."""
        return interpolate(time, self.time, self.covariance.reshape(-1, 9)).reshape(-1, 3, 3)


@dataclass(frozen=True)
class Assumption:
    """An adopted `Hypothesis`, with the names of its kinds instead of the measurements."""

    kinds: tuple[str, ...]
    price: float
    source: str
    text: str
    check: str

    @classmethod
    def of(cls, hypothesis: Hypothesis) -> Assumption:
        """The assumption of a hypothesis."""
        names = tuple(kind.name for kind in hypothesis.measurements)
        return cls(names, hypothesis.price, hypothesis.source, hypothesis.text, hypothesis.check)

    def hypothesis(self, graph: WalkGraph) -> Hypothesis:
        """The hypothesis about the measurements of ``graph``, which has the decisions."""
        kinds = tuple(kind for kind in graph.measurements if kind.name in self.kinds)
        return Hypothesis(kinds, self.price, self.source, self.text, self.check)


@dataclass(frozen=True)
class Findings:
    """What a review found.

    assumed: the adopted assumptions; contradictions: what sources probably get wrong; rivals: the texts, without
    how far off a source is, of all assumptions that remain possible.
    """

    assumed: tuple[Assumption, ...] = ()
    contradictions: tuple[Contradiction, ...] = ()
    rivals: tuple[str, ...] = ()

    added: ClassVar = ("rivals",)

    @property
    def texts(self) -> frozenset[str]:
        """The texts of the adopted assumptions."""
        return frozenset(assumption.text for assumption in self.assumed)

    @property
    def kinds(self) -> frozenset[str]:
        """The names of the kinds that the assumptions are about."""
        return frozenset(name for assumption in self.assumed for name in assumption.kinds)


@dataclass(frozen=True)
class Review:
    """What joint hypotheses say of the recent past of a walk.

    findings, decisions: to adopt, of the best walk; time: ``(k,)`` of its keyframes [s], pose: ``(k, 3)``; begins:
    ``(s,)`` of its calibrations [s], c: ``(s, 3)``; excess: for the covariance that is stated, by the other walks that
    remain, none under a plan; None if that of the review before holds.
    """

    findings: Findings
    decisions: Decisions
    time: Array
    pose: Array
    begins: Array
    c: Array
    excess: Excess | None

    def poses(self, time: Array, pose: Array) -> Array:
        """Poses ``(n, 3)`` of the best walk at times ``(n,)`` [s].

        Those from before the recent past are ``pose (n, 3)``, moved rigidly with its beginning; those after its end
        with its end.
        """
        there = poses_at(time, self.time, self.pose)
        for beyond, edge in ((time < self.time[0], 0), (time > self.time[-1], -1)):
            if beyond.any():
                (old,), new = poses_at(self.time[[edge]], time, pose), self.pose[edge]
                turn = new[2] - old[2]
                there[beyond, :2] = (pose[beyond, :2] - old[:2]) @ rotation(turn).T + new[:2]
                there[beyond, 2] = pose[beyond, 2] + turn
        return there

    def calibration(self, time: float) -> Array:
        """(R_s, R_d, b) ``(3,)`` of the best walk at a time [s]."""
        return self.c[max(int(np.searchsorted(self.begins, time)) - 1, 0)]


@dataclass(frozen=True)
class Question:
    """A review that is due.

    graph: builds that of the recent past, without its plan; before: what the last review found; decisions: about the
    kinds that this adopted, by row of the graph's data; walled: the walk has a plan, for which no other walk is added;
    numbers: permanent numbers of the rows, by kind: some may be dropped before the answer is used.
    """

    graph: Callable[[], WalkGraph]
    before: Findings
    decisions: Decisions
    walled: bool
    numbers: dict[str, Index] = field(default_factory=dict)

    def answer(self) -> Review:
        """The review."""
        optima, kept = self._optima()
        probability, best = probabilities(optima, paths(optima)), optima[0]
        possible = [one for one, p in zip(optima, probability.tolist(), strict=True) if one is best or p > LIKELY]
        rivals = tuple(sorted({_sizeless(h.text) for one in possible for h in one.assumed}))
        found = Findings(tuple(Assumption.of(h) for h in best.assumed), contradictions(optima, probability), rivals)
        excess = Excess.none() if self.walled else _excess(optima, probability / probability.sum())
        if best is kept:  # no source says more about it than before
            found, excess = self.before, excess if self.walled else None
        kinds, chain = self.before.kinds | found.kinds, best.at.chain
        decisions = {kind.name: decisions_of(kind) for kind in best.graph.measurements if kind.name in kinds}
        return Review(
            findings=found,
            decisions={name: numbered(rows, self.numbers.get(name)) for name, rows in decisions.items()},
            time=chain.time,
            pose=best.state.poses,
            begins=chain.time[chain.segment_first],
            c=best.state.c,
            excess=excess,
        )

    def _optima(self) -> tuple[list[Optimum], Optimum | None]:
        """The walks that remain; first the best, or that under the adopted assumptions if it is about as good.

        Also the latter, if no source suggests it any more.
        """
        plain = solve_robust(self.graph())
        optima = explanations(plain)
        adopted = [n for n, one in enumerate(optima) if _texts(one) == self.before.texts]
        if adopted[:1] != [0]:
            optima = [self._supported(one) for one in optima]
        kept = self._kept(plain) if self.before.assumed and not adopted else None
        if kept is not None:
            optima, adopted = [*optima, kept], [len(optima)]
        held = [LEAD if n in adopted else 0.0 if one.assumed else PLAIN for n, one in enumerate(optima)]
        lead = [one.surprise - h if _adoptable(one) else np.inf for one, h in zip(optima, held, strict=True)]
        return [optima[n] for n in np.argsort(lead, kind="stable").tolist()], kept

    def _supported(self, one: Optimum) -> Optimum:
        """A walk with what older evidence says for its assumptions: the adopted ones, and what competed with them."""
        known = bool(one.assumed) and all(_sizeless(h.text) in self.before.rivals for h in one.assumed)
        older = KEPT * min(len(one.assumed), len(self.before.assumed)) if known else 0.0
        return replace(one, burden=one.burden - older)

    def _kept(self, plain: Optimum) -> Optimum:
        """The walk under the adopted assumptions, although no source suggests them. plain: that without any."""
        decided = plain.graph.decided(self.decisions)
        optimum = optimize(decided, decided.start)
        assumed = tuple(assumption.hypothesis(optimum.graph) for assumption in self.before.assumed)
        information = optimum.solution.log_determinant - plain.solution.log_determinant
        burden = information + sum(hypothesis.price for hypothesis in assumed) - KEPT * len(assumed)
        return replace(optimum, assumed=assumed, burden=plain.burden + burden, unseen=plain.unseen)


def _sizeless(text: str) -> str:
    """A text without how far off a source is, which differs from one review to the next; names keep their digits."""
    return re.sub(r"(?<=about )\d+|\d+(?= times)", "#", text)


def _texts(optimum: Optimum) -> frozenset[str]:
    return frozenset(hypothesis.text for hypothesis in optimum.assumed)


def _adoptable(optimum: Optimum) -> bool:
    """True if a window can adopt all assumptions: their kinds have decisions."""
    kinds = {kind.name for hypothesis in optimum.assumed for kind in hypothesis.measurements}
    return all(decisions_of(kind) for kind in optimum.graph.measurements if kind.name in kinds)


def _excess(optima: list[Optimum], weight: Array) -> Excess:
    """What the covariance of the first walk lacks to that of all, with weights; negative parts are left out."""
    chain = optima[0].at.chain
    time = np.arange(chain.time[-1], chain.time[0], -SPACING)[::-1]
    poses, solved = _keyframes(optima[0], time)
    total = np.zeros_like(solved)
    for share, optimum in zip(weight[1:].tolist(), optima[1:], strict=True):
        there, covariance = _keyframes(optimum, time)
        apart = differences(there, poses)
        total += share * (covariance - solved + apart[:, :, None] * apart[:, None, :])
    value, vector = np.linalg.eigh(total)
    return Excess(time, (vector * np.maximum(value, 0.0)[:, None, :]) @ vector.transpose(0, 2, 1))


def _keyframes(optimum: Optimum, time: Array) -> tuple[Array, Array]:
    """Poses ``(n, 3)`` of a solution at times ``(n,)`` [s], and covariances ``(n, 3, 3)`` of the nearest keyframes."""
    chain, poses = optimum.at.chain, optimum.state.poses
    which = nearest(chain.time, time)
    R = pose_rotation(poses[which, 2])
    spread = R @ optimum.solution.joint(("x", which)) @ R.transpose(0, 2, 1)
    return poses_at(time, chain.time, poses), spread
