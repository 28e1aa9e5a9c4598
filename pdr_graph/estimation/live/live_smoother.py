"""The live smoother: estimates a walk step by step, along the path that explains its measurements best.

Steps come in order. A keyframe closes after ten pieces, at each measurement and at gaps; a late measurement splits the
interval that it falls into.

Until the direction of the walk is certain there is no estimate to linearise at: the batch solves the whole window at
intervals (`solve_batch`), and no keyframe leaves the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.live.batch_start import BatchSolution, solve_batch
from pdr_graph.estimation.live.history import History, HistoryCheckpoint
from pdr_graph.estimation.live.live_graph import LiveGraph, LiveGraphCheckpoint
from pdr_graph.estimation.live.live_output import LiveOutput
from pdr_graph.estimation.live.particles import AlternativePath, ParallelParticleFilter
from pdr_graph.estimation.live.review import Excess, Findings, Question, Review
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.live.window import ALL
from pdr_graph.estimation.particle_filter import KeyframeMeasurements, measurements_at
from pdr_graph.estimation.smoother import smooth
from pdr_graph.floor.building import Building
from pdr_graph.types import Estimate, Headings, Steps


@dataclass(frozen=True)
class Schedule:
    """When the live smoother refines, reviews and restarts its estimate. All values are chosen by hand.

    rounds: relinearisations after a keyframe, one with each of the next steps; wall_pieces: last pieces whose walls are
    associated again at a keyframe.
    final_tolerance: share of the usual relinearisation thresholds, for the end of the walk; final_decrease: share of
    the cost by which a final round must lower it for another to follow.
    batch_interval [s], batch_share: the batch solves an ambiguous walk again after this time and this share of the
    walk's duration, whichever is longer; longest_ambiguous: time [s] after which the most probable path is accepted.
    comparison_interval [s], comparison_share: the sources are compared again after this share of the walk's duration,
    between 5 s and comparison_interval, and the result is adopted comparison_time [s] later.
    review_after: time [s] after which the batch solves a walk on a plan once more, while all of it is in the window.
    cost_interval: keyframes between checks of the cost; cost_base, cost_per_keyframe, cost_per_fix: the limit of the
    cost, twice that of correct walks.
    """

    rounds: int = 4
    wall_pieces: int = 60
    final_tolerance: float = 1e-4
    final_decrease: float = 1e-4
    batch_interval: float = 3.0
    batch_share: float = 0.2
    longest_ambiguous: float = 180.0
    comparison_interval: float = 30.0
    comparison_share: float = 0.5
    comparison_time: float = 2.0
    review_after: float = 50.0
    cost_interval: int = 5
    cost_base: float = 8.0
    cost_per_keyframe: float = 0.4
    cost_per_fix: float = 3.0

    def batch_delay(self, duration: float) -> float:
        """Time [s] until the batch solves an ambiguous walk of this duration [s] again."""
        return max(self.batch_interval, self.batch_share * duration)

    def comparison_delay(self, duration: float) -> float:
        """Time [s] until the sources of a walk of this duration [s] are compared again."""
        return min(max(5.0, self.comparison_share * duration), self.comparison_interval)

    def cost_limit(self, keyframes: int, fixes: int) -> float:
        """Cost above which a window with so many keyframes and fixes cannot be on the correct path."""
        return self.cost_base + self.cost_per_keyframe * keyframes + self.cost_per_fix * fixes


SCHEDULE = Schedule()


@dataclass(frozen=True)
class SmootherCheckpoint:
    """State of a `LiveSmoother`; fields as its attributes. tried, taken: alternative paths tried, and accepted."""

    graph: LiveGraphCheckpoint
    sure: bool
    next_batch: float
    next_comparison: float
    adoption: float
    history: HistoryCheckpoint
    pending: Review | None
    findings: Findings
    excess: Excess
    restarts: int
    reviewed: bool
    tried: int
    taken: int


class LiveSmoother(LiveOutput):
    """Estimates a walk under way from all its measurements; arguments as of ``LiveGraph``.

    sure: position and direction of the walk are certain; restarts: how often measurements contradicted the estimate;
    next_batch, next_comparison: times [s] before which neither is repeated; reviewed: the batch has solved the walk
    once more; alternatives_tried, alternatives_accepted: numbers of other paths.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.graph = LiveGraph(prior, lag, plan, floor)
        self.sure, self.finished = False, False
        self.next_batch, self.next_comparison, self.restarts = -np.inf, -np.inf, 0
        self.reviewed = False
        self.alternatives_tried, self.alternatives_accepted = 0, 0
        self._walls_due, self._rounds_due = False, 0
        self._particles: ParallelParticleFilter | None = None
        self.history, self.findings, self.adoption = History(), Findings(), np.inf
        self._question: Question | None = None
        self._review: Review | None = None
        self.graph.log.longer = self.history.log
        self._final: Estimate | None = None
        super().__init__()

    def extend(self, steps: Steps, floor: str | None = None) -> None:
        """Append the next steps of the walk. floor: label of their floor, by default that of the steps before."""
        window = self.graph.window
        window.steps.append(steps)
        self.history.extend(steps)
        window.floor = window.floor if floor is None else floor
        if not window.keyframes:
            self.graph.begin()
        busy = self._close() or self._refine()
        if self._particles is not None and self._particles.process(busy):
            self._compare(self._particles)

    def append(self, data: Any) -> None:
        """Append measurements of any type in `KINDS`; those from before the window are dropped and counted as late."""
        self.graph.append(data)
        window = self.graph.window
        if window.keyframes and bool((self.graph.log.times(data) <= window.steps.end).any()):
            self._close()

    def collect(self, data: Any) -> bool:
        """Pass raw data (advertisements, scans) to the collectors; True if one of them uses it."""
        return self.graph.collect(data)

    def set_heading(self, number: int, time: float, heading: float, sigma: float) -> None:
        """Set or replace heading ``number`` (time [s], heading and sigma [rad]); an infinite sigma removes it."""
        if np.isfinite(sigma):
            row = Headings(np.array([time]), np.array([heading]), np.array([sigma]))
            self.graph.append(row, np.array([number]))
        else:
            self.graph.log.remove(Headings, number)

    def finish(self) -> None:
        """End the walk.

        If the window still holds the whole walk, the batch solves it; else the window is relinearised until the cost no
        longer decreases.
        """
        graph = self.graph
        if not graph.window.keyframes:
            return
        self.finished = graph.window.finished = True
        self._close(at_end=True)
        if not self.sure and graph.has_position:
            self._solve_again()
        if graph.window.complete:
            self._final = smooth(graph.batch_graph(decided=False))
            return
        self._question, self._review, self.next_comparison = None, None, -np.inf
        self._compare_sources(0.0)
        best, least = graph.isam, graph.total_cost
        graph.restart_solver(best.with_values(gtsam.Values(best.values), relinearize=0.0), best.factors)
        enough = 1 - SCHEDULE.final_decrease
        while graph.relinearize(SCHEDULE.final_tolerance, everything=True) and graph.total_cost < least * enough:
            best, least = graph.isam, graph.total_cost
            graph.restart_solver(best.with_values(gtsam.Values(best.values)), best.factors)
        if graph.total_cost > least:
            graph.restart_solver(best.with_values(gtsam.Values(best.values)), best.factors)

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes due after new steps and measurements, and update; False if none was due."""
        graph = self.graph
        new, reached = graph.close_keyframes(at_end)
        if not (new or reached):
            return False
        contradicted = reached and self._contradicted()
        if contradicted and self.sure:
            self._restart()
        if not self.sure and graph.has_position and graph.window.times[-1] >= self.next_batch:
            self._solve_again()
        else:
            graph.update()
        if reached and self.sure:
            self._reclassify()
        self._compare_sources(SCHEDULE.comparison_time)
        self._follow(new)
        graph.finalize_leaving()
        self._walls_due, self._rounds_due = graph.window.plan is not None, SCHEDULE.rounds
        return True

    def _refine(self) -> bool:
        """Associate walls, or relinearise once: the work is spread over the steps between keyframes.

        Returns True if anything was due.
        """
        due = bool(self._rounds_due) or self._walls_due
        if self._walls_due:
            self._walls_due = False
            self._associate_walls(SCHEDULE.wall_pieces)
        elif self._rounds_due:
            self._rounds_due = self._rounds_due - 1 if self.graph.relinearize() else 0
        return due

    def _associate_walls(self, pieces: int) -> float:
        """Associate the last pieces with walls and return the price; no walls before the batch solved the walk."""
        return self.graph.associate_walls(pieces) if np.isfinite(self.next_batch) else 0.0

    def _contradicted(self) -> bool:
        """True if measurements contradict earlier decisions; stores the new decisions."""
        _, measurements = self.graph.current()
        decisions = self.graph.decisions
        contradicted = any([kind.contradicts(decisions.get(kind.name, {})) for kind in measurements])
        self.graph.store_decisions(measurements)
        return contradicted

    def _solve_again(self) -> None:
        """Restart from the batch solution of the window."""
        graph, window = self.graph, self.graph.window
        graph.finalize_leaving()
        solution = solve_batch(graph.batch_graph())
        self._adopt(solution)
        long = window.times[-1] - window.times[0] > SCHEDULE.longest_ambiguous
        self.sure = solution.sure or (long and len(graph.log.position_times()) > 2)
        if not graph.finalized.anchored:
            graph.finalized.move(window.pose[0].copy())
        graph.finalized.anchored |= self.sure
        self.next_comparison = -np.inf if self.sure else self.next_comparison
        self.next_batch = window.times[-1] + SCHEDULE.batch_delay(window.times[-1] - window.times[0])
        graph.rebuild(graph.lag if self.sure else np.inf)
        self._associate_walls(ALL)
        for _ in range(SCHEDULE.rounds):
            graph.relinearize()

    def _adopt(self, solution: BatchSolution) -> None:
        """Copy poses, calibrations and decisions of the batch into the window."""
        graph, window = self.graph, self.graph.window
        for name, decisions in solution.decisions.items():
            graph.decisions[name] = graph.log.numbered(name, decisions)
        window.pose = solution.poses(np.array(window.times))
        for interval in window.intervals:
            window.c[interval.segment] = solution.calibration(interval.end)
            interval.fields = [None] * len(interval.fields)

    def _restart(self) -> None:
        """Restart because measurements contradict the walk; drop the information from before the window."""
        self._forget_before()
        self.restarts += 1
        self.sure, self.next_batch = False, -np.inf

    def _forget_before(self) -> None:
        """Keep the calibration alone of what the walk knows from before the window, for `LiveGraph.rebuild`."""
        graph = self.graph
        first = graph.window.segments[0]
        if C(first) in graph.isam:
            covariance = graph.isam.covariance([C(first)]) + np.diag(np.square(graph.prior.change))
            graph.c_prior = graph.window.c[first], covariance

    def _reclassify(self) -> None:
        """Lower the weight of measurements far from the walk; restore it for those that are near again."""
        graph = self.graph
        at = graph.evaluate()
        reclassified = [measurement.reclassified(at) for measurement in at.measurements]
        if graph.store_decisions(reclassified):
            graph.log.version += 1
            graph.update()
        diverged = any(measurement.diverged for measurement in reclassified)
        if diverged and graph.window.times[-1] >= self.next_batch:
            self._restart()
            self._solve_again()

    def review(self) -> None:
        """Compare the sources now if that is due, in an idle moment; else it is done soon after, with equal results."""
        if self._question is not None and self._review is None:
            self._review = self._question.answer()

    def _compare_sources(self, waiting: float) -> None:
        """At intervals, compare the sources over the recent past, and adopt the result ``waiting`` [s] later.

        That is the most probable of what they get wrong; what else remains possible widens the stated covariance.
        """
        now = self.graph.window.times[-1]
        idle = self._question is None and self._review is None
        if idle and now >= self.next_comparison and self.history.has_position(now):
            self.next_comparison = now + SCHEDULE.comparison_delay(now - self.graph.window.times[0])
            self.adoption = now + waiting
            walled = self.graph.window.located_plan is not None
            self._question = self.history.question(now, self.graph.prior, self.findings, self.graph.decisions, walled)
        if now < self.adoption:
            return
        self.review()
        if self._review is not None:
            self._adopt_review(self._review)
        self._question, self._review, self.adoption = None, None, np.inf

    def _adopt_review(self, review: Review) -> None:
        """Adopt what sources get wrong, and the covariance of what remains possible."""
        graph = self.graph
        before, self.findings = self.findings, review.findings
        if self.findings.texts != before.texts:
            self._assume(review)
        graph.excess = review.excess

    def _assume(self, review: Review) -> None:
        """Adopt the decisions of a review, and its walk where no plan holds ours."""
        graph, window = self.graph, self.graph.window
        graph.decisions |= {name: self.history.log.numbered(name, rows) for name, rows in review.decisions.items()}
        if window.located_plan is not None or not self.sure:
            graph.log.version += 1
            graph.update(everything=True)
            return
        graph.finalize_leaving()
        self._forget_before()
        window.pose = review.poses(np.array(window.times), window.pose)
        for interval in window.intervals:
            window.c[interval.segment] = review.calibration(interval.end)
        graph.rebuild(graph.lag)
        for _ in range(SCHEDULE.rounds):
            graph.relinearize()

    def _follow(self, new: list[Interval]) -> None:
        """Pass new intervals to the particle filter, which starts at the estimate as soon as that is certain."""
        window = self.graph.window
        plan = window.located_plan
        if plan is None or not self.sure:
            self._particles = None
        elif self._particles is None:
            begin = window.times[-1]
            belief = self.keyframe_belief()
            self._particles = ParallelParticleFilter(plan, self.graph.prior, belief, begin, window.floor)
        else:
            for interval in new:
                self._particles.enqueue(interval, self._measurements_at(interval.j))
            self._particles.forget(window.times[0])

    def _measurements_at(self, keyframe: int) -> KeyframeMeasurements:
        """Fixes and headings at the keyframe with this number, for the particles."""
        part, measurements = self.graph.current()
        return measurements_at(measurements, int(np.flatnonzero(part.chain.number == keyframe)[0]))

    def _compare(self, particles: ParallelParticleFilter) -> None:
        """Try the path of most particles where it differs, once that of the batch; restart if the cost is too high."""
        window = self.graph.window
        at = int(np.searchsorted(window.times, particles.times[-1] - CLOSE))
        alternative = particles.alternative_path(window.pose[min(at, len(window.times) - 1), :2])
        if alternative is None and self._review_due():
            self.reviewed = True
            solution = solve_batch(self.graph.batch_graph())
            c = np.tile(solution.c[-1], (len(solution.time), 1))
            alternative = AlternativePath(solution.time, np.column_stack([solution.pose, c]))
        if alternative is not None and alternative.time[-1] >= window.times[0]:
            self._try(alternative)
        elif self._cost_check_due() and self._cost_too_high():
            self._restart()
            self.graph.c_prior = np.array(self.graph.prior.mean), self.graph.prior.covariance
            self._solve_again()

    def _review_due(self) -> bool:
        """True if the batch should solve the walk once more, before any of it leaves the window."""
        window = self.graph.window
        long = window.times[-1] - window.times[0] > SCHEDULE.review_after
        return not self.reviewed and self.graph.has_position and window.complete and long

    def _cost_check_due(self) -> bool:
        window = self.graph.window
        return window.count % SCHEDULE.cost_interval == 0 and window.times[-1] >= self.next_batch

    def _cost_too_high(self) -> bool:
        """True if the cost is too high for a correct path, and there are fixes to find another."""
        fixes = len(self.graph.log.position_times())
        return fixes > 1 and self.graph.cost > SCHEDULE.cost_limit(len(self.graph.window.keyframes), fixes)

    def _try(self, alternative: AlternativePath) -> None:
        """Optimise from an alternative path; return to the present one unless the alternative costs less."""
        graph, window = self.graph, self.graph.window
        self.alternatives_tried += 1
        isam, pose, c = graph.isam, window.pose.copy(), dict(window.c)
        walls = [interval.fields for interval in window.intervals]
        before = graph.total_cost + self._associate_walls(ALL)
        self._move_to(alternative)
        price = self._associate_walls(ALL)
        for _ in range(SCHEDULE.rounds):
            graph.relinearize()
        if graph.total_cost + price < before:
            self.alternatives_accepted += 1
            return
        for interval, fields in zip(window.intervals, walls, strict=True):
            interval.fields = fields
        window.pose, window.c = pose, c
        graph.restore_solver(isam)

    def _move_to(self, path: AlternativePath) -> None:
        """Move the window to a path; keyframes after its end are dead-reckoned."""
        graph, window = self.graph, self.graph.window
        times = np.array(window.times)
        within = np.flatnonzero((times >= path.time[0] - CLOSE) & (times <= path.time[-1] + CLOSE))
        window.pose[within] = path.poses(times[within])
        window.dead_reckon(int(within[-1]), path.state[-1, 3:])
        values = gtsam.Values(graph.isam.values)
        for number, pose in zip(window.keyframes, window.pose, strict=True):
            values.update(X(number), gtsam.Pose2(*pose))
        for interval in window.intervals:
            if interval.begin >= path.time[0] - CLOSE:
                window.c[interval.segment] = path.state[-1, 3:]
                values.update(C(interval.segment), path.state[-1, 3:])
        self._associate_walls(ALL)  # or the walls of the path that is left would pull at the first solution
        graph.restart_solver(graph.isam.with_values(values), graph.isam.factors)

    def checkpoint(self) -> SmootherCheckpoint:
        """Return the state, without the rows that `pop_finalized` returned."""
        self.review()
        return SmootherCheckpoint(
            graph=self.graph.checkpoint(),
            sure=self.sure,
            next_batch=self.next_batch,
            next_comparison=self.next_comparison,
            adoption=self.adoption,
            history=self.history.checkpoint(),
            pending=self._review,
            findings=self.findings,
            excess=self.graph.excess,
            restarts=self.restarts,
            reviewed=self.reviewed,
            tried=self.alternatives_tried,
            taken=self.alternatives_accepted,
        )

    def restore(self, checkpoint: SmootherCheckpoint) -> None:
        """Set the state to a checkpoint of a smoother with the same prior, lag, plan and collectors."""
        self.sure, self.next_batch, self.restarts = checkpoint.sure, checkpoint.next_batch, checkpoint.restarts
        self.next_comparison = checkpoint.next_comparison
        self.reviewed = checkpoint.reviewed
        self.alternatives_tried, self.alternatives_accepted = checkpoint.tried, checkpoint.taken
        self.history.restore(checkpoint.history)
        self.adoption, self._review = checkpoint.adoption, checkpoint.pending
        self.findings, self.graph.excess = checkpoint.findings, checkpoint.excess
        self.graph.restore(checkpoint.graph)
