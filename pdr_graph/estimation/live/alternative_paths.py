"""Other paths of a walk under way: by particles between the walls, or by the batch once more."""

from __future__ import annotations

from concurrent.futures import Executor

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.live.batch_start import BatchQuestion, BatchSolution
from pdr_graph.estimation.live.deferred import Deferred
from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.live_output import LiveOutput
from pdr_graph.estimation.live.measurement_log import Decisions
from pdr_graph.estimation.live.particles import AlternativePath, ParallelParticleFilter
from pdr_graph.estimation.live.schedule import SCHEDULE
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.live.window import ALL
from pdr_graph.estimation.particle_filter import KeyframeMeasurements, measurements_at
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
        self._asked = dict[str, Index]()  # numbers of the measurements that the batch was asked about, by kind
        self.batch_reviewed = False
        self.alternatives_tried, self.alternatives_accepted = 0, 0
        self._particles: ParallelParticleFilter | None = None

    def _batch_question(self, alternative: bool = False) -> BatchQuestion:
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
        plan, left = window.located_plan, any(interval.j not in window.keyframes for interval in new)
        if plan is None or not self.sure:
            self._particles = None
        elif self._particles is None or left:
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
        if alternative is not None:
            self._try(alternative)
        elif self._review_due():
            self.batch_reviewed = True
            self._batch.ask(self._batch_question(alternative=True), window.times[-1] + SCHEDULE.batch_time)
        elif self._cost_check_due() and self._cost_too_high():
            self._restart(carried=False)

    def _review_due(self) -> bool:
        """True if the batch should solve the walk once more, before any of it leaves the window."""
        window = self.graph.window
        long = window.times[-1] - window.times[0] > SCHEDULE.review_after
        return not self.batch_reviewed and self._batch.idle and self.graph.has_position and window.complete and long

    def _cost_check_due(self) -> bool:
        window = self.graph.window
        return window.count % SCHEDULE.cost_interval == 0 and window.times[-1] >= self.next_batch

    def _cost_too_high(self) -> bool:
        """True if the cost is too high for a correct path, and there are fixes to find another."""
        fixes = len(self.graph.log.position_times())
        return fixes > 1 and self.graph.cost > SCHEDULE.cost_limit(len(self.graph.window.keyframes), fixes)

    def _try(self, alternative: AlternativePath, decisions: Decisions | None = None) -> None:
        """Optimise from an alternative path; return to the present one unless the alternative costs less.

        decisions: about measurements, on that path; by default the present ones.
        """
        graph, window = self.graph, self.graph.window
        if alternative.time[-1] < window.times[0]:
            return
        self.alternatives_tried += 1
        isam, pose, c = graph.isam, window.pose.copy(), dict(window.c)
        walls = [interval.fields for interval in window.intervals]
        before, decided = graph.total_cost + self._associate_walls(ALL), dict(graph.decisions)
        graph.decide({**decided, **(decisions or {})})
        self._move_to(alternative)
        price = self._associate_walls(ALL)
        for _ in range(SCHEDULE.rounds if decisions is None else SCHEDULE.batch_rounds):
            graph.relinearize()
        if graph.total_cost + price < before:
            self.alternatives_accepted += 1
            return
        for interval, fields in zip(window.intervals, walls, strict=True):
            interval.fields = fields
        window.pose, window.c = pose, c
        graph.decide(decided)
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
