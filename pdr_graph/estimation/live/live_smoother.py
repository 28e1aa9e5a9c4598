"""The live smoother: estimates a walk step by step, along the path that explains its measurements best.

Steps come in order. A keyframe closes after ten pieces, at each measurement and at gaps; a late measurement splits the
interval that it falls into.

Until the direction of the walk is certain there is no estimate to linearise at: the batch solves the whole window at
intervals (`BatchQuestion`), and no keyframe leaves the window.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import C

from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.live.batch_start import BatchQuestion, BatchSolution
from pdr_graph.estimation.live.deferred import Deferred
from pdr_graph.estimation.live.history import History, HistoryCheckpoint
from pdr_graph.estimation.live.live_graph import LiveGraph, LiveGraphCheckpoint
from pdr_graph.estimation.live.modes import ModesCheckpoint
from pdr_graph.estimation.live.nearby_optimum import restart_nearby
from pdr_graph.estimation.live.new_fixes import NewFixes, were_rejected
from pdr_graph.estimation.live.path_trial import Trial
from pdr_graph.estimation.live.plan_search import SOURCE, Places, PlacesQuestion
from pdr_graph.estimation.live.review import Excess, Findings, Review
from pdr_graph.estimation.live.step_buffer import CLOSE
from pdr_graph.estimation.live.window import ALL
from pdr_graph.estimation.smoother import smooth
from pdr_graph.floor.building import Building
from pdr_graph.priors import SCHEDULE
from pdr_graph.types import Array, Estimate, Headings, Index, Sightings, Steps


@dataclass(frozen=True)
class SmootherCheckpoint:
    """State of a `LiveSmoother`; fields as its attributes. tried, taken: alternative paths tried, and accepted."""

    graph: LiveGraphCheckpoint
    sure: bool
    solved: bool
    restarting: bool
    carried: bool
    modes: ModesCheckpoint | None
    next_batch: float
    asked: dict[str, Index]
    solution: BatchSolution | None
    batch_due: float
    trial: Trial | None
    trial_due: float
    places: Places | None
    search_due: float
    next_search: float
    next_comparison: float
    history: HistoryCheckpoint
    review: Review | None
    review_due: float
    findings: Findings
    excess: Excess
    restarts: int
    batch_reviewed: bool
    tried: int
    taken: int


class LiveSmoother(NewFixes):
    """Estimates a walk under way from all its measurements; arguments as of ``LiveGraph``.

    executor: solves the batch and compares the sources beside the walk; by default `review` does, or a push that needs
    the answer.
    sure: position and direction of the walk are certain; solved: the batch has solved it; restarts: how often
    measurements contradicted the estimate; next_batch, next_comparison: times [s] before which neither is repeated.
    """

    def __init__(
        self,
        prior: Prior | None = None,
        lag: float = np.inf,
        plan: Building | None = None,
        floor: str = "",
        executor: Executor | None = None,
    ):
        super().__init__(LiveGraph(prior, lag, plan, floor), executor)
        self.finished = self.solved = False
        self.next_comparison, self.restarts = -np.inf, 0
        self._walls_due, self._rounds_due = False, 0
        self._restarting = self._carried = False  # the past is dropped at the next solution; but for its calibration
        self.history, self.findings = History(), Findings()
        self._review = Deferred[Review](executor)
        self._search, self.next_search = Deferred[Places](executor), -np.inf
        self.graph.log.longer = self.history.log
        self._final: Estimate | None = None

    def extend(self, steps: Steps, floor: str | None = None) -> None:
        """Append the next steps of the walk. floor: label of their floor, by default that of the steps before."""
        window = self.graph.window
        window.steps.append(steps)
        self.history.extend(steps)
        window.floor = window.floor if floor is None else floor
        if not window.keyframes:
            self.graph.begin()
        busy = self._close() or self._refine()
        self._follow_modes()
        if self._particles is not None and self._particles.process(busy):
            self._compare(self._particles)

    def set_goings(self, goings: Array) -> None:
        """Give the steps on stairs the length of the treads. goings: ``(k, 3)``, see `goings_of`."""
        self.history.set_goings(goings)
        self.graph.set_goings(goings)

    def append(self, data: Any) -> None:
        """Append measurements of any type in `KINDS`; those from before the window are dropped and counted as late."""
        self.graph.append(data)
        window = self.graph.window
        if window.keyframes and bool((self.graph.log.times(data) <= window.steps.end).any()):
            self._close()
            self._follow_modes()

    def collect(self, received: Sightings, radio: str) -> bool:
        """Pass receptions of a radio, "bluetooth" or "wifi", to the collectors; True if one of them uses any."""
        return self.graph.collect(received, radio)

    def set_heading(self, number: int, time: float, heading: float, sigma: float) -> None:
        """Set or replace heading ``number`` (time [s], heading and sigma [rad]); an infinite sigma removes it."""
        if np.isfinite(sigma):
            row = Headings(np.array([time]), np.array([heading]), np.array([sigma]))
            self.graph.append(row, np.array([number]))
        else:
            self.graph.log.remove(Headings, number)

    def finish(self) -> None:
        """End the walk.

        If the window still holds the whole walk, the batch solves it; else the window moves to the optimum nearby.
        """
        graph = self.graph
        if not graph.window.keyframes:
            return
        self.finished = graph.window.finished = True
        self._close(at_end=True)
        self._batch.cancel()
        self._trial.cancel()
        self._search.cancel()
        if not self.sure and graph.has_position:
            self._adopt_batch(self._batch_question().answer())
        if graph.window.complete:
            self._final = smooth(graph.batch_graph(decided=False, but=SOURCE)())
            return
        self._review.cancel()
        self.next_comparison = -np.inf
        self._compare_sources(0.0, Findings())
        best, least = graph.isam, graph.total_cost
        graph.isam = best.with_values(best.values, relinearize=0.0)
        restart_nearby(graph, best.factors, SCHEDULE.final_rounds)
        if not graph.total_cost < least:
            graph.place(best)

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes due after new steps and measurements, and update; False if none was due."""
        graph = self.graph
        unexpected = self._unexpected_fixes()
        new, reached = graph.close_keyframes(at_end)
        if not (new or reached):
            return False
        contradicted = reached and self._contradicted(unexpected)
        if contradicted and self.sure:
            self._restart()
        self._search_plan()
        adopted = self._solve_by_batch()
        if not adopted:
            graph.update()
        self._adopt_alternative()
        if reached and self.sure:
            self._reclassify()
            self._doubt_new_fixes()
        self._compare_sources(SCHEDULE.comparison_time)
        self._follow(new)
        graph.finalize_leaving()
        self._walls_due, self._rounds_due = graph.window.plan is not None, SCHEDULE.rounds
        return True

    def _follow_modes(self) -> None:
        """Advance the ways that remain while the direction is open; the first fix begins them."""
        graph, modes = self.graph, self.modes
        steps = graph.window.steps
        if self.sure:
            return
        if modes.mixture is None:
            first = self._fixes_between(-np.inf, steps.end)
            if not first or graph.finalized.anchored:
                return
            modes.begin(self.keyframe_belief(), first[0], steps.start)
        modes.advance(steps, self._fixes_between(modes.time, steps.end))
        headings, numbers = graph.log.rows(Headings), graph.log.numbers("headings")
        if headings is not None and numbers is not None:
            modes.point(steps, headings, numbers)

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

    def _contradicted(self, unexpected: Index) -> bool:
        """True if measurements contradict earlier decisions; stores the new decisions.

        unexpected: numbers of fixes that become outliers, before they draw the walk across walls.
        """
        _, measurements = self.graph.current()
        decisions = self.graph.decisions
        contradicted = any([kind.contradicts(decisions.get(kind.name, {})) for kind in measurements])
        fixes = [kind.rejected(unexpected) for kind in measurements if isinstance(kind, FixFactor)]
        if self.graph.store_decisions([*measurements, *fixes]) and len(unexpected):
            self.graph.log.version += 1
        return contradicted

    def _solve_by_batch(self) -> bool:
        """Adopt a solution of the batch that is due, and ask for one while the direction is open.

        Returns True if a solution was adopted.
        """
        now = self.graph.window.times[-1]
        solution = self._batch.collect(now)
        if solution is not None:
            self._adopt_batch(solution)
        if not self.sure and self.graph.window.duration > SCHEDULE.longest_open and np.isinf(self.graph.isam.lag):
            self.graph.rebuild(self.graph.lag)  # keyframes leave the window although the direction is open
        if not self.sure and self._batch.idle and self.graph.has_position and self._batch_due(now):
            if not (self.solved or self.graph.finalized.anchored) and np.isfinite(self.graph.isam.lag):
                self.graph.rebuild(np.inf)  # no keyframe leaves the window before the batch has placed the walk
            self._batch.ask(self._batch_question(), now + SCHEDULE.batch_time)
            self._asked = self.graph.log.all_numbers(now)
            self.next_batch = now + SCHEDULE.batch_delay(now - self.graph.window.times[0])
        return solution is not None

    def _search_plan(self) -> None:
        """Seek a walk without any position on the whole plan; a place that is certain becomes a fix."""
        graph, window = self.graph, self.graph.window
        now, walked = window.times[-1], window.times[-1] - window.times[0]
        if graph.has_position or graph.finalized.anchored or window.located_plan is None:
            self._search.cancel()
            return
        if walked > SCHEDULE.longest_search:
            if not np.isfinite(graph.isam.lag):
                graph.rebuild(graph.lag)
            return
        places = self._search.collect(now)
        if places is not None and places.sure:
            graph.append(places.fix)
            graph.append(places.heading)
            return
        if places is not None:
            self.modes.mixture, self.modes.time = places.ways, places.time
        if np.isfinite(graph.isam.lag):
            graph.rebuild(np.inf)  # no keyframe leaves the window before the walk is placed
        if self._search.idle and walked > SCHEDULE.search_after and now >= self.next_search:
            self._search.ask(PlacesQuestion(graph.batch_graph()), now + SCHEDULE.search_time)
            self.next_search = now + SCHEDULE.search_delay(walked)

    def _batch_due(self, now: float) -> bool:
        """True if the batch has not solved the walk for a while, or not with the latest fix or heading."""
        numbers = self.graph.log.all_numbers(now)
        kinds = [kind for kind in ("fixes", "headings") if kind in numbers]
        return now >= self.next_batch or any(
            not np.isin(numbers[kind], self._asked.get(kind, ())).all() for kind in kinds
        )

    def _batch_question(self) -> BatchQuestion:
        """The batch of the window."""
        graph = self.graph
        graph.finalize_leaving()
        c = self._first_calibration(self._carried)[0] if self._restarting else None
        return BatchQuestion(graph.batch_graph(c=c), graph.log.all_numbers(graph.window.covered))

    def _adopt_batch(self, solution: BatchSolution) -> None:
        """Restart from a solution of the batch."""
        graph, window = self.graph, self.graph.window
        graph.finalize_leaving()
        if self._restarting:
            graph.c_prior, self._restarting = self._first_calibration(self._carried), False
        self._adopt(solution)
        long = window.duration > SCHEDULE.longest_ambiguous
        self.sure, self.solved = solution.sure or (long and len(graph.log.position_times()) > 2), True
        self.modes.adopt(None if self.sure else solution)
        if not graph.finalized.anchored:
            graph.finalized.move(window.pose[0].copy())
        graph.finalized.anchored |= self.sure
        self.next_comparison = -np.inf if self.sure else self.next_comparison
        self._associate_walls(ALL)  # or a solver without walls would move the walk off the solution
        graph.rebuild(graph.lag if self.sure or window.duration > SCHEDULE.longest_open else np.inf)
        for _ in range(SCHEDULE.rounds if self.finished else 0):  # else the next steps do, see `_refine`
            graph.relinearize()

    def _adopt(self, solution: BatchSolution) -> None:
        """Copy poses, calibrations and decisions of the batch into the window."""
        graph, window = self.graph, self.graph.window
        graph.decisions = graph.decisions | solution.decisions
        times = np.array(window.times)
        window.pose = solution.poses(times)
        window.dead_reckon(int(np.searchsorted(times, solution.time[-1] + CLOSE)) - 1, solution.c[-1])
        for interval in window.intervals:
            window.c[interval.segment] = solution.calibration(interval.end)

    def _restart(self, carried: bool = True) -> None:
        """Solve the window anew, since measurements contradict the walk; the information from before it is dropped.

        carried: but for the calibration.
        """
        self.restarts += 1
        self._restarting, self._carried = True, carried
        self.sure = self.solved = False
        self._batch.cancel()
        self._trial.cancel()
        self.next_batch = -np.inf

    def _first_calibration(self, carried: bool) -> tuple[Array, Array]:
        """Mean ``(3,)`` and covariance ``(3, 3)`` of the window's first calibration; carried: by the walk so far."""
        graph = self.graph
        first = graph.window.segments[0]
        if not carried:
            return np.array(graph.prior.mean), graph.prior.covariance
        if C(first) not in graph.isam:
            return graph.c_prior
        return graph.window.c[first], graph.isam.covariance([C(first)]) + np.diag(np.square(graph.prior.change))

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

    def review(self) -> None:
        """Do what is due soon in an idle moment; else the push that needs it does, with equal results."""
        self._batch.work()
        self._trial.work()
        self._review.work()
        self._search.work()

    def _compare_sources(self, waiting: float, before: Findings | None = None) -> None:
        """At intervals, compare the sources over the recent past, and adopt the result ``waiting`` [s] later.

        That is the most probable of what they get wrong; what else remains possible widens the stated covariance.
        before: assumptions that are kept unless others are clearly better; by default the present ones.
        """
        now = self.graph.window.times[-1]
        if self._review.idle and now >= self.next_comparison and self.history.has_position(now):
            self.next_comparison = now + SCHEDULE.comparison_delay(now - self.graph.window.times[0])
            walled = self.graph.window.located_plan is not None
            known = self.findings if before is None else before
            question = self.history.question(now, self.graph.prior, known, self.graph.decisions, walled)
            self._review.ask(question, now + waiting)
        review = self._review.collect(now)
        if review is not None:
            self._adopt_review(review)

    def _adopt_review(self, review: Review) -> None:
        """Adopt what sources get wrong, and the covariance of what remains possible."""
        graph = self.graph
        before, self.findings = self.findings, review.findings
        if self.findings.texts != before.texts:
            self._assume(review)
        graph.excess = review.excess or graph.excess

    def _assume(self, review: Review) -> None:
        """Adopt the decisions of a review, and its walk where no plan holds ours and the decisions matter to it."""
        graph, window = self.graph, self.graph.window
        before = graph.decisions
        adopted = review.decisions
        graph.decide(before | adopted)
        if window.located_plan is not None or not self.sure or were_rejected(before, adopted):
            graph.update(everything=True)
            return
        graph.finalize_leaving()
        self._trial.cancel()
        graph.c_prior = self._first_calibration(carried=True)
        window.pose = review.poses(np.array(window.times), window.pose)
        for interval in window.intervals:
            window.c[interval.segment] = review.calibration(interval.end)
        graph.rebuild(graph.lag)
        for _ in range(SCHEDULE.rounds):
            graph.relinearize()

    def checkpoint(self) -> SmootherCheckpoint:
        """Return the state, without the rows that `pop_finalized` returned."""
        return SmootherCheckpoint(
            graph=self.graph.checkpoint(),
            sure=self.sure,
            solved=self.solved,
            restarting=self._restarting,
            carried=self._carried,
            modes=self.modes.checkpoint(),
            next_batch=self.next_batch,
            asked=self._asked,
            solution=self._batch.work(),
            batch_due=self._batch.due,
            trial=self._trial.work(),
            trial_due=self._trial.due,
            places=self._search.work(),
            search_due=self._search.due,
            next_search=self.next_search,
            next_comparison=self.next_comparison,
            history=self.history.checkpoint(),
            review=self._review.work(),
            review_due=self._review.due,
            findings=self.findings,
            excess=self.graph.excess,
            restarts=self.restarts,
            batch_reviewed=self.batch_reviewed,
            tried=self.alternatives_tried,
            taken=self.alternatives_accepted,
        )

    def restore(self, checkpoint: SmootherCheckpoint) -> None:
        """Set the state to a checkpoint of a smoother with the same prior, lag, plan and collectors."""
        self.sure, self.next_batch, self.restarts = checkpoint.sure, checkpoint.next_batch, checkpoint.restarts
        self.next_comparison = checkpoint.next_comparison
        self.batch_reviewed = checkpoint.batch_reviewed
        self.alternatives_tried, self.alternatives_accepted = checkpoint.tried, checkpoint.taken
        self.history.restore(checkpoint.history)
        self.solved, self._restarting, self._carried = checkpoint.solved, checkpoint.restarting, checkpoint.carried
        self._asked = checkpoint.asked
        self.modes.restore(checkpoint.modes)
        self._batch.restore(checkpoint.solution, checkpoint.batch_due)
        self._trial.restore(checkpoint.trial, checkpoint.trial_due)
        self._search.restore(checkpoint.places, checkpoint.search_due)
        self.next_search = checkpoint.next_search
        self._review.restore(checkpoint.review, checkpoint.review_due)
        self.findings, self.graph.excess = checkpoint.findings, checkpoint.excess
        self.graph.restore(checkpoint.graph)
