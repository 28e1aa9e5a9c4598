"""What a walk under way leaves open, and the questions about it that are computed beside the walk.

There are four questions: where and in which direction the walk began (the batch of the window), whether another path
costs less (on a copy of the window), what the sources get wrong (over the recent past), and where on the plan a walk
without any position is. Each answer is used at a fixed later time of the walk: no push waits for it, and the walk is
the same however it was computed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from pdr_graph.estimation.ambiguity.bank import Findings, paths, probabilities
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.factors.base import Refined, State, decisions_of, poses_at
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.registry import kind_of_type, made_from
from pdr_graph.estimation.factors.start import WALKER_KIND
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import sigma_direction
from pdr_graph.estimation.kalman import OF_POSITION, GaussianMixture, measured
from pdr_graph.estimation.linear_system import one_thread
from pdr_graph.estimation.live.live_graph import UPDATES, LiveGraph, same_decisions
from pdr_graph.estimation.live.live_output import (
    LiveOutput,
    Modes,
    Position,
    in_any_direction,
    modes_at_end,
    predict,
    unknown_turns,
)
from pdr_graph.estimation.live.particles import ParallelParticleFilter
from pdr_graph.estimation.live.review import History, Places, Review, places_on_plan
from pdr_graph.estimation.live.window import CLOSE, Decisions, Interval, Path, numbered, rewound
from pdr_graph.estimation.optimizer import continued, descended
from pdr_graph.estimation.particle_filter import pose_costs
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.priors import INITIAL, REPORTS, SCHEDULE, WAYS
from pdr_graph.types import Array, Fixes, Index, Steps

BATCH_TIME = 1.0  # [s] of the walk, after which an answer of the batch is adopted
Result = TypeVar("Result")


def batch_delay(duration: float) -> float:
    """Time [s] until the batch solves an ambiguous walk of this duration [s] again: a fifth of it, at least 3 s."""
    return max(3.0, 0.2 * duration)


class Deferred(Generic[Result]):
    """A question whose answer is used at a fixed later time of the walk; at most one at a time.

    So no push waits for it, and the walk is the same whether it was computed in an idle moment, by another thread, or
    only when it was due. due: time of the walk [s] from which the answer is used; executor: computes the answers; by
    default `work` does. `collect` computes an answer that is due and that nobody has begun.
    """

    def __init__(self, executor: Executor | None = None) -> None:
        self.executor, self.due = executor, np.inf
        self._question: Callable[[], Result] | None = None
        self._future: Future[Result] | None = None  # None while nobody computes the answer
        self._process = 0  # that asked

    @property
    def idle(self) -> bool:
        """True if there is no question."""
        return self._question is None

    def ask(self, question: Callable[[], Result], due: float) -> None:
        """Ask a question about data that do not change any more, whose answer is used from ``due`` [s] on.

        An open question is dropped.
        """
        self.cancel()
        self.due, self._question, self._process = due, question, os.getpid()
        if self.executor is not None:
            with suppress(RuntimeError):  # the interpreter ends
                self._future = self.executor.submit(one_thread(question))

    def work(self) -> None:
        """Compute the answer now, if no executor does."""
        if self._question is not None and self._future is None:
            self._future = Future()
            self._future.set_result(one_thread(self._question)())

    def collect(self, now: float) -> Result | None:
        """The answer if it is due at ``now`` [s], once; else None."""
        if self._question is None or now < self.due:
            return None
        if self._future is None or self._future.cancel() or (self._process != os.getpid() and not self._future.done()):
            answer = self._question()  # nobody has begun, or a thread that this process is a fork without
        else:
            answer = self._future.result()
        self.cancel()
        return answer

    def cancel(self) -> None:
        """Drop the question and its answer."""
        if self._future is not None:
            self._future.cancel()
        self._future, self._question, self.due = None, None, np.inf


@dataclass(frozen=True)
class BatchSolution:
    """The most probable walk so far.

    path: at its start and the ends of its pieces; decisions: about measurements, by kind; sure: no other path is
    likely, and the direction is certain; ways: all modes that remain, at the end, in all directions unless `directed`:
    each has a direction; headings: numbers of those that it used.
    """

    path: Path
    decisions: Decisions
    sure: bool
    ways: GaussianMixture
    directed: bool
    headings: Index


def solve_batch(build: Callable[[], WalkGraph], numbers: dict[str, Index]) -> BatchSolution:
    """The most probable walk, with a test whether it is certain, and the other modes that remain.

    build: makes the graph of the window; numbers: permanent numbers of its rows, by kind.
    """
    graph = build()
    optima = solutions(graph)
    best, path = optima[0], paths(optima)
    walled, at, chain = best.graph.walled, best.at, best.at.chain
    probability = probabilities(optima, path)
    ways = modes_at_end(optima, probability)
    variance = ways.covariance[:, 2, 2]
    certain = float(probability[path == 0].sum()) > REPORTS.sure
    long = graph.steps.end - graph.steps.start > SCHEDULE.least_duration
    determined = not walled or sigma_direction(graph.chain, graph.positions) < INITIAL.ambiguous or long
    narrow = variance[0] < (SCHEDULE.most_sigma_on_plan if walled else SCHEDULE.most_sigma) ** 2
    decided = {} if best.graph.positions.approximate else {k.name: decisions_of(k) for k in best.graph.measurements}
    time = np.append(chain.time[0], chain.time[:-1][at.pieces.interval] + at.pieces.to_end[1])
    if not (directed := bool((variance < INITIAL.ambiguous**2).all())):
        sigma = float(horizontal_sigma(ways.covariance[0]))
        ways = in_any_direction(ways, Position(float(time[-1]), at.ends[-1, :2], sigma, 1.0))
    return BatchSolution(
        path=Path(time, np.vstack([at.pose_i[:1], at.ends]), chain.time[chain.segment_first], best.state.c),
        decisions={name: numbered(rows, numbers.get(name)) for name, rows in decided.items() if rows},
        sure=bool(certain and determined and narrow),
        ways=ways,
        directed=directed,
        headings=numbers.get("headings", np.empty(0, dtype=np.intp)),
    )


def try_path(
    walk: WalkGraph, alternative: Callable[[], tuple[Path, Decisions]], rounds: int
) -> tuple[Path, Decisions] | None:
    """The alternative at its optimum, and the decisions about measurements on it; None if it does not cost less.

    walk: of the window; alternative: returns the path, and decisions about measurements on it; rounds: most steps of
    each search.
    """
    path, decisions = alternative()
    if not len(path.within(walk.chain.time)):
        return None  # it has left the window: the particles are behind
    present = _optimized(walk, walk.start, rounds)
    decisions = {name: rows for name, rows in decisions.items() if name != WALKER_KIND}
    other = walk.decided(decisions)
    start = continued(other.start, walk.start)
    other = _optimized(other.at(start), path.placed(walk.chain, start), rounds)
    if not other.surprise < present.surprise - 0.1:  # [nats] else it is the same path
        return None
    return Path.of(other.chain, other.state), decisions


def _optimized(walk: WalkGraph, start: State, rounds: int) -> Evaluation:
    """The walk at the optimum near a start, with the walls there."""
    return descended(walk.associated_at(start), rounds)


class LiveAmbiguity:
    """What is open about a walk, and the search for other answers.

    graph: of the walk, which answers change; output: has the modes that remain, and whether the walk is certain.
    solved: the batch has solved it; batch_reviewed: it has done so once more since the walk is certain; restarts: times
    [s] at which measurements contradicted the estimate; next_batch, next_search, next_comparison: times [s] before
    which a question is not asked again; findings: what the sources get wrong; history: the recent past in which they
    are compared.
    """

    def __init__(self, graph: LiveGraph, output: LiveOutput, executor: Executor | None = None):
        self.graph, self.output = graph, output
        self.batch, self.trial = Deferred[BatchSolution](executor), Deferred[tuple[Path, Decisions] | None](executor)
        self.sources, self.place = Deferred[Review](executor), Deferred[Places](executor)
        self.questions = self.batch, self.trial, self.sources, self.place
        self.next_batch = self.next_search = self.next_comparison = -np.inf
        self.solved, self.batch_reviewed = False, False
        self._restarting = False  # the past is dropped at the next solution, but for its calibration
        self._asked = dict[str, Index]()  # numbers of the measurements that the batch was asked about, by kind
        self.restarts = list[float]()
        self.findings = Findings()
        self.tail: Steps | None = None
        self._shown: BatchSolution | None = None  # whose modes are followed, and whose walk waits for a keyframe
        self.history = History() if graph.paths is None else History(WAYS.span)
        graph.log.longer = self.history.log

    def work(self) -> None:
        """Answer the open questions now."""
        for question in self.questions:
            question.work()

    # Start and direction: the batch of the window

    def solve_by_batch(self) -> bool:
        """Adopt a solution of the batch that is due, and ask for another while the direction is open.

        Returns True if a solution was adopted.
        """
        graph, window = self.graph, self.graph.window
        self.show_batch()
        solution, self._shown = self._shown, None
        if solution is not None:
            self.adopt_batch(solution)
        if self.output.sure:
            return solution is not None
        if window.duration > SCHEDULE.longest_open and np.isinf(graph.leaving_after):
            graph.restart(graph.lag)  # keyframes leave the window although the direction is open
        self.ask_batch()
        return solution is not None

    def show_batch(self) -> None:
        """Let the modes begin at a solution of the batch that is due; the next keyframe adopts its walk."""
        solution, output = self.batch.collect(self.now), self.output
        if solution is not None and not output.sure:
            self._shown = solution
            if solution.directed or output.modes.mixture is None:
                end = float(solution.path.time[-1])
                output.modes = Modes(solution.ways, end, used=solution.headings, directed=solution.directed)

    def ask_batch(self) -> None:
        """Ask the batch again where the walk is, if that is due or new fixes or headings came."""
        graph, window, now = self.graph, self.graph.window, self.now
        if self._shown is not None and self._shown.sure:
            return
        numbers, kinds = graph.log.all_numbers(window.times[-1]), ("fixes", "headings")
        unasked = any(not np.isin(numbers.get(kind, ()), self._asked.get(kind, ())).all() for kind in kinds)
        if self.batch.idle and graph.has_position and (now >= self.next_batch or unasked):
            if not (self.solved or graph.finalized.anchored) and np.isfinite(graph.leaving_after):
                graph.restart(np.inf)  # no keyframe leaves the window before the batch has placed the walk
            self.batch.ask(self.batch_question(), now + BATCH_TIME)
            self._asked = numbers
            self.next_batch = now + batch_delay(now - window.times[0])

    def batch_question(self) -> Callable[[], BatchSolution]:
        """The question for the batch of the window."""
        graph = self.graph
        c = self._first_calibration()[0] if self._restarting else None
        tail = self.followed_tail()
        covered = tail[-1].end if tail else graph.window.covered
        return partial(solve_batch, graph.batch_graph(c=c, tail=tail), graph.log.all_numbers(covered))

    @property
    def now(self) -> float:
        """End of the provisional steps, or of the certain ones. [s]"""
        return self.graph.window.steps.end if self.tail is None else self.tail.end

    def followed_tail(self) -> list[Steps]:
        """The provisional steps that ended SCHEDULE.late ago, for fixes that come late."""
        end = self.graph.window.steps.end
        if self.tail is None or abs(self.tail.start - end) > CLOSE:
            return []
        return rewound([self.tail], max(end, self.tail.end - SCHEDULE.late))

    def adopt_batch(self, solution: BatchSolution) -> None:
        """Restart from a solution of the batch."""
        graph, window, output = self.graph, self.graph.window, self.output
        if self._restarting:
            graph.c_prior, self._restarting = self._first_calibration(), False
        graph.decisions = graph.decisions | solution.decisions
        graph.place_on(solution.path)
        long = window.duration > SCHEDULE.longest_ambiguous
        output.sure, self.solved = solution.sure or (long and len(graph.log.position_times()) > 2), True
        if output.sure:
            output.modes.mixture = None
        if not graph.finalized.anchored:
            graph.finalized.move(window.pose[0].copy())
        graph.finalized.anchored |= output.sure
        self.next_comparison = -np.inf if output.sure else self.next_comparison
        graph.walls_changed()  # or a search without walls would move the walk off the solution
        graph.restart(graph.lag if output.sure or window.duration > SCHEDULE.longest_open else np.inf)
        graph.solve(UPDATES)

    def restart(self) -> None:
        """Solve the window anew, since measurements contradict the walk; of the past only the calibration is kept."""
        self.restarts.append(self.graph.window.times[-1])
        self._restarting, self.output.sure, self.solved = True, False, False
        self.batch.cancel()
        self.trial.cancel()
        self.next_batch, self._shown = -np.inf, None

    def rewind(self, to: float) -> None:
        """Drop the steps after ``to`` [s], and all answers that know them."""
        self.history.rewind(to)
        for question in self.questions:
            question.cancel()
        self.output.particles, self.next_batch, self._shown = None, -np.inf, None
        if self.output.modes.mixture is not None and self.output.modes.time > to:
            self.output.modes = Modes()

    def _first_calibration(self) -> tuple[Array, Array]:
        """Mean ``(3,)`` and covariance ``(3, 3)`` of the window's first calibration, by the walk so far."""
        graph = self.graph
        first, change = graph.window.segments[0], np.diag(np.square(graph.prior.change))
        return graph.window.c[first], graph.calibration_covariance()[0] + change

    # Fixes that the walk does not expect

    def unexpected_fixes(self) -> Index:
        """Numbers of the fixes since the last keyframe that are beyond the gate of the predicted position.

        The errors of a receiver's fixes are common: its jumps are a bias.
        """
        window, (fixes, numbers) = self.graph.window, self.graph.log.rows_and_numbers(Fixes)
        if not self.output.sure:
            return np.empty(0, dtype=np.intp)
        unexpected, steps, begin = list[int](), window.steps, window.times[-1]
        for n in np.flatnonzero((fixes.time > begin + CLOSE) & (fixes.time <= steps.end)).tolist():
            if fixes.source[n]:
                continue
            belief = self.output.keyframe_belief()
            there = predict(belief, steps.whole, steps.start, begin, float(fixes.time[n]), ())
            sigma, apart = float(fixes.sigma[n]), fixes.position[n] - there.mean[:, :2]
            if not measured(there, OF_POSITION, apart, sigma**2 * np.eye(2))[2].any():
                unexpected.append(n)
        return numbers[unexpected]

    def contradicted(self, unexpected: Index) -> bool:
        """True if measurements contradict earlier decisions; stores the new decisions.

        unexpected: numbers of fixes that become outliers, before they draw the walk across walls.
        """
        measurements, decisions = self.graph.factors.measurements, self.graph.decisions
        refined = (kind for kind in measurements if isinstance(kind, Refined))
        contradicted = any(kind.contradicts(decisions.get(kind.name, {})) for kind in refined)
        fixes = made_from(Fixes, measurements)
        rejected = [fixes.rejected(unexpected)] if fixes is not None and len(unexpected) else []
        if self.graph.store_decisions([*measurements, *rejected]) and len(unexpected):
            self.graph.log.version += 1
        return contradicted

    def reclassify(self) -> None:
        """Lower the weight of measurements far from the walk; restore it for those that are near again."""
        graph, at = self.graph, self.graph.at
        kinds = [kind.reclassified(at) if isinstance(kind, Refined) else kind for kind in at.measurements]
        pairs = zip(at.measurements, kinds, strict=True)
        changed = any(not same_decisions(decisions_of(old), decisions_of(new)) for old, new in pairs if old is not new)
        graph.store_decisions(kinds)
        if changed:
            graph.log.version += 1
            graph.solve()
        diverged = any(kind.diverged for kind in kinds if isinstance(kind, Refined))
        if diverged and graph.window.times[-1] >= self.next_batch:
            self.restart()

    def doubt_new_fixes(self) -> None:
        """Ask the batch for another path if a new fix is some sigmas off the present path, or in an area behind a wall.

        A fix where nobody can walk counts as the nearest walkable place: in a corridor, most fixes are beyond its
        walls, and no other path leads there.
        """
        graph, window, (fixes, numbers) = self.graph, self.graph.window, self.graph.log.rows_and_numbers(Fixes)
        now, plan = window.times[-1], window.located_plan
        if not self.output.sure or not len(fixes) or not self.trial.idle or now < self.next_batch:
            return
        asked = set(self._asked["fixes"].tolist()) if "fixes" in self._asked else set[int]()
        within = np.flatnonzero((fixes.time >= window.times[0]) & (fixes.time <= now + CLOSE))
        self._asked, unasked = graph.log.all_numbers(now), [n not in asked for n in numbers[within].tolist()]
        if not any(unasked):
            return
        new = fixes[within[unasked]]
        there = poses_at(new.time, np.array(window.times), window.pose)[:, :2]
        sigmas = np.hypot(*(new.position - there).T) / new.sigma
        elsewhere = sigmas > SCHEDULE.doubted
        if plan is not None:
            floor = plan[window.floor]
            begin, end = (np.array([floor.nearest_walkable(p) for p in places]) for places in (there, new.position))
            elsewhere |= (sigmas > SCHEDULE.doubted_behind_wall) & floor.crosses_wall(begin, end)
        if elsewhere.any():
            self.ask_batch_for_alternative()
            self.next_batch = now + batch_delay(window.duration)

    # Other paths: by particles between the walls, or by the batch once more

    def follow(self, new: list[Interval]) -> None:
        """Pass new intervals to the particle filter, which starts at the estimate as soon as that is certain.

        After a gap as long as the lag, new intervals may have left the window already: it starts again.
        """
        window, output = self.graph.window, self.output
        plan = window.located_plan if output.sure else None
        if plan is None or any(interval.j not in window.keyframes for interval in new):
            output.particles = None
        if output.particles is not None:
            for interval in new:
                factors = self.graph.factors
                row = int(np.flatnonzero(factors.chain.number == interval.j)[0])
                output.particles.enqueue(interval, pose_costs(factors.measurements, row))
            output.particles.forget(window.times[0])
        elif plan is not None:
            begin, belief = window.times[-1], output.keyframe_belief()
            output.particles = ParallelParticleFilter(plan, self.graph.prior_in_force, belief, begin, window.floor)

    def move_particles(self, busy: bool) -> None:
        """Let the particles do a little; when they reach a keyframe, compare them with the path.

        The path of most particles is tried where it differs, and once that of the batch, before any of the walk leaves
        the window.
        """
        graph, window, particles = self.graph, self.graph.window, self.output.particles
        if particles is None or not particles.process(busy):
            return
        at = int(np.searchsorted(window.times, particles.times[-1] - CLOSE))
        alternative = particles.alternative_path(window.pose[min(at, len(window.times) - 1), :2])
        open_to_batch = self.trial.idle and not self.batch_reviewed
        if alternative is not None and self.trial.idle:
            self._try(lambda: (alternative, {}), UPDATES)
        elif open_to_batch and graph.has_position and window.complete and window.duration > SCHEDULE.review_after:
            self.batch_reviewed = True
            self.ask_batch_for_alternative()

    def ask_batch_for_alternative(self) -> None:
        """Try the path that the batch finds."""
        question = self.batch_question()

        def alternative() -> tuple[Path, Decisions]:
            solution = question()
            return solution.path.uniform, solution.decisions

        self._try(alternative, 12)

    def _try(self, alternative: Callable[[], tuple[Path, Decisions]], rounds: int) -> None:
        """Compare an alternative with the present path on a copy, and adopt the better path later."""
        if not self.graph.window.intervals:
            return  # a single keyframe has no other path: the lag is shorter than the time between fixes
        question = partial(try_path, self.graph.frozen(), alternative, rounds)
        self.trial.ask(question, self.graph.window.times[-1] + BATCH_TIME)

    def adopt_alternative(self) -> None:
        """Move the window to an alternative that costs less."""
        graph = self.graph
        found = self.trial.collect(graph.window.times[-1])
        if found is not None and len(found[0].within(graph.window.times)):
            graph.decide(graph.decisions | found[1])
            graph.move_to(found[0])

    # The modes that remain, and the place on a plan

    def open_direction(self, whole: Array) -> None:
        """Leave the direction open from an unknown turn in new pieces on, until the batch is certain again."""
        output, window = self.output, self.graph.window
        if not output.sure or not len(turned := unknown_turns(whole)):
            return
        begin, end, past = window.times[-1], float(turned[-1]), window.steps
        fixes = output.fixes_between(begin, end)
        ways = predict(output.keyframe_belief(), past.whole, past.start, begin, end, fixes)
        output.modes, output.sure, self.next_batch = Modes(ways, end), False, -np.inf
        self.trial.cancel()
        self._shown = None

    def follow_modes(self) -> None:
        """Advance the modes that remain while the direction is open: the first fix begins them, in all directions.

        Later fixes correct them. They stay a little behind, for fixes that come late; headings, which the compass
        revises, correct what is shown.
        """
        graph, output, steps = self.graph, self.output, self.graph.window.steps
        if output.sure:
            return
        if output.modes.mixture is None:
            first = output.fixes_between(-np.inf, steps.end)
            if not first or graph.finalized.anchored:
                return
            output.modes = output.modes.begun(output.keyframe_belief(), first)
            output.modes.time = max(first[0].time, steps.start)
        until = max(output.modes.time, steps.end - SCHEDULE.late)
        fixes, whole, start = output.fixes_between(output.modes.time, until), steps.whole, steps.start
        output.modes = modes = output.modes.of_all(fixes)
        if modes.mixture is None:
            return
        modes.mixture = predict(modes.mixture, whole, start, modes.time, until, fixes, modes.receiver)
        modes.time = until

    def search_plan(self) -> None:
        """Seek a walk without any position on the whole plan; a place that is certain becomes a fix."""
        graph, window, modes = self.graph, self.graph.window, self.output.modes
        now, walked = window.times[-1], window.duration
        if graph.has_position or graph.finalized.anchored or window.located_plan is None:
            self.place.cancel()
            return
        if walked > SCHEDULE.longest_open:
            if not np.isfinite(graph.leaving_after):
                graph.restart(graph.lag)
            return
        places = self.place.collect(now)
        if places is not None and places.sure:
            graph.append(places.fix)
            graph.append(places.heading)
            return
        if places is not None:
            modes.mixture, modes.time, modes.receiver = places.ways, places.time, None
        if np.isfinite(graph.leaving_after):
            graph.restart(np.inf)  # no keyframe leaves the window before the walk is placed
        if self.place.idle and walked > SCHEDULE.search_after and now >= self.next_search:
            self.place.ask(partial(places_on_plan, graph.batch_graph()), now + 10.0)
            self.next_search = now + max(20.0, 0.4 * walked)

    # What the sources get wrong

    def compare_sources(self, waiting: float, before: Findings | None = None) -> None:
        """At intervals, compare the sources over the recent past, and adopt the result ``waiting`` [s] later.

        That is the most probable of what they get wrong; what else remains possible widens the stated covariance.
        before: assumptions that are kept unless others are clearly better; by default the present assumptions.
        """
        graph, window, now = self.graph, self.graph.window, self.graph.window.times[-1]
        if self.sources.idle and now >= self.next_comparison and self.history.has_position(now):
            self.next_comparison = now + min(max(5.0, 0.5 * window.duration), 30.0)
            known, walled = self.findings if before is None else before, window.located_plan is not None
            asked = self.history.question(now, graph.prior, known, graph.decisions, walled, graph.paths)
            self.sources.ask(asked, now + waiting)
        review = self.sources.collect(now)
        if review is not None:
            same, self.findings = review.findings.same_decisions(self.findings), review.findings
            if not same:
                self._adopt_decisions(review)
            elif review.ways:
                graph.decide(graph.decisions | review.ways)
                graph.solve()
            graph.excess = review.excess or graph.excess

    def _adopt_decisions(self, review: Review) -> None:
        """Adopt the decisions of a review, and its walk where no plan holds ours and the decisions matter to it.

        They do not matter if they are about fixes that had no weight before.
        """
        graph, window, fixes = self.graph, self.graph.window, kind_of_type(Fixes).name
        old, new, matters = graph.decisions.get(fixes), review.decisions.get(fixes), True
        if old is not None and new is not None and len(review.decisions) == 1:
            rejected = old["number"][~old["held"].astype(bool) | old["outlier"].astype(bool)]
            matters = not np.isin(new["number"][new["wrong"].astype(bool)], rejected).all()
        before = graph.prior_in_force
        graph.decide(graph.decisions | review.decisions)
        another_walker = graph.prior_in_force is not before
        if another_walker:  # what has left the window was estimated with the wrong profile
            graph.c_prior = np.array(graph.prior_in_force.mean), graph.prior_in_force.covariance
            graph.restart(graph.leaving_after)
        if window.located_plan is not None or not self.output.sure or not matters:
            graph.solve()
            return
        self.trial.cancel()
        graph.c_prior = graph.c_prior if another_walker else self._first_calibration()
        window.pose = review.poses(np.array(window.times), window.pose)
        for interval in window.intervals:
            window.c[interval.segment] = review.path.calibration(interval.end)
        graph.restart(graph.lag)
        graph.solve(UPDATES)
