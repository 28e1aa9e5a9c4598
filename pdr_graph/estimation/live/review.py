"""Doubts of a walk under way: what its sources get wrong in its recent past, and where on its plan it may be.

A review solves the last minutes of the walk in the batch's bank. The window adopts the decisions of the best member
(which beacons are where, how far off a receiver is); the others widen the covariance that is stated. A hypothesis holds
for the whole walk, and its evidence may be older than the history: see `HypothesisBank.remember`.

A walk without any position is sought on the whole plan (`localized`), again and again while it goes on. Until one place
is certain, its solutions are the modes that remain; then that place is a fix and a heading like any others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.estimation.ambiguity.bank import Findings, HypothesisBank, contradictions, paths, probabilities
from pdr_graph.estimation.ambiguity.plan_hypotheses import localized
from pdr_graph.estimation.factors.base import AnyArray, decisions_of, poses_at
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.live.finalization import Excess, moved
from pdr_graph.estimation.live.live_output import modes_at_end
from pdr_graph.estimation.live.window import Decisions, MeasurementLog, Path, later_steps, numbered, rewound
from pdr_graph.estimation.optimizer import Optimum, solve_robust
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import ANY_HEADING, differences, horizontal_sigma, nearest, pose_rotation
from pdr_graph.inertial.barometer import with_goings
from pdr_graph.priors import DOUBTS, REPORTS
from pdr_graph.types import Array, Fixes, Headings, Index, Steps

if TYPE_CHECKING:
    from pdr_graph.floor.paths import PathNetwork

SOURCE = "plan"  # of the fix and the heading of a place that is certain
COVARIANCES_EVERY = 10.0  # [s] between the times at which the covariance of a review is computed
LEAST = 1e-9  # probability of the solutions together


@dataclass(frozen=True)
class Review:
    """What the bank says of the recent past of a walk.

    findings, decisions: to adopt, of the best walk; path: its keyframes; excess: for the covariance that is stated, by
    the other walks that remain, none under a plan; None if that of the review before holds; ways: those of the
    decisions that are about paths outdoors.
    """

    findings: Findings
    decisions: Decisions
    path: Path
    excess: Excess | None
    ways: Decisions = field(default_factory=dict)

    def poses(self, time: Array, pose: Array) -> Array:
        """Poses ``(n, 3)`` of the best walk at times ``(n,)`` [s].

        Those from before the recent past are ``pose (n, 3)``, moved rigidly with its beginning; those after its end
        with its end.
        """
        path, there = self.path, self.path.poses(time)
        for beyond, edge in ((time < path.time[0], 0), (time > path.time[-1], -1)):
            if beyond.any():
                (old,) = poses_at(path.time[[edge]], time, pose)
                there[beyond] = moved(pose[beyond], old, path.pose[edge])
        return there


def compare_sources(
    graph: Callable[[], WalkGraph],
    before: Findings,
    decisions: Decisions,
    walled: bool,
    numbers: dict[str, Index] | None = None,
) -> Review:
    """What the bank says of the recent past of a walk.

    graph: builds that of the recent past, without its plan; before: what the last review found; decisions: about the
    kinds that this changed, by row of the graph's data; walled: the walk has a plan, for which no other walk is added;
    numbers: permanent numbers of the rows, by kind: some may be dropped before the answer is used.
    """
    numbers = numbers or {}
    bank = HypothesisBank(solve_robust(graph()), numbers).explain()
    bank.remember(before, decisions)
    best, optima = bank.members[0], bank.members
    probability = probabilities(optima, paths(optima))
    doubts, share = contradictions(optima, probability), probability / probability.sum()
    found = replace(bank.findings, contradictions=doubts)
    excess = Excess() if walled else _excess(optima, share)
    if best is bank.recalled:  # no source says more about it than before
        found, excess = before, excess if walled else None
    changed, chain = before.changes | found.changes, best.at.chain
    decided = {kind.name: decisions_of(kind) for kind in best.graph.measurements if kind.name in changed}
    ways = dict[str, dict[str, AnyArray]]()
    if (followed := best.graph.ways) is not None:
        ways = {followed.name: decisions_of(followed)}
        found = replace(found, warnings=followed.warnings())
    return Review(
        findings=found,
        decisions={name: numbered(rows, numbers.get(name)) for name, rows in decided.items()} | ways,
        path=Path(chain.time, best.state.poses, chain.time[chain.segment_first], best.state.c),
        excess=excess,
        ways=ways,
    )


def _excess(optima: list[Optimum], weight: Array) -> Excess:
    """What the covariance of the first walk lacks to that of all, with weights; negative parts are left out."""
    chain = optima[0].at.chain
    time = np.arange(chain.time[-1], chain.time[0], -COVARIANCES_EVERY)[::-1]
    poses, solved = _keyframes(optima[0], time)
    total = np.zeros_like(solved)
    for share, optimum in zip(weight[1:].tolist(), optima[1:], strict=True):
        there, covariance = _keyframes(optimum, time)
        apart = differences(there, poses)
        total += share * (covariance - solved + apart[:, :, None] * apart[:, None, :])
    if (ways := optima[0].graph.ways) is not None:
        solved = solved[:, :2, :2]
        total[:, :2, :2] += ways.widened(time, poses[:, :2], solved) - solved
    value, vector = np.linalg.eigh(total)
    return Excess(time, (vector * np.maximum(value, 0.0)[:, None, :]) @ vector.transpose(0, 2, 1))


def _keyframes(optimum: Optimum, time: Array) -> tuple[Array, Array]:
    """Poses ``(n, 3)`` of a solution at times ``(n,)`` [s], and covariances ``(n, 3, 3)`` of the nearest keyframes."""
    chain, poses = optimum.at.chain, optimum.state.poses
    which = nearest(chain.time, time)
    R = pose_rotation(poses[which, 2])
    spread = R @ optimum.solution.joint(("x", which)) @ R.transpose(0, 2, 1)
    return poses_at(time, chain.time, poses), spread


class History:
    """The steps and measurements of the last ``span`` [s]; log: gets the rows of the window's log."""

    def __init__(self, span: float = DOUBTS.span) -> None:
        self.log, self.span = MeasurementLog(), span
        self._chunks = list[Steps]()

    def extend(self, steps: Steps) -> None:
        """Append the next steps. What no question asks for, while nothing measures positions, is dropped in time."""
        self._chunks.append(steps)
        if steps.end - self._chunks[0].start > 3 * self.span:
            self._forget(steps.end - 2 * self.span)

    def rewind(self, to: float) -> None:
        """Drop the steps that end after ``to`` [s]."""
        self._chunks = rewound(self._chunks, to)

    def set_goings(self, goings: Array) -> None:
        """Give the steps on stairs the length of the treads, see `with_goings`."""
        self._chunks = [with_goings(steps, goings) for steps in self._chunks]

    def has_position(self, now: float) -> bool:
        """True if a measurement of the last ``span`` [s] before ``now`` [s] determines a position."""
        times = self.log.position_times()
        return bool(((times > now - self.span) & (times <= now)).any())

    def question(
        self,
        now: float,
        prior: Prior,
        before: Findings,
        decisions: Decisions,
        walled: bool,
        paths: PathNetwork | None = None,
    ) -> Callable[[], Review]:
        """The review of the recent past before ``now`` [s], see `compare_sources`; older data are dropped.

        paths: streets and paths outdoors, also beyond it.
        """
        steps = self._forget(now - self.span)
        data = self.log.until(steps.end)

        def graph() -> WalkGraph:
            return WalkGraph.of(steps, data, prior=prior, paths=None if paths is None else paths.around(data))

        kept = {name: self.log.renumbered(name, rows) for name, rows in decisions.items() if name in before.changes}
        return partial(compare_sources, graph, before, kept, walled, self.log.all_numbers(steps.end))

    def _forget(self, before: float) -> Steps:
        """Drop what is from before a moment [s]; returns the steps that are left."""
        steps = later_steps(concatenate_steps(self._chunks), before)
        self._chunks = [steps]
        self.log.forget(steps.start - self.log.longest_overhang)
        return steps


@dataclass(frozen=True)
class Places:
    """The places of a walk on the plan at ``time`` [s]. ways: with their probabilities; sure: the first is certain."""

    time: float
    ways: GaussianMixture
    sure: bool

    @property
    def fix(self) -> Fixes:
        """The certain place."""
        sigma = max(float(horizontal_sigma(self.ways.covariance[0])), DOUBTS.least_sigma)
        return Fixes(np.array([self.time]), self.ways.mean[:1, :2], np.array([sigma]), source=(SOURCE,))

    @property
    def heading(self) -> Headings:
        """The direction at the certain place."""
        sigma = max(float(np.sqrt(self.ways.covariance[0, 2, 2])), DOUBTS.least_sigma_heading)
        return Headings(np.array([self.time]), self.ways.mean[:1, 2], np.array([sigma]), (SOURCE,))


def places_on_plan(build: Callable[[], WalkGraph]) -> Places:
    """The places where a walk can be now, and with the remaining probability anywhere on the plan, in any direction.

    build: makes the graph of the walk so far.
    """
    graph = build()
    found = localized(graph)
    path = paths(found.optima)
    share = probabilities(found.optima, path)
    there = 1.0 - found.elsewhere
    ways, elsewhere = modes_at_end(found.optima, share), 1.0 - there * float(share.sum())
    if elsewhere >= 1e-3:
        mean, covariance = ways.mean[0].copy(), ways.covariance[0].copy()
        mean[:3] = (*found.anywhere.mean(axis=0), 0.0)
        covariance[:3], covariance[:, :3] = 0.0, 0.0
        covariance[:2, :2], covariance[2, 2] = np.cov(found.anywhere.T), ANY_HEADING**2
        weight = np.append(ways.log_weight + np.log(max(1.0 - elsewhere, LEAST)), np.log(elsewhere))
        both: tuple[Array, Array] = np.vstack([ways.mean, mean]), np.concatenate([ways.covariance, covariance[None]])
        ways = GaussianMixture(*both, weight, np.arange(len(weight)))
    return Places(float(graph.keyframe_time[-1]), ways, there * float(share[path == 0].sum()) > REPORTS.sure)
