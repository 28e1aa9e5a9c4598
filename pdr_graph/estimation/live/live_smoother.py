"""The live smoother: a walk estimated step by step, about the path that explains its measurements best.

Steps come in order; a keyframe closes after ten pieces of them, where something was measured, and at gaps. What comes
late splits the interval that it falls into.

Until the direction of the walk is sure there is nothing to linearise about: now and then the batch solves the window
(`solve_batch`), and nothing leaves it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.factors.base import AnyArray
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.live.batch_start import BatchSolution, solve_batch
from pdr_graph.estimation.live.live_graph import LiveGraph, LiveGraphCheckpoint
from pdr_graph.estimation.live.live_output import LiveOutput
from pdr_graph.estimation.live.particles import OtherPath, ParallelParticleFilter
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.live.window import ALL
from pdr_graph.estimation.particle_filter import KeyframeMeasurements, measurements_at
from pdr_graph.estimation.smoother import smooth
from pdr_graph.floor.building import Building
from pdr_graph.types import Estimate, Headings, Steps

CONVERGED = 1e-4  # of the tolerances, at the end of the walk
ROUNDS = 4  # of linearising again after a keyframe, one with each of the next steps
SETTLES = 1e-4  # at the end: when a round takes less than this share off the cost
AGAIN, SPACED = 3.0, 0.2  # [s], and share of its duration, before a walk that is not sure is solved again
CHECKED = 5  # keyframes after which the cost is looked at
STRAINED, OF_KEYFRAME, OF_FIX = 8.0, 0.4, 3.0  # cost beyond which a walk is strained: twice what good ones have
LONGEST_OPEN = 180.0  # [s] until the most probable of several paths is taken: nobody can wait for a longer walk
CORRECTED = 30.0  # [s] between two looks for what is listed wrongly
REVIEWED = 50.0  # [s] after which a walk on a plan is solved once more
LOOKED_BACK = 60  # pieces whose walls are asked for again


@dataclass(frozen=True)
class SmootherCheckpoint:
    """What a `LiveSmoother` knows."""

    graph: LiveGraphCheckpoint
    sure: bool
    next_batch: float
    next_correction: float
    restarts: int
    reviewed: bool
    tried: int
    taken: int


class LiveSmoother(LiveOutput):
    """Every measurement of a walk under way as a factor, about the path that explains them best.

    Arguments as of ``LiveGraph``. sure: it is known where the walk was and which way it went; restarts: how often
    measurements said that it was elsewhere; tried, taken: other paths, and those that were better.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.graph = LiveGraph(prior, lag, plan, floor)
        self.sure, self.finished = False, False
        self.next_batch, self.next_correction, self.restarts = -np.inf, -np.inf, 0
        self.reviewed = False  # once, when more of the walk was known
        self.tried, self.taken = 0, 0
        self._walls_due, self._rounds_due = False, 0
        self._particles: ParallelParticleFilter | None = None
        self._final: Estimate | None = None
        super().__init__()

    # What comes in

    def extend(self, steps: Steps, floor: str | None = None) -> None:
        """Append the next steps of the walk, on a floor; the first begin at its start."""
        window = self.graph.window
        window.steps.append(steps)
        window.floor = window.floor if floor is None else floor
        if not window.keyframes:
            self.graph.begin()
        busy = self._close() or self._refine()
        if self._particles is not None and self._particles.work(busy):
            self._compare(self._particles)

    def append(self, data: Any) -> None:
        """Append measurements of any type that makes factors; those from before the window count as too late."""
        self.graph.append(data)
        window = self.graph.window
        if window.keyframes and bool((self.graph.log.times(data) <= window.steps.end).any()):
            self._close()

    def collect(self, data: Any) -> bool:
        """Take raw data (advertisements, scans); whether anything makes measurements of it."""
        return self.graph.collect(data)

    def point(self, number: int, time: float, heading: float, sigma: float) -> None:
        """Set walking direction ``number`` [rad]; the last counts. One of an infinite sigma tells nothing."""
        if np.isfinite(sigma):
            one = Headings(np.array([time]), np.array([heading]), np.array([sigma]))
            self.graph.append(one, np.array([number]))
        else:
            self.graph.log.remove(Headings, number)

    def finish(self) -> None:
        """End the walk here.

        If all of it is in the window the batch has the last word; else everything is linearised where it is until
        nothing moves.
        """
        graph = self.graph
        if not graph.window.keyframes:
            return
        self.finished = graph.window.finished = True
        self._close(at_end=True)
        if not self.sure and graph.placed:
            self._solve_again()
        if graph.window.complete:
            self._final = smooth(graph.batch_graph())
            return
        best, least = graph.isam, graph.total_cost
        graph.start_at(best.moved_to(gtsam.Values(best.values), relinearize=0.0), best.factors)
        while graph.relinearize(CONVERGED, everything=True) and graph.total_cost < least * (1 - SETTLES):
            best, least = graph.isam, graph.total_cost
            graph.start_at(best.moved_to(gtsam.Values(best.values)), best.factors)
        if graph.total_cost > least:
            graph.start_at(best.moved_to(gtsam.Values(best.values)), best.factors)

    # Keyframes

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes that steps and measurements have made, and update; whether there are any."""
        graph = self.graph
        new, reached = graph.close_keyframes(at_end)
        if not (new or reached):
            return False
        contradicted = reached and self._contradicted()
        if contradicted and self.sure:
            self._restart()
        if not self.sure and graph.placed and graph.window.times[-1] >= self.next_batch:
            self._solve_again()
        else:
            graph.update()
        if reached and self.sure:
            self._reclassify()
            self._correct()
        self._follow(new)
        graph.let_go()
        self._walls_due, self._rounds_due = graph.window.plan is not None, ROUNDS
        return True

    def _refine(self) -> bool:
        """Do one thing in the steps between keyframes: find the walls, or linearise again what has moved.

        Returns whether there was anything to do.
        """
        due = bool(self._rounds_due) or self._walls_due
        if self._walls_due:
            self._walls_due = False
            self._find_walls(LOOKED_BACK)
        elif self._rounds_due:
            self._rounds_due = self._rounds_due - 1 if self.graph.relinearize() else 0
        return due

    def _find_walls(self, pieces: int) -> float:
        """Find the walls, once the walk has been solved on the plan."""
        return self.graph.associate_walls(pieces) if np.isfinite(self.next_batch) else 0.0

    def _contradicted(self) -> bool:
        """True if measurements contradict earlier decisions; stores the new decisions."""
        _, measurements = self.graph.current()
        decisions = self.graph.decisions
        contradicted = any([one.contradicts(decisions.get(one.name, {})) for one in measurements])
        self.graph.decide(measurements)
        return contradicted

    # Where the walk is

    def _solve_again(self) -> None:
        """Begin again from the walk as the batch has it."""
        graph, window = self.graph, self.graph.window
        graph.let_go()
        solution = solve_batch(graph.batch_graph())
        self._adopt(solution)
        long = window.times[-1] - window.times[0] > LONGEST_OPEN
        self.sure = solution.sure or (long and len(graph.log.placing_times()) > 2)
        if not graph.past.anchored:
            graph.past.move(window.pose[0].copy())
        graph.past.anchored |= self.sure
        self.next_batch = window.times[-1] + max(AGAIN, SPACED * (window.times[-1] - window.times[0]))
        graph.rebuild(graph.lag if self.sure else np.inf)
        self._find_walls(ALL)
        for _ in range(ROUNDS):
            graph.relinearize()

    def _adopt(self, solution: BatchSolution) -> None:
        graph, window = self.graph, self.graph.window
        for name, decisions in solution.decisions.items():
            graph.decisions[name] = self._numbered(name, decisions)
        window.pose = solution.poses(np.array(window.times))
        for one in window.intervals:
            window.c[one.segment] = solution.calibration(one.end)
            one.fields = [None] * len(one.fields)

    def _numbered(self, name: str, decisions: dict[str, AnyArray]) -> dict[str, AnyArray]:
        """The batch's decisions, about instances as the window numbers them."""
        numbers = self.graph.log.numbers(name)
        if "number" not in decisions or numbers is None:
            return decisions
        return {**decisions, "number": numbers[decisions["number"].astype(np.intp)]}

    def _restart(self) -> None:
        """Restart because measurements contradict the walk; drop the information from before the window."""
        graph = self.graph
        first = graph.window.segments[0]
        if C(first) in graph.isam:
            covariance = graph.isam.covariance([C(first)]) + np.diag(np.square(graph.prior.change))
            graph.c_prior = graph.window.c[first], covariance
        self.restarts += 1
        self.sure, self.next_batch = False, -np.inf

    def _reclassify(self) -> None:
        """Lower the weight of measurements far from the walk; restore it for those that are near again."""
        graph = self.graph
        at = graph.evaluate()
        again = [one.reclassified(at) for one in at.measurements]
        if graph.decide(again):
            graph.log.version += 1
            graph.update()
        astray = any(one.astray for one in again)
        if astray and graph.window.times[-1] >= self.next_batch:
            self._restart()
            self._solve_again()

    def _correct(self) -> None:
        """Now and then: leave out what the walk shows to be listed wrongly."""
        window = self.graph.window
        if window.times[-1] < self.next_correction:
            return
        self.next_correction = window.times[-1] + CORRECTED
        at = self.graph.evaluate(everything=True)
        corrected = [one for one in (kind.corrected(at) for kind in at.measurements) if one is not None]
        if corrected:
            self.graph.decide(corrected)
            self.graph.log.version += 1
            self.graph.update(everything=True)

    # Where else it may be

    def _follow(self, new: list[Interval]) -> None:
        """Send the particles after the walk; they begin where the walk is once that is sure."""
        window = self.graph.window
        plan = window.known_plan
        if plan is None or not self.sure:
            self._particles = None
        elif self._particles is None:
            begin = window.times[-1]
            self._particles = ParallelParticleFilter(plan, self.graph.prior, self.last_belief(), begin, window.floor)
        else:
            for one in new:
                self._particles.add(one, self._seen(one.j))
            self._particles.forget(window.times[0])

    def _seen(self, keyframe: int) -> KeyframeMeasurements:
        """What was measured at a keyframe, by its number, as particles take it."""
        part, measurements = self.graph.current()
        return measurements_at(measurements, int(np.flatnonzero(part.chain.number == keyframe)[0]))

    def _compare(self, particles: ParallelParticleFilter) -> None:
        """Try the path of most particles where it is elsewhere, once the batch's; restart where all is strained."""
        window = self.graph.window
        at = int(np.searchsorted(window.times, particles.times[-1] - CLOSE))
        other = particles.elsewhere(window.pose[min(at, len(window.times) - 1), :2])
        if other is None and self._review_due():
            self.reviewed = True
            solution = solve_batch(self.graph.batch_graph())
            c = np.tile(solution.c[-1], (len(solution.time), 1))
            other = OtherPath(solution.time, np.column_stack([solution.pose, c]))
        if other is not None and other.time[-1] >= window.times[0]:
            self._try(other)
        elif window.count % CHECKED == 0 and window.times[-1] >= self.next_batch and self._strained():
            self._restart()
            self.graph.c_prior = np.array(self.graph.prior.mean), self.graph.prior.covariance
            self._solve_again()

    def _review_due(self) -> bool:
        """Whether a walk that was soon sure is to be solved once more, before any of it leaves the window."""
        window = self.graph.window
        long = window.times[-1] - window.times[0] > REVIEWED
        return not self.reviewed and self.graph.placed and window.complete and long

    def _strained(self) -> bool:
        """Whether so much speaks against the walk that it can hardly have gone this way, and there are fixes to ask."""
        fixes = len(self.graph.log.placing_times())
        limit = STRAINED + OF_KEYFRAME * len(self.graph.window.keyframes) + OF_FIX * fixes
        return fixes > 1 and self.graph.cost > limit

    def _try(self, other: OtherPath) -> None:
        """Move to another path, and back if that has more against it."""
        graph, window = self.graph, self.graph.window
        self.tried += 1
        isam, pose, c = graph.isam, window.pose.copy(), dict(window.c)
        walls = [one.fields for one in window.intervals]
        before = graph.total_cost + self._find_walls(ALL)
        self._move_to(other)
        price = self._find_walls(ALL)
        for _ in range(ROUNDS):
            graph.relinearize()
        if graph.total_cost + price < before:
            self.taken += 1
            return
        for one, fields in zip(window.intervals, walls, strict=True):
            one.fields = fields
        window.pose, window.c = pose, c
        graph.return_to(isam)

    def _move_to(self, other: OtherPath) -> None:
        """Put the same graph at another path; beyond its end as the steps lead on."""
        graph, window = self.graph, self.graph.window
        times = np.array(window.times)
        within = np.flatnonzero((times >= other.time[0] - CLOSE) & (times <= other.time[-1] + CLOSE))
        window.pose[within] = other.poses(times[within])
        window.lead_on(int(within[-1]), other.state[-1, 3:])
        values = gtsam.Values(graph.isam.values)
        for number, pose in zip(window.keyframes, window.pose, strict=True):
            values.update(X(number), gtsam.Pose2(*pose))
        for one in window.intervals:
            if one.begin >= other.time[0] - CLOSE:
                window.c[one.segment] = other.state[-1, 3:]
                values.update(C(one.segment), other.state[-1, 3:])
        graph.start_at(graph.isam.moved_to(values), graph.isam.factors)

    # Checkpoints

    def checkpoint(self) -> SmootherCheckpoint:
        """All that the rest of the walk depends on; rows that were taken are not included."""
        return SmootherCheckpoint(
            graph=self.graph.checkpoint(),
            sure=self.sure,
            next_batch=self.next_batch,
            next_correction=self.next_correction,
            restarts=self.restarts,
            reviewed=self.reviewed,
            tried=self.tried,
            taken=self.taken,
        )

    def restore(self, checkpoint: SmootherCheckpoint) -> None:
        """Go on from a checkpoint, with the same prior, lag, plan and collectors."""
        self.sure, self.next_batch, self.restarts = checkpoint.sure, checkpoint.next_batch, checkpoint.restarts
        self.next_correction = checkpoint.next_correction
        self.reviewed, self.tried, self.taken = checkpoint.reviewed, checkpoint.tried, checkpoint.taken
        self.graph.restore(checkpoint.graph)
