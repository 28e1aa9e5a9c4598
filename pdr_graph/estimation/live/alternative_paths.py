"""Other paths of a walk under way: by particles between the walls, or by the batch once more."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np

from pdr_graph.estimation.live.batch_start import BatchQuestion, BatchSolution
from pdr_graph.estimation.live.deferred import Deferred
from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.live_output import LiveOutput
from pdr_graph.estimation.live.measurement_log import Decisions
from pdr_graph.estimation.live.particles import AlternativePath, ParallelParticleFilter
from pdr_graph.estimation.live.path_trial import Trial, TrialQuestion, move_to
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.particle_filter import KeyframeMeasurements, measurements_at
from pdr_graph.priors import SCHEDULE
from pdr_graph.types import Index


class AlternativePaths(LiveOutput):
    """The search for paths that cost less than the present one; base class of `LiveSmoother`.

    batch_reviewed: the batch has solved a certain walk once more; alternatives_tried, alternatives_accepted: numbers of
    other paths. next_batch: time [s] before which the batch is not asked again.
    """

    solved: bool

    def __init__(self, graph: LiveGraph, executor: Executor | None) -> None:
        super().__init__(graph)
        self._batch, self.next_batch = Deferred[BatchSolution](executor), -np.inf
        self._trial = Deferred[Trial](executor)
        self._asked = dict[str, Index]()  # numbers of the measurements that the batch was asked about, by kind
        self.batch_reviewed = False
        self.alternatives_tried, self.alternatives_accepted = 0, 0
        self._particles = None

    def _batch_question(self) -> BatchQuestion:
        raise NotImplementedError

    def _restart(self, carried: bool = True) -> None:
        raise NotImplementedError

    def _associate_walls(self, pieces: int) -> float:
        """Associate the last pieces with walls and return the price; no walls before the batch solved the walk."""
        return self.graph.associate_walls(pieces) if self.solved else 0.0

    def _follow(self, new: list[Interval]) -> None:
        """Pass new intervals to the particle filter, which starts at the estimate as soon as that is certain.

        After a gap as long as the lag, new intervals may have left the window already: it starts again.
        """
        window = self.graph.window
        plan = window.located_plan if self.sure else None
        if plan is None or any(interval.j not in window.keyframes for interval in new):
            self._particles = None
        if self._particles is not None:
            for interval in new:
                self._particles.enqueue(interval, self._measurements_at(interval.j))
            self._particles.forget(window.times[0])
        elif plan is not None:
            begin, belief = window.times[-1], self.keyframe_belief()
            self._particles = ParallelParticleFilter(plan, self.graph.prior, belief, begin, window.floor)

    def _measurements_at(self, keyframe: int) -> KeyframeMeasurements:
        """Fixes and headings at the keyframe with this number, for the particles."""
        part, measurements = self.graph.current()
        return measurements_at(measurements, int(np.flatnonzero(part.chain.number == keyframe)[0]))

    def _compare(self, particles: ParallelParticleFilter) -> None:
        """Try the path of most particles where it differs, once that of the batch; restart if the cost is too high."""
        window = self.graph.window
        at = int(np.searchsorted(window.times, particles.times[-1] - CLOSE))
        alternative = particles.alternative_path(window.pose[min(at, len(window.times) - 1), :2])
        if alternative is not None and self._trial.idle:
            self._ask_trial(lambda: (alternative, {}), SCHEDULE.rounds)
        elif self._review_due():
            self.batch_reviewed = True
            self._ask_batch_for_alternative()
        elif self._cost_check_due() and self._cost_too_high():
            self._restart(carried=False)

    def _review_due(self) -> bool:
        """True if the batch should solve the walk once more, before any of it leaves the window."""
        window = self.graph.window
        long = window.times[-1] - window.times[0] > SCHEDULE.review_after
        return not self.batch_reviewed and self._trial.idle and self.graph.has_position and window.complete and long

    def _cost_check_due(self) -> bool:
        window = self.graph.window
        return window.count % SCHEDULE.cost_interval == 0 and window.times[-1] >= self.next_batch

    def _cost_too_high(self) -> bool:
        """True if the cost is too high for a correct path, and there are fixes to find another."""
        fixes = len(self.graph.log.position_times())
        return fixes > 1 and self.graph.cost > SCHEDULE.cost_limit(len(self.graph.window.keyframes), fixes)

    def _ask_batch_for_alternative(self) -> None:
        """Try the path that the batch finds."""
        self._ask_trial(self._batch_question().alternative, SCHEDULE.batch_rounds)

    def _ask_trial(self, alternative: Callable[[], tuple[AlternativePath, Decisions]], rounds: int) -> None:
        """Compare an alternative with the present path, see `TrialQuestion`, and adopt the better one later."""
        self.graph.finalize_leaving()
        if not self.graph.window.intervals:
            return  # a single keyframe has no other path: the lag is shorter than the time between fixes
        question = TrialQuestion(self.graph.copy(), set(self.graph.isam.factors), alternative, rounds)
        self._trial.ask(question, self.graph.window.times[-1] + SCHEDULE.batch_time)

    def _adopt_alternative(self) -> None:
        """Move the window to an alternative that was accepted."""
        graph = self.graph
        trial = self._trial.collect(graph.window.times[-1])
        if trial is None:
            return
        graph.finalize_leaving()
        self.alternatives_tried += 1
        if trial.accepted and len(trial.path.within(graph.window.times)):
            self.alternatives_accepted += 1
            graph.decide(graph.decisions | trial.decisions)
            move_to(graph, trial.path, graph.isam.factors)
